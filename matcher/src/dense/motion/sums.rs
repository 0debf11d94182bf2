//! The rate's normal equations per block, from every [`ROWS_APART`]th row.

use rayon::prelude::*;

use super::{
    BLOCK, Motion, Times,
    lag::Lag,
    weight::{Weighted, weigh, words},
};
use crate::{
    Image, Level, Sample, StereoStack,
    dense::{
        gradient::{SQUARE_UNIT, Static, static_row},
        job::image_rows,
        warp::{Source, Warped, moving, warp_row},
    },
    lanes::vectorised,
    parallel::{PerThread, Share},
};

/// Every how manyth row is summed: dots are taller than half of this.
pub(super) const ROWS_APART: usize = 4;
/// Disparities of a block that spread more than this are of several surfaces.
const SPREAD_PX: f32 = 6.0;
/// Fewest pixels of a block that says anything.
pub(super) const PIXELS_MIN: f32 = 12.0;
/// Pixels of a lower ZNCC take no part.
pub(super) const ZNCC_MIN: f32 = 0.5;
/// Variance below which a block counts as dark, per sample in (1/16 grey level)^2.
const DARK: f32 = 16.0;
/// Slopes above this are steps.
const SLOPE_MAX: f32 = 2.0;

/// What the sums are made of.
#[derive(Clone, Copy)]
pub(crate) struct Frame<'a> {
    pub level: Level,
    pub stack: &'a StereoStack<'a>,
    pub step: &'a Image<u8>,
    pub times: &'a Times,
    /// Disparities that the sums are made at.
    pub disparity_px: &'a Image<f32>,
    pub zncc: &'a Image<f32>,
    /// Radius of the windows that the disparities were fitted in as if nothing moved, if they were.
    pub smeared: Option<usize>,
}

/// The rate of a block, in px per unit of [`Times::centred`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Block {
    /// What the block adds to the rate that its frames were warped with.
    pub rate: f32,
    /// Its weight: variance of noise over variance of `rate`; zero where the block says nothing.
    pub weight: f32,
    /// Mean disparity of its surface.
    pub disparity_px: f32,
}

/// The blocks of an image, row by row.
#[derive(Debug, Default)]
pub(crate) struct Blocks {
    pub columns: usize,
    pub rows: usize,
    pub blocks: Vec<Block>,
    scratch: PerThread<Scratch>,
}

/// Sums over time of a row, and their sums over rows.
#[derive(Debug, Default)]
struct Scratch {
    gradient: Vec<i32>,
    grey: Vec<i32>,
    /// Gradients times the frame's time.
    weighted: Vec<i32>,
    w: Vec<f32>,
    rate: Vec<f32>,
    at: Vec<f32>,
    terms: [Vec<f32>; TERMS],
    sums: [Vec<f32>; TERMS + 2],
    surfaces: Surfaces,
    /// Beside a last odd frame.
    zero: Vec<Sample>,
    moving: moving::Scratch,
    lag: Lag,
}

/// Bounds of the disparities of each block's main surface.
#[derive(Debug, Default)]
pub(super) struct Surfaces {
    pub bounds: Vec<(f32, f32)>,
    all: Vec<f32>,
}

/// Terms per pixel: n, l, ll, g, gg, il, i, ig, il t, i t, ig t, S, S t, S t^2; the sums also hold
/// the disparity and its slope.
const TERMS: usize = 14;

impl Blocks {
    /// Makes room for an image's blocks, which say nothing yet.
    pub fn begin(&mut self, width: usize, height: usize) {
        (self.columns, self.rows) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        self.blocks.clear();
        self.blocks.resize(self.columns * self.rows, Block::default());
    }

    /// Sums the fit in `frame`, whose frames lie where `motion` says. Without motion, all lie at the
    /// same place.
    pub fn sum(&mut self, frame: &Frame<'_>, motion: Option<&Motion>) {
        let (width, height) = (frame.stack.width(), frame.stack.height());
        self.begin(width, height);
        let scratch = self.scratch.ready();
        self.blocks.par_chunks_mut(self.columns).enumerate().share(|(row, blocks)| {
            scratch.with(|s| s.row_of_blocks(frame, motion, row * BLOCK, blocks));
        });
    }
}

impl Scratch {
    fn resize(&mut self, len: usize, pairs: usize) {
        for words in [&mut self.gradient, &mut self.grey, &mut self.weighted] {
            words.resize(len * pairs, 0);
        }
        self.w.resize(len, f32::NAN);
        self.at.resize(len, 0.0);
        for row in &mut self.terms {
            row.resize(len, 0.0);
        }
        for row in &mut self.sums {
            row.clear();
            row.resize(len, 0.0);
        }
    }

