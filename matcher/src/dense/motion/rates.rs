//! From the rates of single blocks to a rate per pixel: a plane through the blocks around that move
//! alike, how significant it is, and which surface a pixel belongs to.

use rayon::prelude::*;

use super::{BLOCK, Times, sums::Blocks};
use crate::{Image, parallel::Share};

/// Blocks on each side that the plane is fitted through: 80 x 80 pixels.
const REACH: usize = 2;
/// Blocks whose rates differ by more standard deviations move differently...
const ALIKE: f32 = 4.0;
/// ...unless by less than this part of the rate: a turning surface.
const ALIKE_PART: f32 = 0.1;
/// Fewest blocks of a plane; fewer give their mean.
const PLANE_MIN: usize = 9;
/// Fewest blocks that move alike, and their least part by weight of those around: a block that moves
/// like no other has seen wrong pixels, not motion.
const ALIKE_MIN: usize = 4;
const ALIKE_WEIGHT: f64 = 0.15;
/// Rates of fewer standard deviations are noise...
const NOISE: f32 = 4.5;
/// ...of more are motion; in between they count in part.
const MOTION: f32 = 7.0;
/// Slower than so many px per frame interval, nothing is taken to move: over ten frames that is a pixel's own
/// noise. On curved surfaces at rest the fit's bias passed for such motion in one frame of ten, which then
/// took up to 50 ms of CPU more.
const SLOWEST: f32 = 0.0008;
/// Standard deviations up to which a block is taken for still without a fit: its own rate (a quarter of
/// the blocks around, moving alike, are motion from twice this on), any one's and all together's.
const STILL_OWN: f32 = 2.2;
const STILL_ONE: f32 = 4.0;
const STILL_ALL: f32 = 3.0;
/// Disparities this far from a block's are on another surface; the slope over a block is allowed for.
const SURFACE_PX: f32 = 4.0;

/// The rate around a block, in px per frame interval.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Around {
    /// At the block's centre; zero where not significant.
    rate: f32,
    /// Change per block along x and y.
    slope: [f32; 2],
    /// Whether the block says anything.
    known: bool,
}

/// Rates per block.
#[derive(Debug, Default)]
pub(crate) struct Rates {
    columns: usize,
    rows: usize,
    around: Vec<Around>,
    /// Rate and weight of each block by itself, in px per frame interval and its inverse square.
    own: Vec<(f32, f32)>,
    spare: Vec<f32>,
}

impl Rates {
    /// Forgets the last frame's.
    pub fn begin(&mut self) {
        self.around.clear();
    }

    /// Takes in what blocks add to the rates that their frames were warped with.
    pub fn add(&mut self, blocks: &Blocks, times: &Times) {
        (self.columns, self.rows) = (blocks.columns, blocks.rows);
        self.around.resize(blocks.blocks.len(), Around::default());
        self.own.clear();
        let with = self.around.iter().zip(&blocks.blocks);
        self.own.extend(with.map(|(around, block)| {
            let weight = block.weight * times.unit * times.unit;
            (around.rate + block.rate / times.unit, weight)
        }));
        let noise = self.noise();
        let own = &self.own;
        let (columns, rows) = (self.columns, self.rows);
        self.around.par_chunks_mut(columns).enumerate().share(|(row, around)| {
            for (column, around) in around.iter_mut().enumerate() {
                *around = plane(own, (columns, rows), (column, row), noise);
            }
        });
    }

    /// Whether anything moves fast enough to matter. Among thousands of blocks a few pass the test for
    /// noise, each alone; what moves shows in the blocks around it, whose planes share its pixels.
    pub fn any(&self) -> bool {
        let moves =
            |(c, r): (usize, usize)| self.around[r * self.columns + c].rate.abs() >= SLOWEST;
        let all = (0..self.rows).flat_map(|r| (0..self.columns).map(move |c| (c, r)));
        all.filter(|&block| moves(block)).any(|block| {
            let near = neighbours(block, (self.columns, self.rows), REACH);
            near.into_iter().filter(|&other| moves(other)).count() >= ALIKE_MIN
        })
    }

    /// Which blocks' pixels may move: those with a rate, and around them.
    pub fn moving(&self, moving: &mut Image<bool>) {
        if (moving.width(), moving.height()) != (self.columns, self.rows) {
            *moving = Image::new(self.columns, self.rows, false);
        }
        for row in 0..self.rows {
            for column in 0..self.columns {
                let near = neighbours((column, row), (self.columns, self.rows), 1);
                let rate = |(c, r): (usize, usize)| self.around[r * self.columns + c].rate != 0.0;
                moving.set(column, row, near.into_iter().any(rate));
            }
        }
    }

