//! Dense least squares: the estimate of Stereo-DIC (paper eq 10-19) for every pixel at a cost that
//! does not depend on the window.
//!
//! With L, R the rectified stacks, I = dL/dx, w the current disparity and g_t = R_t(x - w, y), the
//! fit of the disparity itself in a window is
//!
//! ```text
//! S = sum_t I_t^2        b = sum_t I_t [(L_t - mean L) - norm(L)/norm(g) (g_t - mean g)]
//! q = S w - (1 - dw/dx) b
//! d = first component of M^-1 sum_window phi q,   M = sum_window S phi phi^T
//! ```
//!
//! All windows share one warp and separable sums. phi is 1, x, y or 1, x, y, x^2, xy, y^2.

pub(crate) mod gradient;
pub mod kernels;
pub(crate) mod moments;
pub mod motion;
pub(crate) mod normalise;
pub mod order;
pub(crate) mod refit;
pub(crate) mod solve;
pub(crate) mod tile;
pub(crate) mod warp;

use std::sync::Mutex;

use rayon::prelude::*;

use crate::{
    Image, Level, Sample, ShapeFunction, StereoStack, lanes::vectorised, params::RADIUS_LIMIT,
};
use motion::{BLOCK, Motion};
use solve::Fits;
use tile::{Job, Output, Tile};

/// Columns a tile fits: its rows stay in a core's second-level cache.
const STRIP: usize = 640;
/// Fewest rows of a task: each computes some rows beyond its own anew.
const BAND: usize = 64;

/// The dense fit; keeps its buffers between frames.
#[derive(Debug)]
pub struct DenseFit {
    level: Level,
    radius: usize,
    shape: ShapeFunction,
    surface_px: f32,
    tiles: Vec<Mutex<Tile>>,
    zero: Image<Sample>,
}

/// Maps of a dense fit on the left canvas; NaN is invalid.
#[derive(Debug, Clone)]
pub struct DenseMaps {
    /// Disparity of first order in px.
    pub first_px: Image<f32>,
    /// Of second order; not written for [`ShapeFunction::First`].
    pub second_px: Image<f32>,
    /// ZNCC of the window.
    pub zncc: Image<f32>,
}

impl DenseMaps {
    /// Empty maps.
    pub fn new(width: usize, height: usize) -> Self {
        let map = || Image::new(width, height, f32::NAN);
        Self { first_px: map(), second_px: map(), zncc: map() }
    }
}

impl DenseFit {
    /// A fit with windows of 2 `radius` + 1 pixels a side; `radius` is brought to 2..=8.
    pub fn new(level: Level, radius: usize, shape: ShapeFunction, surface_px: f32) -> Self {
        Self {
            level: level.usable(),
            radius: radius.clamp(2, 8),
            shape,
            surface_px,
            tiles: Vec::new(),
            zero: Image::new(0, 0, 0),
        }
    }

    /// Fits the disparity around `start` (NaN is invalid), whose depth steps are marked in `step`
    /// (see [`mark_steps`]). Sizes must be those of the checked stack; `out` is resized.
    pub fn fit(
        &mut self,
        stack: &StereoStack<'_>,
        start: &Image<f32>,
        step: &Image<u8>,
        out: &mut DenseMaps,
    ) {
        let (width, height) = (stack.width(), stack.height());
        if (out.first_px.width(), out.first_px.height()) != (width, height) {
            *out = DenseMaps::new(width, height);
        }
        self.run(stack, start, step, None, out);
    }

    /// Fits anew the blocks that are set in `moving`, with `motion`, and leaves the others as they are.
    pub(crate) fn refit(
        &mut self,
        stack: &StereoStack<'_>,
        start: &Image<f32>,
        step: &Image<u8>,
        motion: &Motion,
        moving: &Image<bool>,
        out: &mut DenseMaps,
    ) {
        self.run(stack, start, step, Some((motion, moving)), out);
    }

    fn run(
        &mut self,
        stack: &StereoStack<'_>,
        start: &Image<f32>,
        step: &Image<u8>,
        again: Option<(&Motion, &Image<bool>)>,
        out: &mut DenseMaps,
    ) {
        let (width, height) = (stack.width(), stack.height());
        if (self.zero.width(), self.zero.height()) != (width, height) {
            self.zero = Image::new(width, height, 0);
        }
        let threads = rayon::current_num_threads().max(1);
        self.tiles.resize_with(threads.max(self.tiles.len()), Mutex::default);
        let frames = stack.frames();
        let mut left = [&self.zero; 16];
        let mut right = [&self.zero; 16];
        left[..frames].copy_from_slice(stack.left);
        right[..frames].copy_from_slice(stack.right);
        let even = frames.next_multiple_of(2);
        let job = Job {
            level: self.level,
            left: &left[..even],
            right: &right[..even],
            frames,
            start,
            step,
            radius: self.radius,
            fits: if self.shape == ShapeFunction::First { Fits::First } else { Fits::Both },
            surface_px: self.surface_px,
            origin: origin(start),
            motion: again.map(|(motion, _)| motion),
        };
        let tiles = &self.tiles;
        // Results do not depend on where bands end.
        let band_rows = match again {
            None => height.div_ceil(2 * threads).max(BAND),
            Some(_) => BAND,
        };
        let rows = width * band_rows;
        let DenseMaps { first_px, second_px, zncc } = out;
        first_px
            .as_mut_slice()
            .par_chunks_mut(rows)
            .zip(second_px.as_mut_slice().par_chunks_mut(rows))
            .zip(zncc.as_mut_slice().par_chunks_mut(rows))
            .enumerate()
            .for_each(|(band, ((first, second), zncc))| {
                let thread = rayon::current_thread_index().unwrap_or(0) % tiles.len();
                let mut tile = tiles[thread].lock().unwrap_or_else(|e| e.into_inner());
                let mut out = Output { first, second, zncc };
                for (from, to) in columns(width, band, again.map(|(_, moving)| moving)) {
                    let strips = (to - from).div_ceil(STRIP);
                    for strip in 0..strips {
                        let part = |k: usize| from + (to - from) * k / strips;
                        let columns = (part(strip), part(strip + 1));
                        tile.run(&job, columns, band * band_rows, &mut out);
                    }
                }
            });
    }
}

