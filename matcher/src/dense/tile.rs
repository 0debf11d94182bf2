//! The dense fit of one strip of a band of rows, row by row: every row passes the stages below, each
//! a window radius behind the one before, so that all intermediate rows stay in the cache.
//!
//! ```text
//! y      gradients and sums of the left row, warp at the start w0
//! y - r  gain and offset, q
//! y - 2r M^-1, first fit w1, warp at w1
//! y - 3r gain and offset, q again; ZNCC
//! y - 4r second fit
//! ```

use super::{
    gradient::{Static, static_row},
    moments::{PAD, Powers, powers, slide_sum},
    motion::Motion,
    normalise::{Terms, Windowed, gain_row, product_row, residual_row, restart_row, zncc_row},
    refit::{FINE_RADIUS, Window, fine_row, refit_row},
    solve::{FIRST, Fits, SECOND, disparities, inverse_rows},
    warp::{Source, Warped, moving, warp_row},
};
use crate::{Image, Level, Sample, aligned::Aligned, lanes::vectorised};

/// What all tiles of a frame share.
pub(crate) struct Job<'a> {
    pub level: Level,
    /// Another one for each frame.
    pub stamp: u64,
    /// Left images, an even number.
    pub left: &'a [&'a Image<Sample>],
    /// Right images, likewise.
    pub right: &'a [&'a Image<Sample>],
    /// Number of frames that are not padding.
    pub frames: usize,
    /// Starting disparities; NaN is invalid.
    pub start: &'a Image<f32>,
    /// Non-zero where a window holds a depth step.
    pub step: &'a Image<u8>,
    pub radius: usize,
    pub fits: Fits,
    /// Largest difference of a window pixel from the centre at steps.
    pub surface_px: f32,
    /// Subtracted from disparities for precision.
    pub origin: f32,
    /// Each frame's own place, where the surface moves.
    pub motion: Option<&'a Motion>,
}

/// The rows a tile writes: full image rows, of which it fills the columns it was asked for.
pub(crate) struct Output<'a> {
    pub first: &'a mut [f32],
    pub second: &'a mut [f32],
    pub zncc: &'a mut [f32],
    /// Mean of the left images' grey values, where it is wanted.
    pub brightness: Option<&'a mut [u8]>,
}

/// Padded rows by image row, the last `depth` of them kept.
#[derive(Debug, Default)]
struct Ring {
    data: Aligned<f32>,
    stride: usize,
    depth: usize,
}

impl Ring {
    fn resize(&mut self, stride: usize, depth: usize) {
        if (self.stride, self.depth) != (stride, depth) {
            self.data.resize(stride * depth, 0.0);
            (self.stride, self.depth) = (stride, depth);
        }
        self.data.fill(0.0);
    }

    fn offset(&self, y: isize) -> usize {
        y.rem_euclid(self.depth as isize) as usize * self.stride
    }

    fn row(&self, y: isize) -> &[f32] {
        &self.data[self.offset(y)..][..self.stride]
    }

    fn row_mut(&mut self, y: isize) -> &mut [f32] {
        let at = self.offset(y);
        &mut self.data[at..][..self.stride]
    }

    /// The row without its pads.
    fn inner_mut(&mut self, y: isize) -> &mut [f32] {
        let stride = self.stride;
        &mut self.row_mut(y)[PAD..stride - PAD]
    }
}

/// Most rows of a window.
const ROWS: usize = 17;

/// Calls `work` with the 2 radius + 1 rows of `ring` around `y`.
fn around<T>(ring: &Ring, y: isize, radius: usize, work: impl FnOnce(&[&[f32]]) -> T) -> T {
    let rows: [&[f32]; ROWS] =
        std::array::from_fn(|j| ring.row(y - radius as isize + j.min(2 * radius) as isize));
    work(&rows[..2 * radius + 1])
}

