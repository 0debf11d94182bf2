//! The fast path: coarse search by descriptors, then dense least squares.

mod pace;

use rayon::prelude::*;

use crate::{
    Image, Level, Matched, Params, ShapeFunction, StereoStack,
    coarse::{Coarse, CoarseMap, INVALID},
    dense::{
        DenseFit, DenseMaps, mark_steps,
        motion::{FRAMES_MIN, MotionFit},
        order::{OrderChoice, accept},
        settle::Settle,
    },
    lanes::vectorised,
    parallel::Share,
    regions::Regions,
};

/// Rows of a task.
const BAND: usize = 32;

/// Buffers and stages of [`crate::Method::Dense`], kept between frames.
#[derive(Debug)]
pub(crate) struct Fast {
    level: Level,
    params: Params,
    coarse: Coarse,
    map: CoarseMap,
    start: Image<f32>,
    step: Image<u8>,
    fit: DenseFit,
    settle: Settle,
    motion: MotionFit,
    maps: DenseMaps,
    order: OrderChoice,
    regions: Regions,
    trial: pace::Trial,
}

impl Fast {
    pub(crate) fn new(level: Level, params: &Params) -> Self {
        let a = &params.advanced;
        Self {
            level: level.usable(),
            params: params.clone(),
            coarse: Coarse::new(level, params.disparity),
            map: CoarseMap::new(0, 0),
            start: Image::new(0, 0, f32::NAN),
            step: Image::new(0, 0, 0),
            fit: DenseFit::new(level, a.subset_radius, params.shape, a.surface_px),
            settle: Settle::new(level),
            motion: MotionFit::new(level),
            maps: DenseMaps::new(0, 0),
            order: OrderChoice::default(),
            regions: Regions::new(level),
            trial: pace::Trial::new(level, params.disparity),
        }
    }

    pub(crate) fn set_shape(&mut self, shape: ShapeFunction) {
        self.params.shape = shape;
        self.fit.set_shape(shape);
    }

