//! Sub-pixel refinement: Stereo-DIC by inverse-compositional Gauss-Newton (paper eq 7-19).

pub mod field;
pub mod guess;
mod kernel;
pub mod prepare;
pub mod shape;
mod solve;
pub mod window;

use crate::{Level, Params, zncc};
use guess::{CoarseMap, Guess, Guesser};
use kernel::Kernel;
use prepare::Prepared;
use shape::Shape;
use solve::Cholesky;
use window::Window;

/// How far a refined disparity may be from the initial guess. The coarse search is right to half a
/// pixel or wrong altogether; further away the subset has slid to another optimum.
pub const DRIFT_LIMIT_PX: f64 = 2.0;

/// How far a grown pixel may be from its neighbour's prediction: it is to continue the surface.
pub const GROWTH_STEP_PX: f64 = 1.0;

/// Subsets with a smaller part of their square than this are fitted to first order: half a square
/// hardly tells curvature from slope.
const SECOND_ORDER_PART: f64 = 0.6;

/// A refined point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// Shape function at convergence; its u is minus the disparity.
    pub shape: Shape,
    /// Similarity 1 - ZNSSD / 2 of the subset.
    pub zncc: f64,
    /// Iterations used.
    pub iterations: usize,
}

/// Refines single points of a prepared stack.
#[derive(Debug)]
pub struct Refiner<'a> {
    prepared: &'a Prepared,
    /// Kernels of first and second order.
    kernels: [Kernel; 2],
    guesser: Guesser,
    second: bool,
    convergence_px: f64,
    iterations_max: usize,
    zncc_min: f64,
    surface_px: f32,
    /// Disparities that a point can have: the candidates, and as far beyond as they are refined.
    range_px: std::ops::RangeInclusive<f64>,
}

impl<'a> Refiner<'a> {
    /// A refiner with shape functions of first or second order.
    pub fn new(prepared: &'a Prepared, params: &Params, second: bool, level: Level) -> Self {
        let advanced = &params.advanced;
        let (radius, surface_px) = (advanced.subset_radius, advanced.surface_px);
        let parameters = if second { 6 } else { 3 };
        Self {
            prepared,
            kernels: [3, 6].map(|parameters| Kernel::new(level, prepared.kind, parameters)),
            guesser: Guesser::new(radius, parameters, surface_px, prepared, level),
            second,
            convergence_px: advanced.convergence_px,
            iterations_max: advanced.iterations_max,
            zncc_min: params.zncc_min as f64,
            surface_px,
            range_px: f64::from(params.disparity.min_px) - DRIFT_LIMIT_PX
                ..=f64::from(params.disparity.max_px) + DRIFT_LIMIT_PX,
        }
    }

    /// Guesses and refines the point (x, y), and accepts it when it is similar enough; `part` is
    /// scratch.
    pub fn point(&self, map: &CoarseMap, x: usize, y: usize, part: &mut Window) -> Option<Refined> {
        match self.guesser.guess(map, self.prepared, x, y, part) {
            Guess::Full(shape) => {
                let refined = self.refine(self.guesser.full(), x, y, shape)?;
                (refined.zncc >= self.zncc_min).then_some(refined)
            }
            Guess::Part(shape) => {
                let refined = self.refine(part, x, y, shape)?;
                self.belongs(map, x, y, &refined, part).then_some(refined)
            }
            Guess::None => None,
        }
    }

    /// Refines the point (x, y) of a gap from a neighbour's prediction.
    fn grown(
        &self,
        map: &CoarseMap,
        x: usize,
        y: usize,
        start: Shape,
        part: &mut Window,
    ) -> Option<Refined> {
        let refined = self.near(map, x, y, start, part)?;
        self.belongs(map, x, y, &refined, part).then_some(refined)
    }

    /// Refines the point (x, y) at a depth step once more, over the pixels that `map` has on its
    /// surface.
    fn refit(
        &self,
        map: &CoarseMap,
        x: usize,
        y: usize,
        start: Shape,
        part: &mut Window,
    ) -> Option<Refined> {
        self.near(map, x, y, start, part).filter(|refined| refined.zncc >= self.zncc_min)
    }

    /// Refines the point (x, y) from `start` over the pixels that `map` has on that surface; none when
    /// they are too few or the result is elsewhere.
    fn near(
        &self,
        map: &CoarseMap,
        x: usize,
        y: usize,
        start: Shape,
        part: &mut Window,
    ) -> Option<Refined> {
        self.guesser.select_near(map, self.prepared, (x, y), &start, part);
        if part.count() < 2 * self.guesser.radius() + 1 {
            return None;
        }
        let refined = self.refine(part, x, y, start)?;
        let near = (refined.shape.0[0] - start.0[0]).abs() <= GROWTH_STEP_PX;
        near.then_some(refined)
    }

    /// The first-order estimate of a point whose second-order one is `shape`, where the whole square
    /// belongs to the surface: elsewhere there is nothing to choose between.
    fn first_order(&self, map: &CoarseMap, x: usize, y: usize, shape: Shape) -> Option<Refined> {
        let mut start = shape;
        start.0[3..].fill(0.0);
        if !self.guesser.is_full(map, self.prepared, (x, y), &start) {
            return None;
        }
        let refined = self.iterate::<3>(self.guesser.full(), x, y, start)?;
        (refined.zncc >= self.zncc_min).then_some(refined)
    }