/// Buffers of a tile, kept between tiles.
#[derive(Debug, Default)]
pub(crate) struct Tile {
    /// Stamp and columns of the band that was fitted last, and the row after it: what follows goes on
    /// from its rows.
    next: Option<(u64, (usize, usize), usize)>,
    len: usize,
    words: usize,
    gradient: Aligned<i32>,
    grey: Aligned<i32>,
    /// Column sums of the eight maps that windows sum, sliding down.
    columns: [Aligned<f32>; 8],
    /// Scratch of window sums.
    threes: Aligned<f32>,
    flagged: Aligned<f32>,
    powers: Powers,
    fine_powers: Powers,
    w0: Ring,
    /// Static sums.
    s: Ring,
    il: Ring,
    i: Ring,
    l: Ring,
    ll: Ring,
    /// The static sums of grey values where the first warp is valid.
    l_used: Ring,
    ll_used: Ring,
    first: Pass,
    /// Gain and offset of the row in work.
    ratio: Ring,
    offset: Ring,
    s_used: Ring,
    inverse: [Ring; FIRST + SECOND],
    w1: Ring,
    second: Pass,
    /// Windowed sums n, l, ll, g, gg of the first pass.
    sums: [Ring; 5],
    /// Windowed sums g, gg, lg of the second pass.
    sums_again: [Ring; 3],
    fit: [Ring; 2],
    zncc: Ring,
    /// The rate of the row in work.
    rate: Vec<f32>,
    moving: moving::Scratch,
}

/// A warp's terms, and q.
#[derive(Debug, Default)]
struct Pass {
    at: Ring,
    valid: Ring,
    ig: Ring,
    g: Ring,
    gg: Ring,
    lg: Ring,
    q: Ring,
}

impl Pass {
    fn resize(&mut self, stride: usize, window: usize) {
        for ring in [&mut self.valid, &mut self.g, &mut self.gg, &mut self.lg] {
            ring.resize(stride, window + 1);
        }
        for ring in [&mut self.at, &mut self.ig, &mut self.q] {
            ring.resize(stride, window);
        }
    }

    /// Where the warp of row `y` goes; the products of grey values are for the similarity, which
    /// the first pass does not give.
    fn warped(&mut self, y: isize, with_lg: bool) -> Warped<'_> {
        Warped {
            at: self.at.inner_mut(y),
            valid: self.valid.inner_mut(y),
            ig: self.ig.inner_mut(y),
            g: self.g.inner_mut(y),
            gg: self.gg.inner_mut(y),
            lg: with_lg.then(|| self.lg.inner_mut(y)),
        }
    }

    fn clear(&mut self, y: isize) {
        for ring in [&mut self.at, &mut self.valid, &mut self.ig, &mut self.g, &mut self.gg] {
            ring.row_mut(y).fill(0.0);
        }
        self.lg.row_mut(y).fill(0.0);
    }
}

impl Tile {
    fn resize(&mut self, len: usize, radius: usize, pairs: usize) {
        let stride = len + 2 * PAD;
        let window = 2 * radius + 1;
        self.len = len;
        self.words = pairs * len;
        self.gradient.resize(self.words * window, 0);
        self.grey.resize(self.words * window, 0);
        for column in &mut self.columns {
            column.resize(stride, 0.0);
            column.fill(0.0);
        }
        self.threes.resize(stride, 0.0);
        self.flagged.resize(len, 0.0);
        (self.powers, self.fine_powers) = (powers(radius), powers(FINE_RADIUS));
        for ring in [&mut self.w0, &mut self.il, &mut self.i, &mut self.w1] {
            ring.resize(stride, 3 * radius + 1);
        }
        self.s_used.resize(stride, 4 * radius + 1);
        for ring in [&mut self.s, &mut self.ll] {
            ring.resize(stride, window);
        }
        self.l.resize(stride, 4 * radius + 1);
        // Window sums slide: the row that leaves is one behind the window.
        for ring in [&mut self.l_used, &mut self.ll_used] {
            ring.resize(stride, window + 1);
        }
        for ring in &mut self.sums {
            ring.resize(stride, window);
        }
        for ring in [&mut self.ratio, &mut self.offset] {
            ring.resize(stride, 1);
        }
        for ring in &mut self.inverse {
            ring.resize(stride, window);
        }
        self.first.resize(stride, window);
        self.second.resize(stride, window);
        self.zncc.resize(stride, radius + 1);
        for ring in self.sums_again.iter_mut().chain(&mut self.fit) {
            ring.resize(stride, 1);
        }
    }

