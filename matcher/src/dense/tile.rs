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
    job::{Job, Output, image_rows},
    moments::{PAD, Powers, powers, slide_sum},
    motion::{
        BLOCK,
        along::{Along, Found},
        sums::Block,
    },
    normalise::{
        Besides, LeftWindows, Right, Terms, left_row, normalise_row, restart_row, used_row,
    },
    refit::{FINE_RADIUS, Window, fine_row, refit_row},
    rings::{Pass, Ring, around},
    solve::{FIRST, Fits, SECOND, disparities, inverse_rows},
    warp::{Source, Warped, moving, warp_row},
};
use crate::{Level, aligned::Aligned, lanes::vectorised};

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
    /// Static sums: those of squares only of the row in work.
    s: Ring,
    il: Ring,
    i: Ring,
    l: Ring,
    ll: Ring,
    /// The static sums where the first warp is valid.
    s_used: Ring,
    l_used: Ring,
    ll_used: Ring,
    first: Pass,
    inverse: [Ring; FIRST + SECOND],
    w1: Ring,
    second: Pass,
    /// What windows say of the left images.
    left: [Ring; 3],
    /// Windowed sums g, gg, lg of the row in work.
    right: [Ring; 3],
    fit: [Ring; 2],
    zncc: Ring,
    /// Brightness, which leaves with the fit.
    light: Ring<u8>,
    along: Along,
    /// The rate of the row in work.
    rate: Vec<f32>,
    moving: moving::Scratch,
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
        self.s_used.resize(stride, 5 * radius + 1);
        for ring in [&mut self.s, &mut self.l, &mut self.ll] {
            ring.resize(stride, 1);
        }
        self.light.resize(len, 4 * radius + 1);
        // Window sums slide: the row that leaves is one behind the window.
        for ring in [&mut self.l_used, &mut self.ll_used] {
            ring.resize(stride, window + 1);
        }
        for ring in self.left.iter_mut().chain(&mut self.inverse) {
            ring.resize(stride, window);
        }
        self.first.resize(stride, window);
        self.second.resize(stride, window);
        self.zncc.resize(stride, radius + 1);
        self.along.resize(stride, self.words, window);
        for ring in self.right.iter_mut().chain(&mut self.fit) {
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
                if job.watch_at(y4).is_some() {
                    self.look(job, y4, (x_from, x_to), x_from - x0 + PAD, y_from, out.blocks);
                }
                let from = (y4 - top) as usize * width;
                let columns = x_from - x0 + PAD..x_to - x0 + PAD;
                let valid = &self.second.valid.row(y4)[columns.clone()];
                let maps = [
                    (&mut *out.first, &self.fit[0], job.origin),
                    (&mut *out.zncc, &self.zncc, 0.0),
                    (&mut *out.second, &self.fit[1], job.origin),
                ];
                if let Some(to) = &mut out.brightness {
                    let light = &self.light.row(y4)[x_from - x0..x_to - x0];
                    to[from + x_from..from + x_to].copy_from_slice(light);
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
            let sums = [&mut self.il, &mut self.i, &mut self.s_used];
            for ring in sums.into_iter().chain([&mut self.l_used, &mut self.ll_used]) {
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
        used_row(
            job.level,
            self.first.valid.row(y),
            [&self.s, &self.l, &self.ll].map(|ring| ring.row(y)),
            self.len,
            [&mut self.s_used, &mut self.l_used, &mut self.ll_used].map(|ring| ring.row_mut(y)),
        );
        vectorised!(
            job.level,
            brightness_loop(
                light: &[f32] = &self.l.row(y)[PAD..PAD + self.len],
                // Sums over the frames of sixteenths.
                scale: f32 = 1.0 / (16.0 * job.frames as f32),
                to: &mut [u8] = self.light.row_mut(y),
            )
        );
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

    /// Windows around row `y` of the first pass, and q.
    fn normalise(&mut self, job: &Job<'_>, y: isize) {
        let (level, r, len) = (job.level, job.radius, self.len);
        let terms = [&self.first.valid, &self.l_used, &self.ll_used, &self.first.g, &self.first.gg];
        let ri = r as isize;
        let sums = self.left.iter_mut().chain(&mut self.right);
        for ((ring, sum), column) in terms.into_iter().zip(sums).zip(&mut self.columns) {
            let (enters, leaves) = (ring.row(y + ri), ring.row(y - ri - 1));
            let scratch = (&mut column[..], &mut self.threes[..]);
            slide_sum(level, (enters, leaves), r, len, scratch, sum.row_mut(y));
        }
        left_row(level, self.left.each_mut().map(|ring| ring.row_mut(y)), job.frames, len);
        self.residual(job, y, false);
    }

    /// q of row `y`, of the first or the second warp; of the second the ZNCC too.
    fn residual(&mut self, job: &Job<'_>, y: isize, again: bool) {
        let (pass, w) = match again {
            false => (&mut self.first, &self.w0),
            true => (&mut self.second, &self.w1),
        };
        let [per, mean, variance] = self.left.each_ref().map(|ring| ring.row(y));
        let [g, gg, lg] = self.right.each_ref().map(|ring| ring.row(y));
        let (ig, at, valid) = (pass.ig.row(y), pass.at.row(y), pass.valid.row(y));
        let terms = Terms {
            s: self.s_used.row(y),
            il: self.il.row(y),
            i: self.i.row(y),
            w: w.row(y),
            // A coarse start has whole pixels: its slope needs a wider base.
            base: if again { 2 } else { 4 },
            step: if again { 3.0 } else { 5.0 },
            origin: job.origin,
        };
        normalise_row(
            job.level,
            &LeftWindows { per, mean, variance },
            &Right { g, gg, ig, at, valid },
            &terms,
            self.len,
            pass.q.row_mut(y),
            again.then(|| Besides {
                lg,
                zncc: self.zncc.row_mut(y),
                timed: job.watch_at(y).map(|_| self.along.terms(y)),
            }),
        );
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
            let mut out = self.second.warped(y, true);
            let words = (source.gradient, source.grey);
            out.timed = job.watch_at(y).map(|watch| self.along.weigh(level, words, watch, y));
            warp(level, &source, motion, &mut self.moving, &mut out);
        }
    }

    /// Windows around row `y` of the second pass, q and ZNCC: the first warp, at whole pixels, leaves the
    /// gain uncertain by a part in a hundred.
    fn normalise_again(&mut self, job: &Job<'_>, y: isize) {
        let terms = [&self.second.g, &self.second.gg, &self.second.lg];
        let ri = job.radius as isize;
        let columns = &mut self.columns[5..];
        for ((ring, sum), column) in terms.into_iter().zip(&mut self.right).zip(columns) {
            let (enters, leaves) = (ring.row(y + ri), ring.row(y - ri - 1));
            let scratch = (&mut column[..], &mut self.threes[..]);
            slide_sum(job.level, (enters, leaves), job.radius, self.len, scratch, sum.row_mut(y));
        }
        self.residual(job, y, true);
    }

    /// Adds row `y`, whose fit is made, to the sums of motion; `at` is where its column `from` is kept,
    /// and `blocks` begin at row `top`.
    fn look(
        &mut self,
        job: &Job<'_>,
        y: isize,
        (from, to): (usize, usize),
        at: usize,
        top: usize,
        blocks: &mut [Block],
    ) {
        // The first order's bias on curved surfaces would look like motion.
        let order = usize::from(job.fits == Fits::Both);
        let found = Found {
            disparity: &self.fit[order].row(y)[at..],
            origin: job.origin,
            zncc: &self.zncc.row(y)[at..],
            valid: &self.second.valid.row(y)[at..],
            s: &self.s_used.row(y)[at..],
            q: &self.second.q.row(y)[at..],
        };
        let row = (y as usize - top) / BLOCK * job.start.width().div_ceil(BLOCK);
        let blocks = &mut blocks[row + from / BLOCK..row + to.div_ceil(BLOCK)];
        let maps = (job.start, job.step);
        self.along.add(job.level, maps, y as usize, (from, to), at, &found, blocks);
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
                        let (powers, frames) = (&self.fine_powers, job.frames);
                        fine_row(level, &window, powers, (len, frames), rows, second);
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
        vectorised!(level, flag_loop(step: &[u8] = step, flags: &mut [f32] = &mut self.flagged));
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
fn flag_loop(step: &[u8], flags: &mut [f32]) {
    for (flag, &step) in flags.iter_mut().zip(step) {
        *flag = if step == 0 { 0.0 } else { 1.0 };
    }
}

#[inline(always)]
fn brightness_loop(light: &[f32], scale: f32, to: &mut [u8]) {
    for (to, light) in to.iter_mut().zip(light) {
        // Rounded by what the sum drops: a conversion that saturates is not vectorised.
        let level = (light * scale).clamp(0.0, 255.0) + 8_388_608.0;
        *to = level.to_bits() as u8;
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