    /// Variance of noise per unit of weight: from second differences between neighbouring blocks, in
    /// which the motion of a turning plane cancels.
    fn noise(&mut self) -> f32 {
        self.spare.clear();
        for row in self.own.chunks(self.columns) {
            for three in row.windows(3) {
                let [(a, wa), (b, wb), (c, wc)] = [three[0], three[1], three[2]];
                if wa > 0.0 && wb > 0.0 && wc > 0.0 {
                    let variance = 1.0 / wa + 4.0 / wb + 1.0 / wc;
                    self.spare.push((a - 2.0 * b + c).powi(2) / variance);
                }
            }
        }
        if self.spare.is_empty() {
            return f32::INFINITY;
        }
        let middle = self.spare.len() / 2;
        let (_, median, _) = self.spare.select_nth_unstable_by(middle, f32::total_cmp);
        // The median of a squared standard normal is 0.4549.
        *median / 0.4549
    }

    /// The rate of each pixel with a disparity, from the blocks of its surface around it; zero elsewhere.
    pub fn expand(&self, blocks: &Blocks, disparity_px: &Image<f32>, rate: &mut Image<f32>) {
        let width = disparity_px.width();
        rate.as_mut_slice().par_chunks_mut(width * BLOCK / 2).enumerate().share(|(half, rows)| {
            // Rows between the same two rows of block centres.
            let top = (half as isize - 1).div_euclid(2);
            let lines = [top, top + 1].map(|r| r.clamp(0, self.rows as isize - 1) as usize);
            let still = |r: usize| {
                let from = r.saturating_sub(1) * self.columns;
                let to = ((r + 2) * self.columns).min(self.around.len());
                self.around[from..to].iter().all(|a| a.rate == 0.0)
            };
            if lines.into_iter().all(still) {
                rows.fill(0.0);
                return;
            }
            for (k, row) in rows.chunks_mut(width).enumerate() {
                let y = half * BLOCK / 2 + k;
                let v = (y as f32 + 0.5) / BLOCK as f32 - 0.5;
                for (x, (rate, &d)) in row.iter_mut().zip(disparity_px.row(y)).enumerate() {
                    *rate = if d.is_nan() { 0.0 } else { self.at(blocks, x, v, lines, d) };
                }
            }
        });
    }

    /// The rate at column `x` and height `v` in blocks, between two lines of blocks.
    fn at(&self, blocks: &Blocks, x: usize, v: f32, lines: [usize; 2], d: f32) -> f32 {
        let u = (x as f32 + 0.5) / BLOCK as f32 - 0.5;
        let left = u.floor() as isize;
        let ends = [left, left + 1].map(|c| c.clamp(0, self.columns as isize - 1) as usize);
        let (mut sum, mut weights) = (0.0, 0.0);
        for row in lines {
            for column in ends {
                let at = row * self.columns + column;
                let (around, block) = (&self.around[at], &blocks.blocks[at]);
                if around.known && (d - block.disparity_px).abs() <= SURFACE_PX {
                    let (du, dv) = (u - column as f32, v - row as f32);
                    // Outside the outermost centres all weights are zero but one.
                    let weight = ((1.0 - du.abs()) * (1.0 - dv.abs())).max(1e-3);
                    sum += weight * (around.rate + around.slope[0] * du + around.slope[1] * dv);
                    weights += weight;
                }
            }
        }
        if weights > 0.0 {
            return sum / weights;
        }
        // The pixel's surface is none of these blocks' main one: the nearest in disparity around.
        let centre = (x / BLOCK, ((v + 0.5) as usize).min(self.rows - 1));
        let near = neighbours(centre, (self.columns, self.rows), REACH);
        let known =
            near.into_iter().map(|(c, r)| r * self.columns + c).filter(|&i| self.around[i].known);
        let distance = |i: usize| (d - blocks.blocks[i].disparity_px).abs();
        let nearest = known.min_by(|&a, &b| distance(a).total_cmp(&distance(b)));
        nearest.map_or(0.0, |i| self.around[i].rate)
    }
}

/// Blocks up to `reach` from `centre`.
fn neighbours(
    (column, row): (usize, usize),
    (columns, rows): (usize, usize),
    reach: usize,
) -> impl IntoIterator<Item = (usize, usize)> {
    let across = column.saturating_sub(reach)..(column + reach + 1).min(columns);
    let down = row.saturating_sub(reach)..(row + reach + 1).min(rows);
    down.flat_map(move |r| across.clone().map(move |c| (c, r)))
}

