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
pub(crate) mod job;
pub mod kernels;
pub(crate) mod moments;
pub mod motion;
pub(crate) mod normalise;
pub mod order;
pub(crate) mod refit;
mod rings;
mod sample;
pub mod settle;
pub(crate) mod solve;
mod steps;
pub(crate) mod tile;
pub(crate) mod warp;

use rayon::prelude::*;

use crate::{
    Image, Level, Sample, ShapeFunction, StereoStack,
    parallel::{self, Share},
};
use job::{BAND, Job, Output, columns, origin};
use motion::{BLOCK, Motion, along::Watch, sums::Blocks};
use solve::Fits;
pub use steps::mark_steps;
use tile::Tile;

/// Columns a tile fits. Narrower strips would keep a tile's rows in a core's second-level cache, but cost
/// more than that saves: memory gives short pieces of twenty images' rows slowly.
const STRIP: usize = 2048;
/// Bands of a run that are left to its thread: another would compute as many rows anew at their ends.
const LEFT: usize = 4;
/// Tasks of a thread where loops are rayon's: they let others take over what a busy core leaves.
const TASKS: usize = 4;

/// Largest radius of a window: 17 x 17 pixels.
pub const RADIUS_LIMIT: usize = 8;

/// The dense fit; keeps its buffers between frames.
#[derive(Debug)]
pub struct DenseFit {
    level: Level,
    radius: usize,
    shape: ShapeFunction,
    surface_px: f32,
    tiles: parallel::PerThread<Tile>,
    /// Number of fits made.
    stamp: u64,
    zero: Image<Sample>,
    /// Whether to look for motion along the way.
    watches: bool,
    /// What the last fit saw of it, if it did.
    seen: Blocks,
    saw: bool,
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
    /// Mean of the left images in grey levels of 8 bits.
    pub brightness: Image<u8>,
}

impl DenseMaps {
    /// Empty maps.
    pub fn new(width: usize, height: usize) -> Self {
        let map = || Image::new(width, height, f32::NAN);
        let brightness = Image::new(width, height, 0);
        Self { first_px: map(), second_px: map(), zncc: map(), brightness }
    }
}

impl DenseFit {
    /// A fit with windows of 2 `radius` + 1 pixels a side; `radius` is brought to
    /// 2..=[`RADIUS_LIMIT`].
    pub fn new(level: Level, radius: usize, shape: ShapeFunction, surface_px: f32) -> Self {
        Self {
            level: level.usable(),
            radius: radius.clamp(2, RADIUS_LIMIT),
            shape,
            surface_px,
            tiles: parallel::PerThread::default(),
            stamp: 0,
            zero: Image::new(0, 0, 0),
            watches: true,
            seen: Blocks::default(),
            saw: false,
        }
    }

    /// Whether the fit also makes the sums by which motion is found, without which
    /// [`motion::MotionFit`] makes them by itself; it does until told otherwise.
    pub fn set_watching(&mut self, watches: bool) {
        self.watches = watches;
    }

    /// What the last fit saw of motion, if it was one of a whole stack and looked for it.
    pub(crate) fn seen(&self) -> Option<&Blocks> {
        self.saw.then_some(&self.seen)
    }

    /// Changes the order of the shape function.
    pub(crate) fn set_shape(&mut self, shape: ShapeFunction) {
        self.shape = shape;
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
        if (out.brightness.width(), out.brightness.height()) != (width, height) {
            out.brightness = Image::new(width, height, 0);
        }
        self.run(stack, start, step, None, out);
    }

    /// Fits anew the blocks that are set in `again`, with `motion` if there is any, and leaves the others
    /// as they are.
    pub(crate) fn refit(
        &mut self,
        stack: &StereoStack<'_>,
        start: &Image<f32>,
        step: &Image<u8>,
        motion: Option<&Motion>,
        again: &Image<bool>,
        out: &mut DenseMaps,
    ) {
        self.run(stack, start, step, Some((motion, again)), out);
    }

    fn run(
        &mut self,
        stack: &StereoStack<'_>,
        start: &Image<f32>,
        step: &Image<u8>,
        again: Option<(Option<&Motion>, &Image<bool>)>,
        out: &mut DenseMaps,
    ) {
        let (width, height) = (stack.width(), stack.height());
        if (self.zero.width(), self.zero.height()) != (width, height) {
            self.zero = Image::new(width, height, 0);
        }
        let frames = stack.frames();
        let mut left = [&self.zero; 16];
        let mut right = [&self.zero; 16];
        left[..frames].copy_from_slice(stack.left);
        right[..frames].copy_from_slice(stack.right);
        let even = frames.next_multiple_of(2);
        self.stamp += 1;
        let job = Job {
            level: self.level,
            stamp: self.stamp,
            left: &left[..even],
            right: &right[..even],
            frames,
            start,
            step,
            radius: self.radius,
            fits: if self.shape == ShapeFunction::First { Fits::First } else { Fits::Both },
            surface_px: self.surface_px,
            origin: origin(start),
            motion: again.and_then(|(motion, _)| motion),
            watch: Watch::of(stack).filter(|_| self.watches && again.is_none()),
        };
        self.saw = job.watch.is_some();
        self.seen.begin(width, height);
        let tiles = self.tiles.ready();
        let (threads, shared) = (parallel::threads(), parallel::is_shared());
        // Results do not depend on where bands end, as long as they hold whole blocks.
        let band_rows = match again {
            None if shared => BLOCK,
            None => height.div_ceil(TASKS * threads).max(BAND).next_multiple_of(BLOCK),
            Some(_) => BAND,
        };
        let rows = width * band_rows;
        let blocks = self.seen.columns * (band_rows / BLOCK);
        let DenseMaps { first_px, second_px, zncc, brightness } = out;
        first_px
            .as_mut_slice()
            .par_chunks_mut(rows)
            .zip(second_px.as_mut_slice().par_chunks_mut(rows))
            .zip(zncc.as_mut_slice().par_chunks_mut(rows))
            .zip(brightness.as_mut_slice().par_chunks_mut(rows))
            .zip(self.seen.blocks.par_chunks_mut(blocks))
            .enumerate()
            .share_runs(LEFT, |(band, ((((first, second), zncc), brightness), blocks))| {
                // Fits made anew leave it as it is.
                let brightness = again.is_none().then_some(brightness);
                let mut out = Output { first, second, zncc, brightness, blocks };
                tiles.with(|tile| {
                    let mut fit = |(from, to): (usize, usize)| {
                        let strips = (to - from).div_ceil(STRIP);
                        for strip in 0..strips {
                            let part = |k: usize| match k == strips {
                                true => to,
                                false => from + (to - from) * k / strips / BLOCK * BLOCK,
                            };
                            let columns = (part(strip), part(strip + 1));
                            tile.run(&job, columns, band * band_rows, &mut out);
                        }
                    };
                    match again {
                        None => fit((0, width)),
                        Some((_, again)) => columns(width, band, again).into_iter().for_each(fit),
                    }
                });
            });
    }
}