    /// Fits columns `x_from..x_to` of the rows from `y_from`, where `out` holds exactly the rows to
    /// fit, at full width.
    pub(crate) fn run(
        &mut self,
        job: &Job<'_>,
        (x_from, x_to): (usize, usize),
        y_from: usize,
        out: &mut Output<'_>,
    ) {
        let (width, height) = (job.start.width(), job.start.height());
        let rows = out.first.len() / width;
        let r = job.radius as isize;
        let halo = 4 * job.radius;
        let x0 = x_from.saturating_sub(halo);
        let x1 = (x_to + halo).min(width);
        let len = (x1 - x0).next_multiple_of(32);
        let here = (job.stamp, (x_from, x_to), y_from);
        let goes_on = self.next == Some(here);
        if !goes_on {
            self.resize(len, job.radius, job.left.len() / 2);
        }
        self.next = Some((job.stamp, (x_from, x_to), y_from + rows));
        let (top, end) = (y_from as isize, (y_from + rows) as isize);
        let inside = |y: isize| (0..height as isize).contains(&y);
        let begin = if goes_on { top + 4 * r } else { top - 4 * r };
        for y in begin..end + 4 * r {
            self.enter(job, y, (x0, x1), inside(y));
            if y - r >= top - 3 * r {
                self.normalise(job, y - r);
            } else {
                self.begin_columns(y, false);
            }
            let (y2, y3, y4) = (y - 2 * r, y - 3 * r, y - 4 * r);
            if y2 >= top - 2 * r {
                self.first_fit(job, y2, x0, inside(y2));
                if y3 < top - r {
                    self.begin_columns(y2, true);
                }
            }
            if y3 >= top - r {
                self.normalise_again(job, y3);
            }
            if y4 >= top {
                self.fits(job, y4, x0, true, true);
                let from = (y4 - top) as usize * width;
                let columns = x_from - x0 + PAD..x_to - x0 + PAD;
                let valid = &self.second.valid.row(y4)[columns.clone()];
                let maps = [
                    (&mut *out.first, &self.fit[0], job.origin),
                    (&mut *out.zncc, &self.zncc, 0.0),
                    (&mut *out.second, &self.fit[1], job.origin),
                ];
                if let Some(to) = &mut out.brightness {
                    vectorised!(
                        job.level,
                        brightness_loop(
                            light: &[f32] = &self.l.row(y4)[columns.clone()],
                            // Sums over the frames of sixteenths.
                            scale: f32 = 1.0 / (16.0 * job.frames as f32),
                            to: &mut [u8] = &mut to[from + x_from..from + x_to],
                        )
                    );
                }
                let count = if job.fits == Fits::First { 2 } else { 3 };
                for (to, ring, origin) in maps.into_iter().take(count) {
                    vectorised!(
                        job.level,
                        finish_loop(
                            values: &[f32] = &ring.row(y4)[columns.clone()],
                            valid: &[f32] = valid,
                            origin: f32 = origin,
                            to: &mut [f32] = &mut to[from + x_from..from + x_to],
                        )
                    );
                }
            }
        }
    }

    /// Words of row `y` in the pair buffers.
    fn words_at(&self, y: isize, radius: usize) -> std::ops::Range<usize> {
        let slot = y.rem_euclid(2 * radius as isize + 1) as usize;
        slot * self.words..(slot + 1) * self.words
    }

