//! The order per pixel: the first where the surface is flat within a window, the second where it is
//! curved, told by the smoothed difference of the two estimates.

use std::sync::Mutex;

use rayon::prelude::*;

use super::{
    DenseMaps,
    moments::{PAD, box_sum},
};
use crate::{
    Image, Level,
    lanes::{WIDEST, vectorised},
};

/// Radius of the smoothing: 13 x 13 pixels.
const RADIUS: usize = 6;
/// Differences below this many standard deviations of the unsmoothed difference are noise...
const FLAT: f32 = 0.7;
/// ...and above this many curvature; between the two, both estimates are blended.
const CURVED: f32 = 1.2;
/// Bounds of the standard deviation in px.
const SIGMA_PX: [f32; 2] = [0.002, 0.02];
/// Rows of a task.
const BAND: usize = 64;

/// Chooses orders; keeps its buffers between frames.
#[derive(Debug, Default)]
pub struct OrderChoice {
    bands: Vec<Mutex<Buffers>>,
    sample: Vec<f32>,
}

#[derive(Debug, Default)]
struct Buffers {
    /// Differences and their validity, by row modulo the window.
    difference: Vec<Vec<f32>>,
    valid: Vec<Vec<f32>>,
    column: Vec<f32>,
    sum: Vec<f32>,
    count: Vec<f32>,
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
        let threads = rayon::current_num_threads().max(1);
        self.bands.resize_with(threads.max(self.bands.len()), Mutex::default);
        let bands = &self.bands;
        let DenseMaps { first_px, second_px, zncc } = maps;
        out.as_mut_slice()
            .par_chunks_mut(width * BAND)
            .zip(zncc.as_mut_slice().par_chunks_mut(width * BAND))
            .enumerate()
            .for_each(|(band, (out, zncc))| {
                let thread = rayon::current_thread_index().unwrap_or(0) % bands.len();
                let mut b = bands[thread].lock().unwrap_or_else(|e| e.into_inner());
                b.resize(width);
                let top = band * BAND;
                let rows = out.len() / width;
                let side = 2 * RADIUS + 1;
                for y in top..top + rows + 2 * RADIUS {
                    // Row y - RADIUS enters, row y - 2 RADIUS is finished.
                    let enters = y.checked_sub(RADIUS).filter(|&y| y < height);
                    b.enter(level, enters.map(|y| (first_px.row(y), second_px.row(y))), y % side);
                    if let Some(row) = (y - top).checked_sub(2 * RADIUS) {
                        let at = row * width..(row + 1) * width;
                        let y = top + row;
                        let estimates = (first_px.row(y), second_px.row(y));
                        let limits = (FLAT * sigma, CURVED * sigma, zncc_min);
                        b.finish(level, estimates, limits, &mut zncc[at.clone()], &mut out[at]);
                    }
                }
            });
    }

    /// Standard deviation of the difference, robustly: from the median change over a window's width,
    /// in which curvature cancels.
    fn sigma(&mut self, maps: &DenseMaps) -> f32 {
        let apart = 2 * RADIUS + 1;
        let (first, second) = (maps.first_px.as_slice(), maps.second_px.as_slice());
        let difference = |i: usize| second[i] - first[i];
        self.sample.clear();
        let pairs = (0..first.len().saturating_sub(apart)).step_by(97);
        let changes = pairs.map(|i| (difference(i) - difference(i + apart)).abs());
        let half = std::f32::consts::FRAC_1_SQRT_2;
        self.sample.extend(changes.filter(|d| !d.is_nan()).map(|d| d * half));
        if self.sample.is_empty() {
            return SIGMA_PX[0];
        }
        let middle = self.sample.len() / 2;
        let (_, median, _) = self.sample.select_nth_unstable_by(middle, f32::total_cmp);
        (*median / 0.6745).clamp(SIGMA_PX[0], SIGMA_PX[1])
    }
}

impl Buffers {
    fn resize(&mut self, width: usize) {
        let padded = width.next_multiple_of(WIDEST) + 2 * PAD;
        let side = 2 * RADIUS + 1;
        self.difference.resize_with(side, Vec::new);
        self.valid.resize_with(side, Vec::new);
        for row in self.difference.iter_mut().chain(&mut self.valid) {
            row.resize(padded, 0.0);
            row.fill(0.0);
        }
        for row in [&mut self.column, &mut self.sum, &mut self.count] {
            row.resize(padded, 0.0);
            row.fill(0.0);
        }
    }

