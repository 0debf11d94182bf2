//! The order and the window per pixel.
//!
//! A first-order fit has half the second's noise, and where the surface is curved a bias of 6.7 times
//! half the curvature (9 x 9 pixels), which is what the difference e of the two estimates measures.
//! Curvature changes slowly, so that e is smoothed before it is used:
//!
//! - calm: first order + mean of e over 13 x 13 pixels. A quadratic surface comes out as it is, with 1.10
//!   times the first order's noise, where the second order has 1.90; where the mean is noise it is left
//!   out.
//! - calm and wide: over 5 x 5 pixels in addition, where that changes nothing but noise: 0.82 times the
//!   first order's noise on flat surfaces, 0.97 on curved ones. Averaging adds 0.3 of the bias, which
//!   is taken off likewise.
//! - rough: the second order, where e scatters more than by noise: edges and ridges within the window.
//!
//! What is noise is told by the median of changes of e over the image, scaled by each pixel's ZNCC.

use rayon::prelude::*;

use super::{
    DenseMaps,
    moments::{PAD, across_sum, box_sum, slide_columns},
    sample::SampledMedian,
};
use crate::{
    Image, Level,
    lanes::{Lanes, WIDEST, dispatch, vectorised},
    parallel::{PerThread, Share},
};

/// Radius of the smoothing: 13 x 13 pixels.
const RADIUS: usize = 6;
/// Radius of the wide average: 5 x 5 pixels.
const WIDE: usize = 2;
/// What the wide average adds to the bias of first order: 2 to 6.67.
const WIDE_BIAS: f32 = 0.3;
/// Fewest valid pixels under the smoothing; with fewer an edge is near.
const WHOLE: f32 = 130.0;
/// Near edges: means below and above so many standard deviations of e are of flat and of curved surfaces.
/// Between the two, here and below, both estimates are blended.
const EDGE: (f32, f32) = (0.7, 1.2);
/// Means below and above so many standard deviations are noise and bias; a mean of noise has 0.12.
const BIAS: (f32, f32) = (0.25, 0.5);
/// Changes by the wide average below and above so many are noise and shape; of noise they have 0.26.
const SHAPE: (f32, f32) = (0.9, 1.5);
/// Variances of e below and above so many of noise's are calm and rough; of noise 99.99 % are below 2.3.
const ROUGH: (f32, f32) = (2.4, 4.0);
/// Bounds of the image's standard deviation of e in px.
const SIGMA_PX: (f32, f32) = (0.002, 0.05);
/// Least loss of ZNCC that counts: below, it is rounding.
const LOSS_MIN: f32 = 1e-4;
/// Rows under the smoothing.
const SIDE: usize = 2 * RADIUS + 1;
/// Rows of a task, which looks at [`SIDE`] - 1 more.
const BAND: usize = 96;

/// Chooses orders; keeps its buffers between frames.
#[derive(Debug, Default)]
pub struct OrderChoice {
    bands: PerThread<Buffers>,
    sample: SampledMedian,
}

#[derive(Debug, Default)]
struct Buffers {
    /// By row modulo the window: differences, their squares and validity, and first orders.
    rows: [Vec<Vec<f32>>; 4],
    column: Vec<f32>,
    threes: Vec<f32>,
    /// Sums of the first three over the columns of the window, sliding down; begun anew in each band, so
    /// that they round the same whatever the threads.
    columns: [Vec<f32>; 3],
    /// Zeros.
    nothing: Vec<f32>,
    /// Sums of the same over 13 x 13 pixels, and of validity and first orders over 5 x 5.
    sums: [Vec<f32>; 5],
}

/// What a row's blend looks at; sums are padded rows.
struct Blend<'a> {
    first: &'a [f32],
    second: &'a [f32],
    sums: [&'a [f32]; 5],
    /// Standard deviation of e where ZNCC is one below by one.
    sigma: f32,
    zncc_min: f32,
}