    /// Static sums and first warp of row `y`.
    fn enter(&mut self, job: &Job<'_>, y: isize, (x0, x1): (usize, usize), inside: bool) {
        let w0 = self.w0.row_mut(y);
        w0.fill(f32::NAN);
        if !inside {
            for ring in [&mut self.s, &mut self.il, &mut self.i, &mut self.l, &mut self.ll] {
                ring.row_mut(y).fill(0.0);
            }
            for ring in [&mut self.l_used, &mut self.ll_used] {
                ring.row_mut(y).fill(0.0);
            }
            self.first.clear(y);
            return;
        }
        w0[PAD..PAD + x1 - x0].copy_from_slice(&job.start.row(y as usize)[x0..x1]);
        let words = self.words_at(y, job.radius);
        let left = image_rows(job.left, y);
        let mut out = Static {
            gradient: &mut self.gradient[words.clone()],
            grey: &mut self.grey[words.clone()],
            stride: self.len,
            s: self.s.inner_mut(y),
            il: self.il.inner_mut(y),
            i: self.i.inner_mut(y),
            l: self.l.inner_mut(y),
            ll: self.ll.inner_mut(y),
        };
        static_row(job.level, &left[..job.left.len()], x0, self.len, &mut out);
        let right = image_rows(job.right, y);
        let source = Source {
            right: &right[..job.right.len()],
            x0,
            w: &self.w0.row(y)[PAD..PAD + self.len],
            gradient: &self.gradient[words.clone()],
            grey: &self.grey[words],
            stride: self.len,
        };
        let motion =
            job.motion.and_then(|m| m.of_row(y as usize, (x0, x1), self.len, &mut self.rate));
        warp(job.level, &source, motion, &mut self.moving, &mut self.first.warped(y, false));
        let valid = self.first.valid.row(y);
        product_row(job.level, self.l.row(y), valid, self.len, self.l_used.row_mut(y));
        product_row(job.level, self.ll.row(y), valid, self.len, self.ll_used.row_mut(y));
    }

    /// Adds row `y` to the column sums of the first or second pass, whose window is not yet whole.
    fn begin_columns(&mut self, y: isize, again: bool) {
        let (first, second) = (&self.first, &self.second);
        let (l, ll) = (&self.l_used, &self.ll_used);
        let (columns, terms) = match again {
            false => (&mut self.columns[..5], &[&first.valid, l, ll, &first.g, &first.gg][..]),
            true => (&mut self.columns[5..], &[&second.g, &second.gg, &second.lg][..]),
        };
        for (column, ring) in columns.iter_mut().zip(terms) {
            for (sum, v) in column.iter_mut().zip(ring.row(y)) {
                *sum += v;
            }
        }
    }

    /// Gain and offset, and q of row `y`.
    fn normalise(&mut self, job: &Job<'_>, y: isize) {
        let (level, r, len) = (job.level, job.radius, self.len);
        let terms = [&self.first.valid, &self.l_used, &self.ll_used, &self.first.g, &self.first.gg];
        let ri = r as isize;
        let columns = &mut self.columns[..5];
        for ((ring, sum), column) in terms.into_iter().zip(&mut self.sums).zip(columns) {
            let (enters, leaves) = (ring.row(y + ri), ring.row(y - ri - 1));
            let scratch = (&mut column[..], &mut self.threes[..]);
            slide_sum(level, (enters, leaves), r, len, scratch, sum.row_mut(y));
        }
        let [n, l, ll, g, gg] = &self.sums;
        let windowed =
            Windowed { n: n.row(y), l: l.row(y), ll: ll.row(y), g: g.row(y), gg: gg.row(y) };
        gain_row(level, &windowed, job.frames, len, self.ratio.row_mut(y), self.offset.row_mut(y));
        let used = self.s_used.row_mut(y);
        product_row(level, self.s.row(y), self.first.valid.row(y), len, used);
        self.residual(job, y, false);
    }