/// Whether neither a block nor those around, one by one or together, differ from rest by more than noise:
/// the common case, told without a fit.
fn is_still(
    own: &[(f32, f32)],
    (columns, rows): (usize, usize),
    (column, row): (usize, usize),
    noise: f32,
) -> bool {
    let (mut sum, mut weights, mut largest) = (0.0f32, 0.0f32, 0.0f32);
    for r in row.saturating_sub(REACH)..(row + REACH + 1).min(rows) {
        let from = r * columns + column.saturating_sub(REACH);
        let to = r * columns + (column + REACH + 1).min(columns);
        for &(rate, weight) in &own[from..to] {
            sum += weight * rate;
            weights += weight;
            largest = largest.max(weight * rate * rate);
        }
    }
    let (rate, weight) = own[row * columns + column];
    largest < STILL_ONE.powi(2) * noise
        && weight * rate * rate < STILL_OWN.powi(2) * noise
        && sum * sum < STILL_ALL.powi(2) * noise * weights
}

/// Least squares of a plane through the rates around a block, of those that move as it does.
fn plane(
    own: &[(f32, f32)],
    (columns, rows): (usize, usize),
    (column, row): (usize, usize),
    noise: f32,
) -> Around {
    let (rate, weight) = own[row * columns + column];
    // Weights that add up to nothing but rounding.
    if weight <= 0.0 || !noise.is_finite() {
        return Around::default();
    }
    let floor = f32::MIN_POSITIVE.max(noise);
    if is_still(own, (columns, rows), (column, row), floor) {
        return Around { known: true, ..Around::default() };
    }
    let (mut m, mut v, mut count) = ([[0.0f64; 3]; 3], [0.0f64; 3], 0);
    let (mut squares, mut all) = (0.0, 0.0);
    for (c, r) in neighbours((column, row), (columns, rows), REACH) {
        let (other, w) = own[r * columns + c];
        if w <= 0.0 {
            continue;
        }
        all += f64::from(w);
        let limit = ALIKE * (floor * (1.0 / weight + 1.0 / w)).sqrt() + ALIKE_PART * rate.abs();
        if (other - rate).abs() > limit {
            continue;
        }
        count += 1;
        squares += f64::from(w) * f64::from(other).powi(2);
        let phi = [1.0, c as f64 - column as f64, r as f64 - row as f64];
        for (i, a) in phi.iter().enumerate() {
            v[i] += f64::from(w) * a * f64::from(other);
            for (j, b) in phi.iter().enumerate() {
                m[i][j] += f64::from(w) * a * b;
            }
        }
    }
    if count < ALIKE_MIN || m[0][0] < ALIKE_WEIGHT * all {
        return Around::default();
    }
    let mean = v[0] / m[0][0];
    let noise = f64::from(floor);
    // Blocks that scatter by more than noise, as where the disparity itself is biased, are less certain.
    let spread = |explained: f64, unknowns: usize| {
        let chi_squared = (squares - explained) / noise;
        noise * (chi_squared / (count - unknowns) as f64).max(1.0)
    };
    let mut variance = spread(mean * v[0], 1) / m[0][0];
    let (mut rate, mut slope) = (mean, [0.0; 2]);
    if count >= PLANE_MIN {
        let inverse = nalgebra::Matrix3::from_fn(|i, j| m[i][j]).try_inverse();
        // At the image's corners a plane's value is far less certain than the mean.
        if let Some(inverse) = inverse.filter(|i| i[(0, 0)] * m[0][0] < 4.0) {
            let found = inverse * nalgebra::Vector3::from(v);
            let gradient = [found[1], found[2]];
            // Gradients within their noise are none.
            let noise = spread(found.dot(&nalgebra::Vector3::from(v)), 3);
            let sure = (1..3).any(|k| found[k].powi(2) > 9.0 * noise * inverse[(k, k)]);
            if sure {
                (rate, slope, variance) = (found[0], gradient, noise * inverse[(0, 0)]);
            }
        }
    }
    let sigmas = (rate / variance.sqrt()).abs() as f32;
    let part = ((sigmas - NOISE) / (MOTION - NOISE)).clamp(0.0, 1.0);
    // The part begins and ends without a kink.
    let part = f64::from(part * part * (3.0 - 2.0 * part));
    let slope = slope.map(|s| (s * part) as f32);
    Around { rate: (rate * part) as f32, slope, known: true }
}