    fn enter(&mut self, level: Level, rows: Option<(&[f32], &[f32])>, slot: usize) {
        let (difference, valid) = (&mut self.difference[slot], &mut self.valid[slot]);
        match rows {
            None => {
                difference.fill(0.0);
                valid.fill(0.0);
            }
            Some((first, second)) => {
                let (difference, valid) = (&mut difference[PAD..], &mut valid[PAD..]);
                vectorised!(
                    level,
                    difference_loop(
                        first: &[f32] = first,
                        second: &[f32] = second,
                        difference: &mut [f32] = difference,
                        valid: &mut [f32] = valid,
                    )
                );
            }
        }
    }

    fn finish(
        &mut self,
        level: Level,
        estimates: (&[f32], &[f32]),
        limits: (f32, f32, f32),
        zncc: &mut [f32],
        out: &mut [f32],
    ) {
        const SIDE: usize = 2 * RADIUS + 1;
        let len = out.len().next_multiple_of(WIDEST);
        let mut rows: [&[f32]; SIDE] = [&[]; SIDE];
        for (row, d) in rows.iter_mut().zip(&self.difference) {
            *row = d;
        }
        box_sum(level, &rows, RADIUS, len, &mut self.column, &mut self.sum);
        for (row, v) in rows.iter_mut().zip(&self.valid) {
            *row = v;
        }
        box_sum(level, &rows, RADIUS, len, &mut self.column, &mut self.count);
        let (sum, count) = (&self.sum[PAD..], &self.count[PAD..]);
        vectorised!(
            level,
            blend_loop(
                estimates: (&[f32], &[f32]) = estimates,
                smoothed: (&[f32], &[f32]) = (sum, count),
                limits: (f32, f32, f32) = limits,
                zncc: &mut [f32] = zncc,
                out: &mut [f32] = out,
            )
        );
    }
}

#[inline(always)]
fn difference_loop(first: &[f32], second: &[f32], difference: &mut [f32], valid: &mut [f32]) {
    // Differences of a pixel or more are no matter of order.
    for (((&a, &b), d), v) in first.iter().zip(second).zip(difference).zip(valid) {
        let difference = b - a;
        let good = difference.abs() < 1.0;
        *d = if good { difference } else { 0.0 };
        *v = if good { 1.0 } else { 0.0 };
    }
}

#[inline(always)]
fn blend_loop(
    (first, second): (&[f32], &[f32]),
    (sum, count): (&[f32], &[f32]),
    (flat, curved, zncc_min): (f32, f32, f32),
    zncc: &mut [f32],
    out: &mut [f32],
) {
    let scale = 1.0 / (curved - flat);
    let estimates = first.iter().zip(second).zip(sum.iter().zip(count));
    for (((&a, &b), (&sum, &count)), (z, out)) in estimates.zip(zncc.iter_mut().zip(out)) {
        let mean = (sum / count.max(1.0)).abs();
        let part = ((mean - flat) * scale).clamp(0.0, 1.0);
        // Where only the first order could be fitted it has to do.
        let both = a + part * (b - a);
        let d = if b.is_nan() { a } else { both };
        let good = *z >= zncc_min && !d.is_nan();
        *out = if good { d } else { f32::NAN };
        *z = if good { *z } else { f32::NAN };
    }
}

/// Copies the disparities of one order, with the same test of the ZNCC.
pub fn accept(map: &Image<f32>, zncc_min: f32, zncc: &mut Image<f32>, out: &mut Image<f32>) {
    let width = map.width().max(1);
    out.as_mut_slice()
        .par_chunks_mut(width * BAND)
        .zip(zncc.as_mut_slice().par_chunks_mut(width * BAND))
        .zip(map.as_slice().par_chunks(width * BAND))
        .for_each(|((out, zncc), map)| {
            for ((out, z), &d) in out.iter_mut().zip(zncc).zip(map) {
                let good = *z >= zncc_min && !d.is_nan();
                *out = if good { d } else { f32::NAN };
                *z = if good { *z } else { f32::NAN };
            }
        });
}