    /// q of row `y`, of the first or the second warp.
    fn residual(&mut self, job: &Job<'_>, y: isize, again: bool) {
        let (pass, w) = match again {
            false => (&mut self.first, &self.w0),
            true => (&mut self.second, &self.w1),
        };
        let terms = Terms {
            s: self.s_used.row(y),
            il: self.il.row(y),
            i: self.i.row(y),
            ig: pass.ig.row(y),
            ratio: self.ratio.row(y),
            offset: self.offset.row(y),
            at: pass.at.row(y),
            valid: pass.valid.row(y),
            w: w.row(y),
            // A coarse start has whole pixels: its slope needs a wider base.
            base: if again { 2 } else { 4 },
            step: if again { 3.0 } else { 5.0 },
            origin: job.origin,
        };
        residual_row(job.level, &terms, self.len, pass.q.row_mut(y));
    }

    /// M^-1 and the first fit of row `y`, then the second warp there.
    fn first_fit(&mut self, job: &Job<'_>, y: isize, x0: usize, inside: bool) {
        let (level, r, len) = (job.level, job.radius, self.len);
        let mut inverse = self.inverse.each_mut().map(|h| h.row_mut(y));
        around(&self.s_used, y, r, |s| {
            inverse_rows(level, s, r, &self.powers, len, job.fits, &mut inverse);
        });
        self.fits(job, y, x0, inside, false);
        let w0 = self.w0.row(y);
        // The start is a whole pixel, perhaps the wrong neighbour: a fit farther off is not this
        // surface's.
        let bounds = (job.origin, 2.0);
        restart_row(level, self.fit[0].row(y), w0, bounds, len, self.w1.row_mut(y));
        if !inside {
            self.second.clear(y);
        } else {
            let words = self.words_at(y, r);
            let right = image_rows(job.right, y);
            let source = Source {
                right: &right[..job.right.len()],
                x0,
                w: &self.w1.row(y)[PAD..PAD + len],
                gradient: &self.gradient[words.clone()],
                grey: &self.grey[words],
                stride: len,
            };
            let columns = (x0, (x0 + len).min(job.start.width()));
            let motion =
                job.motion.and_then(|m| m.of_row(y as usize, columns, len, &mut self.rate));
            warp(level, &source, motion, &mut self.moving, &mut self.second.warped(y, true));
        }
    }

    /// Gain and offset, q and ZNCC of row `y` from the second warp: the first
    /// one, at whole pixels, leaves the gain uncertain by a part in a hundred.
    fn normalise_again(&mut self, job: &Job<'_>, y: isize) {
        let (level, r, len) = (job.level, job.radius, self.len);
        let terms = [&self.second.g, &self.second.gg, &self.second.lg];
        let ri = r as isize;
        let columns = &mut self.columns[5..];
        for ((ring, sum), column) in terms.into_iter().zip(&mut self.sums_again).zip(columns) {
            let (enters, leaves) = (ring.row(y + ri), ring.row(y - ri - 1));
            let scratch = (&mut column[..], &mut self.threes[..]);
            slide_sum(level, (enters, leaves), r, len, scratch, sum.row_mut(y));
        }
        let ([n, l, ll, ..], [g, gg, lg]) = (&self.sums, &self.sums_again);
        let windowed =
            Windowed { n: n.row(y), l: l.row(y), ll: ll.row(y), g: g.row(y), gg: gg.row(y) };
        let (ratio, offset) = (self.ratio.row_mut(y), self.offset.row_mut(y));
        gain_row(level, &windowed, job.frames, len, ratio, offset);
        zncc_row(level, &windowed, lg.row(y), job.frames, len, self.zncc.row_mut(y));
        self.residual(job, y, true);
    }