    fn row_of_blocks(
        &mut self,
        frame: &Frame<'_>,
        motion: Option<&Motion>,
        top: usize,
        blocks: &mut [Block],
    ) {
        let (width, height) = (frame.stack.width(), frame.stack.height());
        let frames = frame.stack.frames();
        let len = width.next_multiple_of(32);
        self.resize(len, frames.div_ceil(2));
        let end = (top + BLOCK).min(height);
        let sampled = (top..end).filter(|y| y % ROWS_APART == ROWS_APART / 2);
        let mut surfaces = std::mem::take(&mut self.surfaces);
        let rows = sampled.clone().map(|y| frame.disparity_px.row(y));
        surfaces.bound(frame.level, rows, blocks.len());
        let smear = motion.zip(frame.smeared);
        if let Some((_, radius)) = smear {
            self.lag.fill(frame, (top, end), radius);
        }
        for y in sampled {
            self.select(frame, y, &surfaces.bounds);
            if let Some((motion, radius)) = smear {
                self.lag.correct(frame, motion, (y, top), radius, &mut self.w);
            }
            self.terms(frame, motion, y);
            let Self { terms, sums, w, .. } = self;
            vectorised!(
                frame.level,
                add_loop(
                    terms: &[Vec<f32>; TERMS] = terms,
                    w: &[f32] = w,
                    sums: &mut [Vec<f32>; TERMS + 2] = sums,
                )
            );
        }
        self.surfaces = surfaces;
        for (column, block) in blocks.iter_mut().enumerate() {
            let mut totals = [0.0; TERMS + 2];
            vectorised!(
                frame.level,
                total_loop(
                    sums: &[Vec<f32>] = &self.sums,
                    from: usize = column * BLOCK,
                    totals: &mut [f64] = &mut totals,
                )
            );
            *block = solve(totals, frames);
        }
    }

    /// The disparities of row `y` that take part, NaN elsewhere.
    fn select(&mut self, frame: &Frame<'_>, y: usize, surfaces: &[(f32, f32)]) {
        vectorised!(
            frame.level,
            select_loop(
                disparity_px: &[f32] = frame.disparity_px.row(y),
                zncc: &[f32] = frame.zncc.row(y),
                step: &[u8] = frame.step.row(y),
                surfaces: &[(f32, f32)] = surfaces,
                w: &mut [f32] = &mut self.w,
            )
        );
    }

    /// Terms of row `y`.
    fn terms(&mut self, frame: &Frame<'_>, motion: Option<&Motion>, y: usize) {
        let stack = frame.stack;
        let frames = stack.frames();
        let len = self.w.len();
        self.zero.resize(stack.width(), 0);
        let (mut left, mut right) =
            (image_rows(stack.left, y as isize), image_rows(stack.right, y as isize));
        let even = frames.next_multiple_of(2);
        if frames % 2 == 1 {
            (left[frames], right[frames]) = (&self.zero, &self.zero);
        }
        let [n, l, ll, g, gg, il, i, ig, ilt, it, igt, s, st, stt] = &mut self.terms;
        let (gradient, grey) = (&mut self.gradient[..], &mut self.grey[..]);
        let mut out = Static { gradient, grey, stride: len, s, il, i, l, ll };
        static_row(frame.level, &left[..even], 0, len, &mut out);
        let mut out = Weighted { gradient: &mut self.weighted, ilt, it, st, stt };
        weigh(frame.level, &self.gradient, &self.grey, &words(&frame.times.centred), &mut out);
        // The warp sums products with two stacks: the gradients weighted by time, and plain ones.
        let (gradient, grey) = (&self.weighted[..], &self.gradient[..]);
        let source =
            Source { right: &right[..even], x0: 0, w: &self.w, gradient, grey, stride: len };
        let mut out =
            Warped { at: &mut self.at, valid: n, ig: igt, g, gg, lg: Some(ig), timed: None };
        let moving = motion.and_then(|m| m.of_row(y, (0, stack.width()), len, &mut self.rate));
        match moving {
            None => warp_row(frame.level, &source, &mut out),
            Some(moving) => {
                moving::warp_moving_row(frame.level, &source, &moving, &mut self.moving, &mut out);
            }
        }
        for v in ig.iter_mut() {
            *v *= SQUARE_UNIT;
        }
    }
}

#[inline(always)]
fn select_loop(
    disparity_px: &[f32],
    zncc: &[f32],
    step: &[u8],
    surfaces: &[(f32, f32)],
    w: &mut [f32],
) {
    w[disparity_px.len()..].fill(f32::NAN);
    let rows = disparity_px.chunks(BLOCK).zip(zncc.chunks(BLOCK)).zip(step.chunks(BLOCK));
    let blocks = w.chunks_mut(BLOCK).zip(surfaces);
    for (((d, zncc), step), (to, &(low, high))) in rows.zip(blocks) {
        for (((to, &d), &zncc), &step) in to.iter_mut().zip(d).zip(zncc).zip(step) {
            let used = (step == 0) & (zncc >= ZNCC_MIN) & (d >= low) & (d <= high);
            *to = if used { d } else { f32::NAN };
        }
    }
}

