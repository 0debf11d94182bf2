//! Sub-pixel refinement: Stereo-DIC by inverse-compositional Gauss-Newton (paper eq 7-19).

pub mod guess;
mod kernel;
pub mod prepare;
pub mod shape;
mod solve;
pub mod window;

use crate::{Image, Level, Params, ShapeFunction, zncc};
use guess::{CoarseMap, Guess, Guesser};
use kernel::Kernel;
use prepare::Prepared;
use shape::Shape;
use solve::Cholesky;
use window::Window;

/// Columns and rows that a task works through together: their subsets share cache lines.
const TILE: usize = 64;

/// How far a refined disparity may be from the initial guess. The coarse search is right to half a
/// pixel or wrong altogether; further away the subset has slid to another optimum.
pub const DRIFT_LIMIT_PX: f64 = 2.0;

/// A refined point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// Shape function at convergence; its u is minus the disparity.
    pub shape: Shape,
    /// Similarity 1 - ZNSSD / 2.
    pub zncc: f64,
    /// Iterations used.
    pub iterations: usize,
}

/// Refines single points of a prepared stack.
#[derive(Debug)]
pub struct Refiner<'a> {
    prepared: &'a Prepared,
    kernel: Kernel,
    guesser: Guesser,
    parameters: usize,
    convergence_px: f64,
    iterations_max: usize,
}

impl<'a> Refiner<'a> {
    /// A refiner with shape functions of first or second order.
    pub fn new(prepared: &'a Prepared, params: &Params, second: bool, level: Level) -> Self {
        let parameters = if second { 6 } else { 3 };
        let advanced = &params.advanced;
        Self {
            prepared,
            kernel: Kernel::new(level, prepared.kind, parameters),
            guesser: Guesser::new(
                advanced.subset_radius,
                parameters,
                advanced.surface_px,
                prepared,
            ),
            parameters,
            convergence_px: advanced.convergence_px,
            iterations_max: advanced.iterations_max,
        }
    }

    /// Guesses and refines the point (x, y); `part` is scratch.
    pub fn point(&self, map: &CoarseMap, x: usize, y: usize, part: &mut Window) -> Option<Refined> {
        match self.guesser.guess(map, self.prepared, x, y, part) {
            Guess::Full(shape) => self.refine(self.guesser.full(), x, y, shape),
            Guess::Part(shape) => self.refine(part, x, y, shape),
            Guess::None => None,
        }
    }

    /// Gauss-Newton from `start` (eq 15-17); `None` when it does not converge or the subset has no
    /// texture.
    pub fn refine(&self, window: &Window, x: usize, y: usize, start: Shape) -> Option<Refined> {
        let n = (window.count() * self.prepared.frames) as f64;
        let reference = self.kernel.reference(self.prepared, window, x, y);
        let mean_l = reference.l / n;
        let norm_l = zncc::norm(reference.l, reference.ll, n)?;
        let mut hessian = reference.hessian;
        for (k, row) in hessian.iter_mut().enumerate().skip(self.parameters) {
            row[k] = 1.0;
        }
        let factor = Cholesky::new(hessian)?;
        // Positions are relative to the whole column that the start points to, which keeps them short
        // enough for single precision.
        let base = (x as f64 + start.0[0]).floor();
        if !(base >= 0.0 && base < self.prepared.width as f64) {
            return None;
        }
        let offset = base - x as f64;
        let mut shape = start;
        for iteration in 1..=self.iterations_max {
            let mut t = shape.0.map(|p| p as f32);
            t[0] = (shape.0[0] - offset) as f32;
            let sums = self.kernel.warp(self.prepared, window, (x, y), base as i64, t);
            let (g, gg, lg) = (sums.g as f64, sums.gg as f64, sums.lg as f64);
            let mean_g = g / n;
            let norm_g = zncc::norm(g, gg, n)?;
            let scale = norm_l / norm_g;
            let residual = std::array::from_fn(|k| {
                let left = reference.il[k] - mean_l * reference.i[k];
                let right = sums.ig[k] as f64 - mean_g * reference.i[k];
                scale * right - left
            });
            let step = Shape(factor.solve(residual));
            shape = shape.compose_inverse(&step)?;
            let drift = (shape.0[0] - start.0[0]).abs();
            // Written so that NaN fails too.
            let near = drift <= DRIFT_LIMIT_PX && shape.norm().is_finite();
            if !near {
                return None;
            }
            if step.norm() <= self.convergence_px {
                let zncc = (lg - mean_l * g) / (norm_l * norm_g);
                return Some(Refined { shape, zncc, iterations: iteration });
            }
        }
        None
    }
}

/// Refines every pixel with a coarse disparity; NaN where that fails or the ZNCC is too low.
pub fn refine_map(
    prepared: &Prepared,
    map: &CoarseMap,
    params: &Params,
    level: Level,
) -> (Image<f32>, Image<f32>) {
    use rayon::prelude::*;

    let (width, height) = (prepared.width, prepared.height);
    let second = params.shape != ShapeFunction::First;
    let refiner = Refiner::new(prepared, params, second, level);
    let mut disparity_px = Image::new(width, height, f32::NAN);
    let mut zncc = Image::new(width, height, f32::NAN);
    let band = width * 16;
    disparity_px
        .as_mut_slice()
        .par_chunks_mut(band)
        .zip(zncc.as_mut_slice().par_chunks_mut(band))
        .enumerate()
        .for_each_init(Window::empty, |part, (b, (disparity, zncc))| {
            for first in (0..width).step_by(TILE) {
                for row in 0..disparity.len() / width {
                    for x in first..(first + TILE).min(width) {
                        let y = b * 16 + row;
                        if map.at(x, y).is_nan() {
                            continue;
                        }
                        let Some(refined) = refiner.point(map, x, y, part) else { continue };
                        if refined.zncc as f32 >= params.zncc_min {
                            disparity[row * width + x] = -refined.shape.0[0] as f32;
                            zncc[row * width + x] = refined.zncc as f32;
                        }
                    }
                }
            }
        });
    (disparity_px, zncc)
}
