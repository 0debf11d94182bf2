//! Depth steps of the fast path: the pixels' own grey values decide which surface they show.
//!
//! The dense fit is judged once. What shows another surface than its window gets that surface's
//! disparity, continued to it; what shows none is no point. Fitting the windows around anew brought 2 to
//! 5 % in the RMS at half of this stage's cost again, and judging the coarse map before the fit lost twice
//! as many points as it mended: whole pixels tell surfaces apart badly on slopes.

use rayon::prelude::*;

use super::{DenseMaps, sample::SampledMedian};
use crate::{
    Image, Level, StereoStack,
    lanes::vectorised,
    parallel::Share,
    step::{BLOCK, FRAMES_MIN, Limits, Samples, StepJudge, for_columns},
};

/// Coarse windows reach up to five pixels beyond a silhouette that nothing lit lies behind.
const LIMITS: Limits =
    Limits { passes: 6, similarity_min: 0.84, light_min: 0.0, next_light_min: 0.37 };

/// Where the two orders differ by more, the second is judged: the first one's window is too coarse.
const FINE_PX: f32 = 0.03;

/// Least similarity over time of a single pixel near a step and its place in the right images, at the end:
/// what a window gave to a pixel that shows something else is wrong by millimetres. A hundred such points of
/// 284 000, most of them dark, made half of the squared error of the simulated part...
const OWN_SIMILARITY_MIN: f32 = 0.75;
/// ...but where the light is weak, noise takes as much from a pixel that is right: it may lack so many times
/// the loss of ZNCC that windows of the whole image have in the median.
const OWN_LOSS: f32 = 8.0;

/// Settles depth steps; keeps its buffers between frames.
#[derive(Debug)]
pub struct Settle {
    judge: StepJudge,
    judged: Image<f32>,
    /// Blocks with steps, and these with the blocks around.
    blocks: Image<bool>,
    around: Image<bool>,
    level: Level,
    losses: SampledMedian,
}

impl Settle {
    /// With the kernels of `level`.
    pub fn new(level: Level) -> Self {
        Self {
            judge: StepJudge::new(level).with_limits(LIMITS),
            judged: Image::new(0, 0, f32::NAN),
            blocks: Image::new(0, 0, false),
            around: Image::new(0, 0, false),
            level: level.usable(),
            losses: SampledMedian::default(),
        }
    }

    /// Judges the fit in `maps` where `step` marks windows that hold a step; points of a ZNCC below
    /// `zncc_min` are no surface. Changes the disparities of `maps`, of both orders if `both` were
    /// fitted, and those that the fit started from. Does nothing with too few frames.
    pub fn run(
        &mut self,
        stack: &StereoStack<'_>,
        (zncc_min, both): (f32, bool),
        step: &Image<u8>,
        start: &mut Image<f32>,
        maps: &mut DenseMaps,
    ) {
        if stack.frames() < FRAMES_MIN {
            return;
        }
        let (width, height) = (stack.width(), stack.height());
        if (self.judged.width(), self.judged.height()) != (width, height) {
            self.judged = Image::new(width, height, f32::NAN);
            self.blocks = Image::new(width.div_ceil(BLOCK), height.div_ceil(BLOCK), false);
            self.around = self.blocks.clone();
        }
        self.mark_blocks(step);
        let around = &self.around;
        let rows = self.judged.as_mut_slice().par_chunks_mut(width).enumerate();
        rows.share(|(y, row)| {
            for_columns(Some(around), y, width, |from, to| {
                let found = maps.first_px.row(y)[from..to].iter().zip(&maps.zncc.row(y)[from..to]);
                for (to, (&d, &z)) in row[from..to].iter_mut().zip(found) {
                    *to = if z >= zncc_min { d } else { f32::NAN };
                }
                if both {
                    let second = &maps.second_px.row(y)[from..to];
                    for (to, &d) in row[from..to].iter_mut().zip(second) {
                        *to = if (d - *to).abs() > FINE_PX { d } else { *to };
                    }
                }
            });
        });
        for &i in self.judge.change(stack, &mut self.judged, Some(&self.blocks)) {
            let i = i as usize;
            let to = self.judged.as_slice()[i];
            start.as_mut_slice()[i] = to;
            maps.first_px.as_mut_slice()[i] = to;
            maps.second_px.as_mut_slice()[i] = to;
        }
        self.verify(stack, start, maps);
    }