    /// Fits of row `y` from the first or second pass, those at steps by the masked window.
    fn fits(&mut self, job: &Job<'_>, y: isize, x0: usize, inside: bool, again: bool) {
        let (level, r, len) = (job.level, job.radius, self.len);
        // The start of the second pass needs no more than the first order.
        let (pass, fits) = match again {
            false => (&self.first, Fits::First),
            true => (&self.second, job.fits),
        };
        let count = if fits == Fits::First { 1 } else { 2 };
        let inverse = self.inverse.each_ref().map(|h| h.row(y));
        let mut out = self.fit.each_mut().map(|h| h.row_mut(y));
        around(&pass.q, y, r, |q| {
            disparities(level, q, &inverse, r, &self.powers, len, &mut out[..count]);
        });
        if !inside {
            return;
        }
        self.fits_at_steps(job, y, x0, (again, fits));
        if again && fits == Fits::Both && r > FINE_RADIUS {
            let [first, second] = &mut self.fit;
            let (first, second) = (first.row(y), second.row_mut(y));
            around(&self.s_used, y, FINE_RADIUS, |s| {
                around(&self.second.q, y, FINE_RADIUS, |q| {
                    around(&self.w1, y, FINE_RADIUS, |w| {
                        let window = Window { s, q, w, limit: job.surface_px, sloped: true };
                        let rows = (first, &mut self.threes[..]);
                        fine_row(level, &window, &self.fine_powers, len, rows, second);
                    });
                });
            });
        }
    }

    /// The fits of row `y` whose windows hold a depth step, by the pixels on the centre's side of it.
    fn fits_at_steps(&mut self, job: &Job<'_>, y: isize, x0: usize, (again, fits): (bool, Fits)) {
        let (level, r, len) = (job.level, job.radius, self.len);
        let (pass, w) = match again {
            false => (&self.first, &self.w0),
            true => (&self.second, &self.w1),
        };
        let step = &job.step.row(y as usize)[x0..];
        let step = &step[..step.len().min(len)];
        if step.iter().fold(0, |any, s| any | s) == 0 {
            return;
        }
        let mut out = self.fit.each_mut().map(|h| h.row_mut(y));
        for (flag, &step) in self.flagged.iter_mut().zip(step) {
            *flag = f32::from(step);
        }
        self.flagged[step.len()..].fill(0.0);
        around(&self.s_used, y, r, |s| {
            around(&pass.q, y, r, |q| {
                around(w, y, r, |w| {
                    let window = Window { s, q, w, limit: job.surface_px, sloped: again };
                    let flagged = &self.flagged;
                    refit_row(level, &window, flagged, r, &self.powers, len, fits, &mut out);
                });
            });
        });
    }
}

/// The result: only pixels with a start and a warp of their own are measured.
#[inline(always)]
fn finish_loop(values: &[f32], valid: &[f32], origin: f32, to: &mut [f32]) {
    for ((to, v), valid) in to.iter_mut().zip(values).zip(valid) {
        *to = if *valid > 0.5 { v + origin } else { f32::NAN };
    }
}

#[inline(always)]
fn brightness_loop(light: &[f32], scale: f32, to: &mut [u8]) {
    for (to, light) in to.iter_mut().zip(light) {
        *to = (light * scale + 0.5) as u8;
    }
}

/// Warps a row, moving or not.
fn warp(
    level: Level,
    source: &Source<'_>,
    motion: Option<moving::Moving<'_>>,
    scratch: &mut moving::Scratch,
    out: &mut Warped<'_>,
) {
    match motion {
        None => warp_row(level, source, out),
        Some(motion) => moving::warp_moving_row(level, source, &motion, scratch, out),
    }
}

/// Row `y` of each image.
pub(crate) fn image_rows<'a>(images: &[&'a Image<Sample>], y: isize) -> [&'a [Sample]; 16] {
    std::array::from_fn(|i| images.get(i).map_or(&[][..], |image| image.row(y as usize)))
}