impl OrderChoice {
    /// Writes the chosen disparity to `out`, and NaN where the ZNCC is below `zncc_min`; ZNCC and
    /// disparity are then NaN together.
    pub fn choose(
        &mut self,
        level: Level,
        zncc_min: f32,
        maps: &mut DenseMaps,
        out: &mut Image<f32>,
    ) {
        let (width, height) = (maps.first_px.width(), maps.first_px.height());
        let sigma = self.sigma(maps);
        let bands = self.bands.ready();
        let DenseMaps { first_px, second_px, zncc, .. } = maps;
        out.as_mut_slice()
            .par_chunks_mut(width * BAND)
            .zip(zncc.as_mut_slice().par_chunks_mut(width * BAND))
            .enumerate()
            .share(|(band, (out, zncc))| {
                bands.with(|b| {
                    b.resize(width);
                    let top = band * BAND;
                    let rows = out.len() / width;
                    for y in top..top + rows + 2 * RADIUS {
                        // Row y - RADIUS enters, row y - 2 RADIUS is finished.
                        let enters = y.checked_sub(RADIUS).filter(|&y| y < height);
                        b.enter(level, enters.map(|y| (first_px.row(y), second_px.row(y))), y);
                        if let Some(row) = (y - top).checked_sub(2 * RADIUS) {
                            let at = row * width..(row + 1) * width;
                            let estimates = (first_px.row(top + row), second_px.row(top + row));
                            let (zncc, out) = (&mut zncc[at.clone()], &mut out[at]);
                            b.finish(level, y - RADIUS, estimates, (sigma, zncc_min), zncc, out);
                        }
                    }
                });
            });
    }

    /// Standard deviation of e where ZNCC is one below by one, robustly: from the median change over a
    /// window's width, in which curvature cancels.
    fn sigma(&mut self, maps: &DenseMaps) -> f32 {
        let apart = 2 * RADIUS + 1;
        let (first, second) = (maps.first_px.as_slice(), maps.second_px.as_slice());
        let difference = |i: usize| second[i] - first[i];
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let change = self.sample.of(first.len().saturating_sub(apart), |i| {
            (difference(i) - difference(i + apart)).abs() * half
        });
        let sigma = (change.unwrap_or(0.0) / 0.6745).clamp(SIGMA_PX.0, SIGMA_PX.1);
        let zncc = maps.zncc.as_slice();
        let loss = self.sample.of(zncc.len(), |i| match zncc[i] {
            z if z.is_nan() => z,
            z => (1.0 - z).max(LOSS_MIN),
        });
        sigma / loss.unwrap_or(1.0).sqrt()
    }
}

impl Buffers {
    fn resize(&mut self, width: usize) {
        let padded = width.next_multiple_of(WIDEST) + 2 * PAD;
        for rows in &mut self.rows {
            rows.resize_with(SIDE, Vec::new);
        }
        let rows = self.rows.iter_mut().flatten();
        let scratch = [&mut self.column, &mut self.threes, &mut self.nothing];
        let scratch = scratch.into_iter().chain(&mut self.columns);
        for row in rows.chain(scratch).chain(&mut self.sums) {
            row.resize(padded, 0.0);
            row.fill(0.0);
        }
    }

    /// Takes in the row that is step `y` of a band: estimates of both orders, or beyond the image none.
    fn enter(&mut self, level: Level, estimates: Option<(&[f32], &[f32])>, y: usize) {
        // What leaves the window is in the slot that is filled.
        let rows = self.rows.each_mut().map(|rows| &mut rows[y % SIDE][..]);
        let Some((first, second)) = estimates else {
            for (row, column) in rows[..3].iter().zip(&mut self.columns) {
                let len = row.len() - 2 * PAD;
                slide_columns(level, (&self.nothing, row), len, column);
            }
            rows.into_iter().for_each(|row| row.fill(0.0));
            return;
        };
        let inner = PAD..PAD + first.len();
        vectorised!(
            level,
            enter_loop(
                first: &[f32] = first,
                second: &[f32] = second,
                rows: [&mut [f32]; 4] = rows.map(|row| &mut row[inner.clone()]),
                columns: [&mut [f32]; 3] = self.columns.each_mut().map(|c| &mut c[inner.clone()]),
            )
        );
    }