    /// Fills the maps of `out` from a checked stack; the rate is in px per second, or per frame where
    /// the stack has no times. `done` is told the name of each stage at its end.
    ///
    /// Where motion is estimated and turns out too fast for the frames given, the newest half of them
    /// is matched instead, and of these again; a scene too fast for three gives nothing.
    pub(crate) fn run(
        &mut self,
        stack: &StereoStack<'_>,
        out: &mut Matched,
        mut done: impl FnMut(&'static str),
    ) {
        let in_order = stack.times_s.is_none_or(|times| times.is_sorted());
        let all = stack.frames();
        let mut frames = all;
        loop {
            let part = pace::newest(stack, frames);
            self.once(&part, out, &mut done);
            if frames == all {
                // Of all frames, however many are matched.
                let brightness = out.brightness.get_or_insert_with(|| Image::new(0, 0, 0));
                std::mem::swap(brightness, &mut self.maps.brightness);
            }
            let rate = self.motion.found();
            if !self.params.motion || !in_order || all <= FRAMES_MIN {
                return;
            }
            let last = frames <= FRAMES_MIN;
            let fewer = if last { FRAMES_MIN - 1 } else { frames.div_ceil(2).max(FRAMES_MIN) };
            let found = (&out.disparity_px, rate);
            let too_fast = pace::travels(&part, found)
                || self.trial.loses(&part, &pace::newest(stack, fewer), found);
            if !too_fast {
                return;
            }
            if last {
                // Nothing rather than something wrong.
                let rates = out.rate_px_per_s.iter_mut();
                for map in [&mut out.disparity_px, &mut out.zncc].into_iter().chain(rates) {
                    map.as_mut_slice().fill(f32::NAN);
                }
                return;
            }
            frames = fewer;
        }
    }

    /// One match of a stack.
    fn once(
        &mut self,
        stack: &StereoStack<'_>,
        out: &mut Matched,
        mut done: impl FnMut(&'static str),
    ) {
        let (width, height) = (stack.width(), stack.height());
        if (self.start.width(), self.start.height()) != (width, height) {
            self.start = Image::new(width, height, f32::NAN);
        }
        self.coarse.describe(stack);
        done("describe");
        self.coarse.search(stack, true, &mut self.map);
        done("search");
        begin(self.level, stack, &self.map, &mut self.start);
        self.regions.remove(&mut self.start, self.params.advanced.region_min);
        mark_steps(
            self.level,
            &self.start,
            self.params.advanced.subset_radius,
            self.params.advanced.surface_px,
            &mut self.step,
        );
        done("steps");
        self.fit.set_watching(self.params.motion);
        self.fit.fit(stack, &self.start, &self.step, &mut self.maps);
        done("dense");
        if self.params.advanced.settle_steps {
            let Self { settle, start, step, maps, .. } = self;
            let both = self.params.shape != ShapeFunction::First;
            settle.run(stack, (self.params.zncc_min, both), step, start, maps);
            done("settle");
        }
        if self.params.motion {
            self.motion.run(stack, &mut self.fit, &self.start, &self.step, &mut self.maps);
            done("motion");
        }
        let rate = self.motion.found();
        for map in [&mut out.disparity_px, &mut out.zncc] {
            fit_size(map, width, height);
        }
        let disparity = &mut out.disparity_px;
        let zncc_min = self.params.zncc_min;
        let DenseMaps { first_px, second_px, zncc, .. } = &mut self.maps;
        match self.params.shape {
            ShapeFunction::First => accept(first_px, zncc_min, zncc, disparity),
            ShapeFunction::Second => accept(second_px, zncc_min, zncc, disparity),
            ShapeFunction::Auto => {
                self.order.choose(self.level, zncc_min, &mut self.maps, disparity);
            }
        }
        done("order");
        self.regions.remove(disparity, self.params.advanced.region_min);
        invalid_together(self.level, disparity, Some(&self.maps.zncc), &mut out.zncc);
        if self.params.motion && stack.times_s.is_some() {
            let rates = out.rate_px_per_s.get_or_insert_with(|| Image::new(0, 0, 0.0));
            fit_size(rates, width, height);
            invalid_together(self.level, disparity, rate, rates);
        } else {
            out.rate_px_per_s = None;
        }
        done("regions");
    }
}

fn fit_size(map: &mut Image<f32>, width: usize, height: usize) {
    if (map.width(), map.height()) != (width, height) {
        *map = Image::new(width, height, f32::NAN);
    }
}

/// Copies `from`, or zeros, to where the disparity is valid, and NaN elsewhere.
fn invalid_together(
    level: Level,
    disparity: &Image<f32>,
    from: Option<&Image<f32>>,
    to: &mut Image<f32>,
) {
    let band = BAND * to.width().max(1);
    let bands = to.as_mut_slice().par_chunks_mut(band);
    bands.zip(disparity.as_slice().par_chunks(band)).enumerate().share(|(k, (to, disparity))| {
        vectorised!(
            level,
            together_loop(
                disparity: &[f32] = disparity,
                from: Option<&[f32]> = from.map(|from| &from.as_slice()[k * band..]),
                to: &mut [f32] = to,
            )
        );
    });
}

#[inline(always)]
fn together_loop(disparity: &[f32], from: Option<&[f32]>, to: &mut [f32]) {
    match from {
        Some(from) => {
            for ((to, v), d) in to.iter_mut().zip(from).zip(disparity) {
                *to = if d.is_nan() { f32::NAN } else { *v };
            }
        }
        None => {
            for (to, d) in to.iter_mut().zip(disparity) {
                *to = if d.is_nan() { f32::NAN } else { 0.0 };
            }
        }
    }
}

/// The coarse map as the fit's start, without what the masks exclude.
fn begin(level: Level, stack: &StereoStack<'_>, map: &CoarseMap, start: &mut Image<f32>) {
    let width = stack.width();
    start.as_mut_slice().par_chunks_mut(width * BAND).enumerate().share(|(band, rows)| {
        for (k, start) in rows.chunks_mut(width).enumerate() {
            let y = band * BAND + k;
            let right = stack.right_mask.map(|mask| mask.row(y));
            // A camera's part of a row is almost always in one piece.
            let (from, to) = right.map_or((0, width), ends);
            let pieces = right.filter(|mask| mask[from..to].contains(&0));
            vectorised!(
                level,
                begin_loop(
                    row: &[i16] = map.disparity.row(y),
                    left: Option<&[u8]> = stack.left_mask.map(|mask| mask.row(y)),
                    seen: (i32, i32) = (from as i32, to as i32),
                    start: &mut [f32] = start,
                )
            );
            let Some(mask) = pieces else { continue };
            for (x, to) in start.iter_mut().enumerate().filter(|(_, to)| !to.is_nan()) {
                // The search gives only disparities with a counterpart inside the image.
                let seen = mask.get((x as f32 - *to) as usize).copied().unwrap_or(0);
                *to = if seen == 0 { f32::NAN } else { *to };
            }
        }
    });
}

/// The first non-zero place of a mask, and the one after the last.
fn ends(mask: &[u8]) -> (usize, usize) {
    let from = mask.iter().position(|seen| *seen != 0).unwrap_or(0);
    let to = mask.iter().rposition(|seen| *seen != 0).map_or(from, |last| last + 1);
    (from, to)
}

/// Disparities with a counterpart in the columns `from..to` of the right row, where `left` is set.
#[inline(always)]
fn begin_loop(row: &[i16], left: Option<&[u8]>, (from, to): (i32, i32), start: &mut [f32]) {
    // By index: a counter zipped with slices is not vectorised.
    let n = start.len();
    let row = &row[..n];
    for x in 0..n {
        let d = row[x];
        let at = x as i32 - i32::from(d);
        let seen = (d != INVALID) & (at >= from) & (at < to);
        start[x] = if seen { f32::from(d) } else { f32::NAN };
    }
    if let Some(left) = left {
        for (start, &seen) in start.iter_mut().zip(left) {
            *start = if seen == 0 { f32::NAN } else { *start };
        }
    }
}