    /// Gauss-Newton from `start`, to second order where that is asked for, the subset is large enough
    /// and it converges, else to first order.
    pub fn refine(&self, window: &Window, x: usize, y: usize, start: Shape) -> Option<Refined> {
        let side = 2 * self.guesser.radius() + 1;
        let enough = window.count() as f64 >= SECOND_ORDER_PART * (side * side) as f64;
        if self.second
            && enough
            && let Some(refined) = self.iterate::<6>(window, x, y, start)
        {
            return Some(refined);
        }
        let mut start = start;
        start.0[3..].fill(0.0);
        self.iterate::<3>(window, x, y, start)
    }

    /// Gauss-Newton from `start` with K parameters (eq 15-17); `None` when it does not converge or the
    /// subset has no texture.
    fn iterate<const K: usize>(
        &self,
        window: &Window,
        x: usize,
        y: usize,
        start: Shape,
    ) -> Option<Refined> {
        let kernel = &self.kernels[K / 6];
        let n = (window.count() * self.prepared.frames) as f64;
        let reference = kernel.reference(self.prepared, window, x, y);
        let mean_l = reference.l / n;
        let norm_l = zncc::norm(reference.l, reference.ll, n)?;
        let hessian = std::array::from_fn(|k| std::array::from_fn(|j| reference.hessian[k][j]));
        let factor = Cholesky::<K>::new(hessian)?;
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
            let sums = kernel.warp(self.prepared, window, (x, y), base as i64, t);
            let (g, gg, lg) = (sums.g as f64, sums.gg as f64, sums.lg as f64);
            let mean_g = g / n;
            let norm_g = zncc::norm(g, gg, n)?;
            let scale = norm_l / norm_g;
            let residual = std::array::from_fn(|k| {
                let left = reference.il[k] - mean_l * reference.i[k];
                let right = sums.ig[k] as f64 - mean_g * reference.i[k];
                scale * right - left
            });
            let mut step = Shape::default();
            step.0[..K].copy_from_slice(&factor.solve(residual));
            shape = shape.compose_inverse(&step)?;
            let drift = (shape.0[0] - start.0[0]).abs();
            // Written so that NaN fails too.
            let near = drift <= DRIFT_LIMIT_PX
                && self.range_px.contains(&-shape.0[0])
                && shape.norm().is_finite();
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

    /// Whether the point itself, and not only its subset, is on the surface found.
    ///
    /// Near a depth step most of a subset can be on one surface and its centre on the other. The frames
    /// of the centre and its direct neighbours then do not agree with the right image at that disparity,
    /// whatever the subset's similarity.
    fn belongs(
        &self,
        map: &CoarseMap,
        x: usize,
        y: usize,
        refined: &Refined,
        scratch: &mut Window,
    ) -> bool {
        if refined.zncc < self.zncc_min {
            return false;
        }
        let shape = &refined.shape;
        // Enough samples that chance agreement is rare: at least 49, and 75 from three frames on. With
        // eight frames the point's own grey values over time decide alone: neighbours that are on the
        // surface would carry a point that is not.
        let (radius, least) = match self.prepared.frames {
            ..=2 => (3, LOCAL_ZNCC_MIN),
            3..=7 => (2, LOCAL_ZNCC_MIN),
            _ => (0, POINT_ZNCC_MIN),
        };
        scratch.select(radius, self.prepared, |dx, dy| {
            let (px, py) = (x as i64 + dx as i64, y as i64 + dy as i64);
            let inside = (0..self.prepared.width as i64).contains(&px)
                && (0..self.prepared.height as i64).contains(&py);
            inside && {
                let warped = x as f64 + shape.warp(dx as f64, dy as f64);
                let known = map.at(px as usize, py as usize);
                // A neighbour of another surface says nothing about this one.
                let other = (known as f64 - (px as f64 - warped)).abs() > self.surface_px as f64;
                (!other || (dx, dy) == (0, 0)) && self.prepared.right_sees(py as usize, warped)
            }
        });
        if scratch.count() == 0 {
            return false;
        }
        let kernel = &self.kernels[1];
        let n = (scratch.count() * self.prepared.frames) as f64;
        let left = kernel.reference(self.prepared, scratch, x, y);
        let base = (x as f64 + shape.0[0]).floor();
        if !(base >= 0.0 && base < self.prepared.width as f64) {
            return false;
        }
        let mut t = shape.0.map(|p| p as f32);
        t[0] = (shape.0[0] + x as f64 - base) as f32;
        let right = kernel.warp(self.prepared, scratch, (x, y), base as i64, t);
        let (g, gg) = (right.g as f64, right.gg as f64);
        let norms = zncc::norm(left.l, left.ll, n).zip(zncc::norm(g, gg, n));
        norms.is_some_and(|(l, r)| (right.lg as f64 - left.l * g / n) / (l * r) >= least)
    }
}

/// Least similarity of a point and its direct neighbours alone. On a rendered sphere before a plane, N =
/// 10: 0.45 leaves 0.041 % outliers at 99.64 % completeness, 0.6 leaves 0.028 % at 99.59 %, 0.7 leaves
/// 0.012 % at 99.54 %.
pub const LOCAL_ZNCC_MIN: f64 = 0.6;

/// Least similarity of a point alone over at least eight frames. Where steps are judged afterwards
/// ([`crate::step`]) a stricter limit loses more than it saves: on the simulated statue, N = 10, 0.6
/// leaves 0.033 % outliers at 95.57 % completeness, 0.75 leaves 0.036 % at 95.36 %.
pub const POINT_ZNCC_MIN: f64 = 0.6;