    /// The row that entered at step `y`, with the rows around it.
    fn finish(
        &mut self,
        level: Level,
        y: usize,
        (first, second): (&[f32], &[f32]),
        (sigma, zncc_min): (f32, f32),
        zncc: &mut [f32],
        out: &mut [f32],
    ) {
        let len = out.len().next_multiple_of(WIDEST);
        // Differences, squares and validity widely; validity and first orders narrowly.
        let (wide, narrow) = self.sums.split_at_mut(3);
        for (column, sum) in self.columns.iter().zip(wide) {
            across_sum(level, column, RADIUS, len, &mut self.threes, sum);
        }
        for (rows, sum) in self.rows[2..].iter().zip(narrow) {
            let around: [&[f32]; 2 * WIDE + 1] =
                std::array::from_fn(|j| &rows[(y + j + SIDE - WIDE) % SIDE][..]);
            box_sum(level, &around, WIDE, len, (&mut self.column, &mut self.threes), sum);
        }
        let sums = self.sums.each_ref().map(|sum| &sum[PAD..PAD + out.len()]);
        blend_row(level, &Blend { first, second, sums, sigma, zncc_min }, zncc, out);
    }
}

/// Writes a row's disparities, and its ZNCC where there is one, NaN elsewhere.
fn blend_row(level: Level, blend: &Blend<'_>, zncc: &mut [f32], out: &mut [f32]) {
    let whole = out.len() / WIDEST * WIDEST;
    let ([first, second], sums) = ([blend.first, blend.second], blend.sums);
    assert!(first.len() == out.len() && second.len() == out.len() && zncc.len() == out.len());
    assert!(sums.iter().all(|sum| sum.len() == out.len()));
    let vectors = |blend: &Blend<'_>, zncc: &mut [f32], out: &mut [f32]| {
        dispatch!(
            level,
            blend_lanes(
                blend: &Blend<'_> = blend,
                zncc: &mut [f32] = zncc,
                out: &mut [f32] = out,
            )
        );
    };
    vectors(blend, &mut zncc[..whole], &mut out[..whole]);
    let left = out.len() - whole;
    if left > 0 {
        // The last pixels, fewer than a vector, in one of their own.
        let mut last = [[0.0f32; WIDEST]; 9];
        let from = [first, second, &*zncc].into_iter().chain(sums);
        for (to, row) in last.iter_mut().zip(from) {
            to[..left].copy_from_slice(&row[whole..]);
        }
        let [first, second, z, a, b, c, d, e, to] = &mut last;
        let sums = [&a[..], &b[..], &c[..], &d[..], &e[..]];
        vectors(&Blend { first, second, sums, ..*blend }, z, to);
        zncc[whole..].copy_from_slice(&z[..left]);
        out[whole..].copy_from_slice(&to[..left]);
    }
}

/// Puts a row's values in the place of the one that leaves the window, and brings the sums of their
/// columns up to date.
#[inline(always)]
fn enter_loop(first: &[f32], second: &[f32], rows: [&mut [f32]; 4], columns: [&mut [f32]; 3]) {
    let [difference, square, valid, kept] = rows;
    let n = first.len();
    let [differences, squares, count] = columns.map(|column| &mut column[..n]);
    let (second, difference, square) = (&second[..n], &mut difference[..n], &mut square[..n]);
    let (valid, kept) = (&mut valid[..n], &mut kept[..n]);
    for i in 0..n {
        let e = second[i] - first[i];
        // Differences of a pixel or more are no matter of order.
        let good = e.abs() < 1.0;
        let e = if good { e } else { 0.0 };
        let one = if good { 1.0 } else { 0.0 };
        differences[i] += e - difference[i];
        squares[i] += e * e - square[i];
        count[i] += one - valid[i];
        difference[i] = e;
        square[i] = e * e;
        valid[i] = one;
        kept[i] = if good { first[i] } else { 0.0 };
    }
}