    /// Takes away the points near steps whose own grey values do not agree with their place.
    fn verify(&mut self, stack: &StereoStack<'_>, start: &mut Image<f32>, maps: &mut DenseMaps) {
        let width = stack.width();
        let least = self.own_similarity_min(&maps.zncc);
        let (samples, level) = (Samples::new(stack), self.level);
        let (judged, blocks) = (&self.judged, &self.around);
        let near = self.judge.near_in(blocks);
        let starts = start.as_mut_slice().par_chunks_mut(width);
        let rows = maps.first_px.as_mut_slice().par_chunks_mut(width);
        let rows = rows.zip(maps.second_px.as_mut_slice().par_chunks_mut(width)).zip(starts);
        rows.enumerate().share(|(y, ((first, second), start))| {
            for_columns(Some(blocks), y, width, |from, to| {
                vectorised!(
                    level,
                    verify_loop(
                        samples: &Samples<'_> = &samples,
                        at: (usize, usize) = (from, y),
                        least: f32 = least,
                        found: (&[f32], &[u8]) =
                            (&judged.row(y)[from..to], &near.row(y)[from..to]),
                        maps: [&mut [f32]; 3] =
                            [&mut first[from..to], &mut second[from..to], &mut start[from..to]],
                    )
                );
            });
        });
    }

    /// The least similarity that a single pixel needs, by the noise of the whole image.
    fn own_similarity_min(&mut self, zncc: &Image<f32>) -> f32 {
        let zncc = zncc.as_slice();
        let loss = self.losses.of(zncc.len(), |i| 1.0 - zncc[i]);
        loss.map_or(OWN_SIMILARITY_MIN, |loss| OWN_SIMILARITY_MIN.min(1.0 - OWN_LOSS * loss))
    }

    /// Marks the blocks that hold a step, and the blocks around.
    fn mark_blocks(&mut self, step: &Image<u8>) {
        let (columns, rows) = (self.blocks.width(), self.blocks.height());
        self.blocks.as_mut_slice().par_chunks_mut(columns).enumerate().share(|(row, set)| {
            set.fill(false);
            for y in row * BLOCK..((row + 1) * BLOCK).min(step.height()) {
                for (set, marks) in set.iter_mut().zip(step.row(y).chunks(BLOCK)) {
                    *set |= marks.iter().fold(0, |any, mark| any | mark) != 0;
                }
            }
        });
        self.around.as_mut_slice().fill(false);
        for row in 0..rows {
            for column in (0..columns).filter(|&column| self.blocks.row(row)[column]) {
                for y in row.saturating_sub(1)..(row + 2).min(rows) {
                    let across = column.saturating_sub(1)..(column + 2).min(columns);
                    self.around.row_mut(y)[across].fill(true);
                }
            }
        }
    }
}

/// Makes NaN what `maps` have where `found` has a disparity, and a mark, and the grey values at both places
/// are less similar than `least`; where the right camera's view ends, nothing is said.
#[inline(always)]
fn verify_loop(
    samples: &Samples<'_>,
    (from, y): (usize, usize),
    least: f32,
    (disparity_px, marks): (&[f32], &[u8]),
    maps: [&mut [f32]; 3],
) {
    let [first, second, start] = maps;
    for (k, (&d, &mark)) in disparity_px.iter().zip(marks).enumerate() {
        if mark == 0 || d.is_nan() {
            continue;
        }
        if samples.signature(from + k, y, d).is_some_and(|s| s.similarity() < least) {
            (first[k], second[k], start[k]) = (f32::NAN, f32::NAN, f32::NAN);
        }
    }
}