#[inline(always)]
fn bounds_loop(row: &[f32], bounds: &mut [(f32, f32)]) {
    for (pixels, (low, high)) in row.chunks(BLOCK).zip(bounds) {
        // NaN loses either comparison.
        let least = |a: f32, b: f32| if b < a { b } else { a };
        let most = |a: f32, b: f32| if b > a { b } else { a };
        let (mut lows, mut highs) = ([f32::INFINITY; BLOCK], [f32::NEG_INFINITY; BLOCK]);
        for ((low, high), &d) in lows.iter_mut().zip(&mut highs).zip(pixels) {
            (*low, *high) = (least(*low, d), most(*high, d));
        }
        // Halves against each other: a fold would wait for itself.
        for half in [8, 4, 2, 1] {
            for i in 0..half {
                lows[i] = least(lows[i], lows[i + half]);
                highs[i] = most(highs[i], highs[i + half]);
            }
        }
        (*low, *high) = (least(*low, lows[0]), most(*high, highs[0]));
    }
}

impl Surfaces {
    /// Finds the bounds of `blocks` blocks' main surfaces from rows of disparities.
    pub fn bound<'a>(
        &mut self,
        level: Level,
        rows: impl Iterator<Item = &'a [f32]> + Clone,
        blocks: usize,
    ) {
        let Self { bounds, all } = self;
        bounds.clear();
        bounds.resize(blocks, (f32::INFINITY, f32::NEG_INFINITY));
        for row in rows.clone() {
            vectorised!(
                level,
                bounds_loop(row: &[f32] = row, bounds: &mut [(f32, f32)] = bounds)
            );
        }
        for (column, (low, high)) in bounds.iter_mut().enumerate() {
            if *high - *low <= SPREAD_PX {
                continue;
            }
            all.clear();
            for row in rows.clone() {
                let end = ((column + 1) * BLOCK).min(row.len());
                all.extend(row[column * BLOCK..end].iter().filter(|d| !d.is_nan()));
            }
            if all.is_empty() {
                continue;
            }
            let middle = all.len() / 2;
            let (_, median, _) = all.select_nth_unstable_by(middle, f32::total_cmp);
            (*low, *high) = (*median - SPREAD_PX, *median + SPREAD_PX);
        }
    }
}

#[inline(always)]
fn add_loop(terms: &[Vec<f32>; TERMS], w: &[f32], sums: &mut [Vec<f32>; TERMS + 2]) {
    let valid = &terms[0];
    let (terms_to, rest) = sums.split_at_mut(TERMS);
    for (to, term) in terms_to.iter_mut().zip(terms) {
        for ((to, &v), &valid) in to.iter_mut().zip(term).zip(valid) {
            *to += v * valid;
        }
    }
    let (disparity, slope) = rest.split_at_mut(1);
    for ((to, &w), &valid) in disparity[0].iter_mut().zip(w).zip(valid) {
        *to += if valid > 0.5 { w } else { 0.0 };
    }
    let inner = slope[0].iter_mut().skip(2).zip(valid.iter().skip(2));
    for (((to, &valid), &before), &after) in inner.zip(w).zip(w.iter().skip(4)) {
        let slope = 0.25 * (after - before);
        // False for NaN: such pixels count as level.
        let good = slope.abs() < SLOPE_MAX && valid > 0.5;
        *to += if good { slope } else { 0.0 };
    }
}

/// Each term's sum over the pixels of a block from column `from`.
#[inline(always)]
pub(super) fn total_loop(sums: &[Vec<f32>], from: usize, totals: &mut [f64]) {
    for (total, sum) in totals.iter_mut().zip(sums) {
        // Rows are a multiple of the block long. Eight sums side by side do not wait for each other.
        let Some(pixels) = sum[from..].first_chunk::<BLOCK>() else { continue };
        let eight: [f64; 8] =
            std::array::from_fn(|i| f64::from(pixels[i]) + f64::from(pixels[i + 8]));
        *total = eight.into_iter().sum();
    }
}

/// The rate from a block's sums.
fn solve(sums: [f64; TERMS + 2], frames: usize) -> Block {
    let [n, l, ll, g, gg, il, i, ig, ilt, it, igt, s, st, stt, w, slope] = sums;
    if n < f64::from(PIXELS_MIN) {
        return Block::default();
    }
    let samples = n * frames as f64;
    let unit = f64::from(SQUARE_UNIT);
    let (variance_l, variance_g) = (ll * unit - l * l / samples, gg * unit - g * g / samples);
    let dark = f64::from(DARK) * samples;
    let disparity_px = (w / n) as f32;
    // The part of S t^2 that a shift of all frames does not explain.
    let weight = stt - st * st / s;
    if variance_l < dark || variance_g < dark || weight.is_nan() || weight <= 0.0 {
        return Block { disparity_px, ..Block::default() };
    }
    let ratio = (variance_l / variance_g).sqrt();
    let offset = (l - ratio * g) / samples;
    let b = il - offset * i - ratio * ig;
    let bt = ilt - offset * it - ratio * igt;
    let rate = -(1.0 - slope / n) * (bt - st / s * b) / weight;
    Block { rate: rate as f32, weight: weight as f32, disparity_px }
}