/// Ranges of columns of a band that are to be fitted: all, or those of the blocks set in `moving`.
fn columns(width: usize, band: usize, moving: Option<&Image<bool>>) -> Vec<(usize, usize)> {
    let Some(moving) = moving else { return vec![(0, width)] };
    let per_band = BAND / BLOCK;
    let rows = band * per_band..((band + 1) * per_band).min(moving.height());
    let set = |column: usize| rows.clone().any(|row| moving.row(row)[column]);
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for column in (0..moving.width()).filter(|&c| set(c)) {
        let (from, to) = (column * BLOCK, ((column + 1) * BLOCK).min(width));
        match ranges.last_mut() {
            Some(last) if last.1 == from => last.1 = to,
            _ => ranges.push((from, to)),
        }
    }
    ranges
}

/// A whole number near the mean disparity, subtracted inside for precision.
fn origin(start: &Image<f32>) -> f32 {
    let (mut sum, mut n) = (0.0f64, 0u32);
    for &v in start.as_slice().iter().step_by(61).filter(|v| v.is_finite()) {
        sum += f64::from(v);
        n += 1;
    }
    if n == 0 { 0.0 } else { (sum / f64::from(n)).round() as f32 }
}

/// Marks the pixels whose window of `radius` holds a depth step: a disparity more than `limit` px from
/// their own, and a jump of that size between neighbours, or a gap. A steep surface has no jump.
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
    let data = out.as_mut_slice();
    data.par_chunks_mut((width * 32).max(1)).enumerate().for_each_init(
        || {
            let row = |v: f32| vec![v; width + 2 * radius];
            [row(f32::INFINITY), row(f32::NEG_INFINITY), row(0.0), row(0.0)]
        },
        |[low, high, jumps, wide], (band, marks)| {
            for (i, marks) in marks.chunks_mut(width).enumerate() {
                let y = band * 32 + i;
                let (top, end) = (y.saturating_sub(radius), (y + radius + 1).min(height));
                let mut rows = [start.row(y); 2 * RADIUS_LIMIT + 1];
                for (to, row) in rows.iter_mut().zip(top..end) {
                    *to = start.row(row);
                }
                vectorised!(
                    level,
                    mark_row(
                        rows: &[&[f32]] = &rows[..end - top],
                        own: &[f32] = start.row(y),
                        limit: f32 = limit,
                        low: &mut [f32] = low,
                        high: &mut [f32] = high,
                        jumps: &mut [f32] = jumps,
                        wide: &mut [f32] = wide,
                        marks: &mut [u8] = marks,
                    )
                );
            }
        },
    );
}

/// `low` and `high` hold the column extremes, with neutral values beyond the image's sides.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn mark_row(
    rows: &[&[f32]],
    own: &[f32],
    limit: f32,
    low: &mut [f32],
    high: &mut [f32],
    jumps: &mut [f32],
    wide: &mut [f32],
    marks: &mut [u8],
) {
    let width = own.len();
    let radius = (low.len() - width) / 2;
    let (column_low, column_high) = (&mut low[radius..][..width], &mut high[radius..][..width]);
    column_low.fill(f32::INFINITY);
    column_high.fill(f32::NEG_INFINITY);
    for row in rows {
        for ((lo, hi), &v) in column_low.iter_mut().zip(column_high.iter_mut()).zip(*row) {
            // NaN loses either comparison.
            *lo = if v < *lo { v } else { *lo };
            *hi = if v > *hi { v } else { *hi };
        }
    }
    // One where a neighbour in the row or below is far or missing.
    let column = &mut jumps[radius..][..width];
    column.fill(0.0);
    for (i, row) in rows.iter().enumerate() {
        let below = rows[(i + 1).min(rows.len() - 1)];
        for (((jump, &v), &right), &below) in
            column.iter_mut().zip(*row).zip(row.iter().skip(1)).zip(below)
        {
            let near = (right - v).abs() <= limit && (below - v).abs() <= limit;
            *jump = if near { *jump } else { 1.0 };
        }
    }
    let jump = &mut wide[..width];
    jump.fill(0.0);
    for j in 0..2 * radius + 1 {
        for (to, &v) in jump.iter_mut().zip(&jumps[j..j + width]) {
            *to = if v > *to { v } else { *to };
        }
    }
    marks.fill(0);
    for j in 0..2 * radius + 1 {
        let window = low[j..j + width].iter().zip(&high[j..j + width]);
        for ((mark, &own), (&lo, &hi)) in marks.iter_mut().zip(own).zip(window) {
            *mark |= u8::from(own - lo > limit) | u8::from(hi - own > limit);
        }
    }
    for (mark, &jump) in marks.iter_mut().zip(jump.iter()) {
        *mark &= u8::from(jump > 0.5);
    }
}