/// 0 up to the lower bound, 1 from the upper one.
#[inline(always)]
fn ramp<V: Lanes>(value: V, (low, high): (f32, f32)) -> V {
    let (zero, one) = (V::splat(0.0), V::splat(1.0));
    let part = value.sub(V::splat(low)).mul(V::splat(1.0 / (high - low)));
    let part = V::select(zero.lt(part), part, zero);
    V::select(part.lt(one), part, one)
}

/// Whole vectors of a row: as many pixels as `out` holds.
#[inline(always)]
fn blend_lanes<V: Lanes>(blend: &Blend<'_>, zncc: &mut [f32], out: &mut [f32]) {
    let n = out.len();
    assert!(n.is_multiple_of(V::COUNT) && zncc.len() >= n);
    assert!([blend.first, blend.second].iter().chain(&blend.sums).all(|row| row.len() >= n));
    let [one, nan] = [1.0, f32::NAN].map(V::splat);
    let known = |v: V| v.abs().lt(V::splat(f32::INFINITY));
    let per_sigma_at_one = V::splat(1.0 / blend.sigma);
    let all_near = ((2 * WIDE + 1) * (2 * WIDE + 1)) as f32;
    for i in (0..n).step_by(V::COUNT) {
        // SAFETY: `i + COUNT <= n`.
        let load = |row: &[f32]| unsafe { V::load(row.as_ptr().add(i)) };
        let (a, b, z) = (load(blend.first), load(blend.second), load(zncc));
        let [sum, squares, count, near, kept] = blend.sums.map(load);
        let loss = one.sub(z);
        let loss = V::select(V::splat(LOSS_MIN).lt(loss), loss, V::splat(LOSS_MIN));
        let per_sigma = loss.reciprocal_sqrt().mul(per_sigma_at_one);
        let per = V::select(one.lt(count), count, one).reciprocal();
        let mean = sum.mul(per);
        let variance = mean.neg_mul_add(mean, squares.mul(per)).mul(per_sigma).mul(per_sigma);
        let size = mean.abs().mul(per_sigma);
        let bias = mean.mul(ramp(size, BIAS));
        let calm = a.add(bias);
        let wide = V::splat(1.0 + WIDE_BIAS).mul_add(bias, kept.mul(V::splat(1.0 / all_near)));
        let change = wide.sub(calm);
        let part = one.sub(ramp(change.abs().mul(per_sigma), SHAPE));
        let calm = V::select(V::splat(all_near - 0.5).lt(near), part.mul_add(change, calm), calm);
        let whole = ramp(variance, ROUGH).mul_add(b.sub(calm), calm);
        let edge = ramp(size, EDGE).mul_add(b.sub(a), a);
        let both = V::select(count.lt(V::splat(WHOLE)), edge, whole);
        // Where only the first order could be fitted it has to do.
        let d = V::select(known(b), both, a);
        let good = V::both(known(z), known(d));
        let good = V::select(z.lt(V::splat(blend.zncc_min)), nan, V::select(good, d, nan));
        // SAFETY: as above.
        unsafe {
            good.store(out.as_mut_ptr().add(i));
            V::select(known(good), z, nan).store(zncc.as_mut_ptr().add(i));
        }
    }
}

/// Copies the disparities of one order, with the same test of the ZNCC.
pub fn accept(map: &Image<f32>, zncc_min: f32, zncc: &mut Image<f32>, out: &mut Image<f32>) {
    let width = map.width().max(1);
    out.as_mut_slice()
        .par_chunks_mut(width * BAND)
        .zip(zncc.as_mut_slice().par_chunks_mut(width * BAND))
        .zip(map.as_slice().par_chunks(width * BAND))
        .share(|((out, zncc), map)| {
            for ((out, z), &d) in out.iter_mut().zip(zncc).zip(map) {
                let good = *z >= zncc_min && !d.is_nan();
                *out = if good { d } else { f32::NAN };
                *z = if good { *z } else { f32::NAN };
            }
        });
}
