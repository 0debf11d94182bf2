//! Depth steps of the fast path: the pixels' own grey values decide which surface they show, and the
//! windows that this changes are fitted once more over the judged surfaces.

use rayon::prelude::*;

use super::{DenseFit, DenseMaps, mark_steps, motion::BLOCK};
use crate::{
    Image, Level, StereoStack,
    step::{FRAMES_MIN, StepJudge, Verdict},
};

/// What a verdict changes: the two fits' windows, each of the radius, read it.
const WINDOWS: usize = 2;

/// Settles depth steps; keeps its buffers between frames.
#[derive(Debug)]
pub struct Settle {
    level: Level,
    radius: usize,
    surface_px: f32,
    judge: StepJudge,
    judged: Image<f32>,
    verdicts: Image<Verdict>,
    again: Image<bool>,
}

impl Settle {
    /// For fits with windows of `radius`, whose pixels differ from the centre's by `surface_px` at most.
    pub fn new(level: Level, radius: usize, surface_px: f32) -> Self {
        Self {
            level,
            radius,
            surface_px,
            judge: StepJudge::new(level),
            judged: Image::new(0, 0, f32::NAN),
            verdicts: Image::new(0, 0, Verdict::Kept),
            again: Image::new(0, 0, false),
        }
    }

    /// Judges a coarse start, so that the fit's windows hold less of other surfaces.
    pub fn begin(&mut self, stack: &StereoStack<'_>, start: &mut Image<f32>) {
        if stack.frames() >= FRAMES_MIN {
            self.resize(stack);
            self.judge.judge(stack, start, &mut self.verdicts);
        }
    }

    /// Judges the first-order fit in `maps`, made by `fit` of `start` and `step`; points of a ZNCC below
    /// `zncc_min` are no surface. Where pixels change surface or show none, `start` and `step` are
    /// changed and the windows around fitted again. Does nothing with too few frames.
    pub fn run(
        &mut self,
        stack: &StereoStack<'_>,
        zncc_min: f32,
        fit: &mut DenseFit,
        start: &mut Image<f32>,
        step: &mut Image<u8>,
        maps: &mut DenseMaps,
    ) {
        if stack.frames() < FRAMES_MIN {
            return;
        }
        self.resize(stack);
        let width = stack.width();
        let rows = self.judged.as_mut_slice().par_chunks_mut(width).enumerate();
        rows.for_each(|(y, row)| {
            let found = maps.first_px.row(y).iter().zip(maps.zncc.row(y));
            for (to, (&d, &z)) in row.iter_mut().zip(found) {
                *to = if z >= zncc_min { d } else { f32::NAN };
            }
        });
        self.judge.judge(stack, &mut self.judged, &mut self.verdicts);
        if !self.take(start) {
            return;
        }
        mark_steps(self.level, start, self.radius, self.surface_px, step);
        fit.refit(stack, start, step, None, &self.again, maps);
    }

    fn resize(&mut self, stack: &StereoStack<'_>) {
        let (width, height) = (stack.width(), stack.height());
        if (self.judged.width(), self.judged.height()) != (width, height) {
            self.judged = Image::new(width, height, f32::NAN);
            self.verdicts = Image::new(width, height, Verdict::Kept);
            self.again = Image::new(width.div_ceil(BLOCK), height.div_ceil(BLOCK), false);
        }
    }

    /// Takes over what was judged, and marks the blocks that must be fitted again; whether there are
    /// any.
    fn take(&mut self, start: &mut Image<f32>) -> bool {
        let (width, height) = (start.width(), start.height());
        self.again.as_mut_slice().fill(false);
        let reach = WINDOWS * self.radius;
        let mut any = false;
        for y in 0..height {
            for (x, verdict) in self.verdicts.row(y).iter().enumerate() {
                if *verdict == Verdict::Kept {
                    continue;
                }
                any = true;
                start.row_mut(y)[x] = self.judged.row(y)[x];
                let columns = x.saturating_sub(reach) / BLOCK..=(x + reach).min(width - 1) / BLOCK;
                for row in y.saturating_sub(reach) / BLOCK..=(y + reach).min(height - 1) / BLOCK {
                    self.again.row_mut(row)[columns.clone()].fill(true);
                }
            }
        }
        any
    }
}
