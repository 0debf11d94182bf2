//! Marks of depth steps: which pixels' windows hold another surface.

use rayon::prelude::*;

use crate::{Image, Level, lanes::vectorised, parallel::Share, params::RADIUS_LIMIT};

/// Rows of a task.
const BAND: usize = 32;
/// Columns of a strip, whose buffers are on the stack.
const STRIP: usize = 512;
/// Pixels whose window's range is found together, where there is a jump at all.
const BLOCK: usize = 32;
/// Columns whose extremes are found together: a register.
const LANES: usize = 16;
/// Most rows of a window.
const ROWS: usize = 2 * RADIUS_LIMIT + 1;
/// Columns of a strip and what its windows reach.
const COLUMNS: usize = STRIP + 2 * RADIUS_LIMIT;

/// A pixel far from its neighbour on the right, or one of them missing...
const RIGHT: u8 = 1;
/// ...or from the one below.
const BELOW: u8 = 2;

/// Marks the pixels whose window of `radius` holds a depth step: a disparity more than `limit` px from
/// their own, and a jump of that size between neighbours, or a gap. A steep surface has no jump.
///
/// Most of a map has no jump: there only flags of a byte are looked at, and the disparities of a window
/// only where one is.
pub fn mark_steps(
    level: Level,
    start: &Image<f32>,
    radius: usize,
    limit: f32,
    out: &mut Image<u8>,
) {
    let (width, height) = (start.width(), start.height());
    let level = level.usable();
    let radius = radius.min(RADIUS_LIMIT);
    if (out.width(), out.height()) != (width, height) {
        *out = Image::new(width, height, 0);
    }
    let bands = out.as_mut_slice().par_chunks_mut((width * BAND).max(1)).enumerate();
    bands.share(|(band, marks)| {
        let rows = marks.len() / width;
        let strips = (0..width).step_by(STRIP);
        for x0 in strips {
            let mut jumps = Jumps::new(level, start, (radius, limit), x0);
            let top = band * BAND;
            for y in top.saturating_sub(radius)..top + radius {
                jumps.enter(y);
            }
            for row in 0..rows {
                jumps.enter(top + row + radius);
                let columns = x0..(x0 + STRIP).min(width);
                jumps.mark(top + row, &mut marks[row * width..][columns]);
            }
        }
    });
}

/// The flags of a strip's rows around the one in work.
struct Jumps<'a> {
    level: Level,
    start: &'a Image<f32>,
    radius: usize,
    limit: f32,
    /// First column of the strip.
    x0: usize,
    /// By image row modulo [`ROWS`], from `radius` columns before the strip.
    flags: [[u8; COLUMNS]; ROWS],
}

impl<'a> Jumps<'a> {
    fn new(level: Level, start: &'a Image<f32>, (radius, limit): (usize, f32), x0: usize) -> Self {
        Self { level, start, radius, limit, x0, flags: [[0; COLUMNS]; ROWS] }
    }

    /// Finds the flags of row `y`, if there is such a row.
    fn enter(&mut self, y: usize) {
        let (width, height) = (self.start.width(), self.start.height());
        let flags = &mut self.flags[y % ROWS];
        if y >= height {
            flags.fill(0);
            return;
        }
        let from = self.x0.saturating_sub(self.radius);
        let to = (self.x0 + STRIP + self.radius).min(width);
        let row = &self.start.row(y)[from..to];
        let below = &self.start.row((y + 1).min(height - 1))[from..to];
        let right = &self.start.row(y)[(from + 1).min(width)..(to + 1).min(width)];
        let at = self.radius - (self.x0 - from);
        vectorised!(
            self.level,
            jump_loop(
                row: &[f32] = row,
                right: &[f32] = right,
                below: &[f32] = below,
                limit: f32 = self.limit,
                flags: &mut [u8] = &mut flags[at..at + row.len()],
            )
        );
    }

    /// Marks the pixels of row `y` in the strip.
    fn mark(&self, y: usize, marks: &mut [u8]) {
        let height = self.start.height();
        let (top, end) = (y.saturating_sub(self.radius), (y + self.radius + 1).min(height));
        let mut flags: [&[u8]; ROWS] = [&[]; ROWS];
        let mut rows: [&[f32]; ROWS] = [&[]; ROWS];
        for (k, row) in (top..end).enumerate() {
            flags[k] = &self.flags[row % ROWS];
            rows[k] = self.start.row(row);
        }
        vectorised!(
            self.level,
            mark_loop(
                rows: &[&[f32]] = &rows[..end - top],
                own: &[f32] = &self.start.row(y)[self.x0..],
                flags: &[&[u8]] = &flags[..end - top],
                reach: (usize, usize) = (self.radius, self.x0),
                limit: f32 = self.limit,
                marks: &mut [u8] = marks,
            )
        );
    }
}

#[inline(always)]
fn jump_loop(row: &[f32], right: &[f32], below: &[f32], limit: f32, flags: &mut [u8]) {
    for ((flag, v), below) in flags.iter_mut().zip(row).zip(below) {
        // True for NaN.
        let near = (below - v).abs() <= limit;
        *flag = if near { 0 } else { BELOW };
    }
    for ((flag, v), right) in flags.iter_mut().zip(row).zip(right) {
        let near = (right - v).abs() <= limit;
        *flag |= if near { 0 } else { RIGHT };
    }
}

