//! The fast path: coarse search by descriptors, then dense least squares.

use rayon::prelude::*;

use crate::{
    Image, Level, Params, ShapeFunction, StereoStack,
    coarse::{Coarse, CoarseMap, INVALID},
    dense::{
        DenseFit, DenseMaps, mark_steps,
        motion::MotionFit,
        order::{OrderChoice, accept},
    },
    regions::Regions,
};

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
    motion: MotionFit,
    maps: DenseMaps,
    order: OrderChoice,
    regions: Regions,
}

/// Maps of a frame on the left canvas, NaN together.
pub(crate) struct Found {
    pub disparity: Image<f32>,
    pub zncc: Image<f32>,
    /// Rate of the disparity in px per second, or per frame where the stack has no times.
    pub rate: Option<Image<f32>>,
}

impl Fast {
    pub(crate) fn new(level: Level, params: &Params) -> Self {
        let a = &params.advanced;
        Self {
            level,
            params: params.clone(),
            coarse: Coarse::new(level, params.disparity),
            map: CoarseMap::new(0, 0),
            start: Image::new(0, 0, f32::NAN),
            step: Image::new(0, 0, 0),
            fit: DenseFit::new(level, a.subset_radius, params.shape, a.surface_px),
            motion: MotionFit::new(level),
            maps: DenseMaps::new(0, 0),
            order: OrderChoice::default(),
            regions: Regions::default(),
        }
    }

    /// Disparity, ZNCC and rate of a checked stack; `done` is told the name of each stage at its end.
    pub(crate) fn run(
        &mut self,
        stack: &StereoStack<'_>,
        mut done: impl FnMut(&'static str),
    ) -> Found {
        let (width, height) = (stack.width(), stack.height());
        if (self.start.width(), self.start.height()) != (width, height) {
            self.start = Image::new(width, height, f32::NAN);
        }
        self.coarse.describe(stack);
        done("describe");
        self.coarse.search(stack, true, &mut self.map);
        done("search");
        begin(stack, &self.map, &mut self.start);
        self.regions.remove(&mut self.start, self.params.advanced.region_min);
        mark_steps(
            self.level,
            &self.start,
            self.params.advanced.subset_radius,
            self.params.advanced.surface_px,
            &mut self.step,
        );
        done("steps");
        self.fit.fit(stack, &self.start, &self.step, &mut self.maps);
        done("dense");
        let rate = if self.params.motion {
            let rate =
                self.motion.run(stack, &mut self.fit, &self.start, &self.step, &mut self.maps);
            done("motion");
            Some(rate.unwrap_or_else(|| Image::new(width, height, 0.0)))
        } else {
            None
        };
        let mut disparity = Image::new(width, height, f32::NAN);
        let zncc_min = self.params.zncc_min;
        let DenseMaps { first_px, second_px, zncc } = &mut self.maps;
        match self.params.shape {
            ShapeFunction::First => accept(first_px, zncc_min, zncc, &mut disparity),
            ShapeFunction::Second => accept(second_px, zncc_min, zncc, &mut disparity),
            ShapeFunction::Auto => {
                self.order.choose(self.level, zncc_min, &mut self.maps, &mut disparity);
            }
        }
        done("order");
        self.regions.remove(&mut disparity, self.params.advanced.region_min);
        let mut zncc = self.maps.zncc.clone();
        for (z, d) in zncc.as_mut_slice().iter_mut().zip(disparity.as_slice()) {
            *z = if d.is_nan() { f32::NAN } else { *z };
        }
        let rate = rate.map(|mut rate| {
            for (v, d) in rate.as_mut_slice().iter_mut().zip(disparity.as_slice()) {
                *v = if d.is_nan() { f32::NAN } else { *v };
            }
            rate
        });
        done("regions");
        Found { disparity, zncc, rate }
    }
}

/// The coarse map as the fit's start, without what the masks exclude.
fn begin(stack: &StereoStack<'_>, map: &CoarseMap, start: &mut Image<f32>) {
    let width = stack.width();
    start.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(y, start)| {
        let row = map.disparity.row(y);
        for (to, &d) in start.iter_mut().zip(row) {
            *to = if d == INVALID { f32::NAN } else { f32::from(d) };
        }
        if let Some(mask) = stack.left_mask {
            for (to, &seen) in start.iter_mut().zip(mask.row(y)) {
                *to = if seen == 0 { f32::NAN } else { *to };
            }
        }
        if let Some(mask) = stack.right_mask {
            let mask = mask.row(y);
            for (x, to) in start.iter_mut().enumerate().filter(|(_, to)| !to.is_nan()) {
                // The search gives only disparities with a counterpart inside the image.
                let seen = mask.get((x as f32 - *to) as usize).copied().unwrap_or(0);
                *to = if seen == 0 { f32::NAN } else { *to };
            }
        }
    });
}