#[inline(always)]
fn mark_loop(
    rows: &[&[f32]],
    own: &[f32],
    flags: &[&[u8]],
    reach: (usize, usize),
    limit: f32,
    marks: &mut [u8],
) {
    let (radius, x0) = reach;
    let len = marks.len();
    let mut column = [0u8; COLUMNS];
    for (k, flags) in flags.iter().enumerate() {
        // What is below the last row is outside the window.
        let which = if k + 1 == rows.len() { RIGHT } else { RIGHT | BELOW };
        for (c, flag) in column.iter_mut().zip(*flags) {
            *c |= flag & which;
        }
    }
    marks.fill(0);
    for j in 0..2 * radius + 1 {
        for (mark, c) in marks.iter_mut().zip(&column[j..j + len]) {
            *mark |= c;
        }
    }
    for (b, marks) in marks.chunks_mut(BLOCK).enumerate() {
        if marks.iter().fold(0, |any, m| any | m) == 0 {
            continue;
        }
        let from = b * BLOCK;
        // Extremes of columns; beyond the image they are neutral.
        let mut low = [f32::INFINITY; BLOCK + 2 * RADIUS_LIMIT];
        let mut high = [f32::NEG_INFINITY; BLOCK + 2 * RADIUS_LIMIT];
        let first = (x0 + from).saturating_sub(radius);
        let before = radius - (x0 + from - first);
        let columns = first..(x0 + from + BLOCK + radius).min(rows[0].len());
        let (low_of, high_of) = (&mut low[before..], &mut high[before..]);
        let (low_of, high_of) = (&mut low_of[..columns.len()], &mut high_of[..columns.len()]);
        let parts = low_of.chunks_mut(LANES).zip(high_of.chunks_mut(LANES));
        for (k, (low, high)) in parts.enumerate() {
            column_extremes(rows, columns.start + k * LANES, low, high);
        }
        let mut far = [0u8; BLOCK];
        for (k, far) in far.chunks_mut(LANES).enumerate() {
            let (mut lo, mut hi) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]);
            for j in 0..2 * radius + 1 {
                widen(&low[k * LANES + j..], &high[k * LANES + j..], &mut lo, &mut hi);
            }
            let own = own[from..].iter().skip(k * LANES);
            for ((far, own), (lo, hi)) in far.iter_mut().zip(own).zip(lo.iter().zip(&hi)) {
                *far = u8::from(own - lo > limit) | u8::from(hi - own > limit);
            }
        }
        for (mark, far) in marks.iter_mut().zip(far) {
            *mark = u8::from(*mark != 0) & far;
        }
    }
}

/// The lowest and highest of all `rows` in the columns from `at` on.
#[inline(always)]
fn column_extremes(rows: &[&[f32]], at: usize, low: &mut [f32], high: &mut [f32]) {
    // In arrays of known length, which stay in registers from row to row.
    let (mut lo, mut hi) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]);
    for row in rows {
        match row[at..].first_chunk::<LANES>() {
            Some(values) => widen(values, values, &mut lo, &mut hi),
            None => {
                let mut values = [f32::NAN; LANES];
                values[..row.len() - at].copy_from_slice(&row[at..]);
                widen(&values, &values, &mut lo, &mut hi);
            }
        }
    }
    low.copy_from_slice(&lo[..low.len()]);
    high.copy_from_slice(&hi[..high.len()]);
}

/// Widens ranges by the first values of `low` and `high`; NaN loses either comparison.
#[inline(always)]
fn widen(low: &[f32], high: &[f32], lo: &mut [f32; LANES], hi: &mut [f32; LANES]) {
    let (low, high) = (&low[..LANES], &high[..LANES]);
    for i in 0..LANES {
        lo[i] = if low[i] < lo[i] { low[i] } else { lo[i] };
        hi[i] = if high[i] > hi[i] { high[i] } else { hi[i] };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Random;

    /// The definition, pixel by pixel.
    fn reference(start: &Image<f32>, radius: usize, limit: f32) -> Image<u8> {
        let (w, h) = (start.width(), start.height());
        let mut out = Image::new(w, h, 0);
        let at = |x: usize, y: usize| start.row(y)[x];
        for y in 0..h {
            for x in 0..w {
                let (mut jump, mut far) = (false, false);
                for v in y.saturating_sub(radius)..(y + radius + 1).min(h) {
                    for u in x.saturating_sub(radius)..(x + radius + 1).min(w) {
                        let near = |a: f32, b: f32| (a - b).abs() <= limit;
                        let last = (y + radius + 1).min(h) - 1;
                        jump |= u + 1 < w && !near(at(u + 1, v), at(u, v));
                        jump |= v < last && !near(at(u, v + 1), at(u, v));
                        far |= (at(u, v) - at(x, y)).abs() > limit;
                    }
                }
                out.set(x, y, u8::from(jump && far));
            }
        }
        out
    }

    #[test]
    fn equals_the_definition_at_every_level() {
        let mut random = Random::new(12);
        for (w, h) in [(1, 1), (7, 3), (90, 41), (530, 40), (1100, 5)] {
            for radius in [2, 4, 8] {
                let map = Image::new(w, h, 0.0f32).map(|_: f32| match random.bits() % 100 {
                    0 => f32::NAN,
                    1 => 9.0,
                    k => 0.02 * k as f32,
                });
                let want = reference(&map, radius, 1.5);
                for level in Level::available() {
                    let mut got = Image::new(0, 0, 0);
                    mark_steps(level, &map, radius, 1.5, &mut got);
                    assert_eq!(got, want, "{level} {w} {h} {radius}");
                }
            }
        }
    }
}
