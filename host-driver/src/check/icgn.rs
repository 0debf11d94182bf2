//! Two-dimensional digital image correlation of a window over all frames: inverse-compositional
//! Gauss-Newton with a first-order shape function (u, ux, uy, v, vx, vy), in double precision.
//!
//! The criterion is the zero-mean normalised sum of squared differences of the window's pixels in all
//! frames together, as in the paper's refinement (eq 7-17), which leaves v out.

use nalgebra::{Matrix3, Matrix6, Vector6};

use super::spline::Piece;
use crate::reconstruct::RectifiedStack;

/// Steps of a refinement.
const STEPS_MAX: usize = 25;
/// Step, in px at the window's rim, at which it ends.
const CONVERGED_PX: f64 = 1e-4;

/// First-order shape function: where the pixel (dx, dy) from the window's middle goes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Affine {
    /// Displacement along the row.
    pub u: f64,
    /// Its derivatives.
    pub ux: f64,
    /// See `ux`.
    pub uy: f64,
    /// Displacement across the rows.
    pub v: f64,
    /// Its derivatives.
    pub vx: f64,
    /// See `vx`.
    pub vy: f64,
}

impl Affine {
    fn from_vector(p: &Vector6<f64>) -> Self {
        Self { u: p[0], ux: p[1], uy: p[2], v: p[3], vx: p[4], vy: p[5] }
    }

    fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(1.0 + self.ux, self.uy, self.u, self.vx, 1.0 + self.vy, self.v, 0.0, 0.0, 1.0)
    }

    /// This warp after the inverse of the step: W(p) o W(dp)^-1.
    fn compose_inverse(&self, step: &Self) -> Option<Self> {
        let m = self.matrix() * step.matrix().try_inverse()?;
        Some(Self {
            u: m[(0, 2)],
            ux: m[(0, 0)] - 1.0,
            uy: m[(0, 1)],
            v: m[(1, 2)],
            vx: m[(1, 0)],
            vy: m[(1, 1)] - 1.0,
        })
    }

    fn warp(&self, dx: f64, dy: f64) -> (f64, f64) {
        (dx + self.u + self.ux * dx + self.uy * dy, dy + self.v + self.vx * dx + self.vy * dy)
    }
}

/// A refined window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// Where it went.
    pub affine: Affine,
    /// Similarity.
    pub zncc: f64,
}

/// The pixels of a window in all frames: left values and derivatives.
struct Reference {
    /// (dx, dy) of each pixel.
    places: Vec<(f64, f64)>,
    /// `[frame][pixel]` zero-mean values and derivatives.
    values: Vec<f64>,
    slopes: Vec<(f64, f64)>,
    norm: f64,
}

/// Pixels around a window that its spline needs, and that it may move by.
const MARGIN: i64 = 6;

fn pieces(
    images: &[stspp_matcher::Image<stspp_matcher::Sample>],
    (x, y): (i64, i64),
    reach: i64,
) -> Option<Vec<Piece>> {
    let (width, height) = (images.first()?.width() as i64, images.first()?.height() as i64);
    let (left, top) = (x - reach, y - reach);
    let side = 2 * reach + 1;
    if left < 0 || top < 0 || left + side > width || top + side > height {
        return None;
    }
    let piece = |image: &stspp_matcher::Image<stspp_matcher::Sample>| {
        Piece::new((left, top), side as usize, side as usize, |x, y| {
            f64::from(image.row(y as usize)[x as usize]) / f64::from(stspp_matcher::SAMPLES_PER_DN8)
        })
    };
    Some(images.iter().map(piece).collect())
}

impl Reference {
    fn new(stack: &RectifiedStack, (x, y): (usize, usize), radius: usize) -> Option<Self> {
        let radius = radius as i64;
        let pieces = pieces(&stack.left, (x as i64, y as i64), radius + MARGIN)?;
        let mut places = Vec::new();
        for dy in -radius..=radius {
            places.extend((-radius..=radius).map(|dx| (dx as f64, dy as f64)));
        }
        let (mut values, mut slopes) = (Vec::new(), Vec::new());
        for piece in &pieces {
            for (dx, dy) in &places {
                let (value, by_x, by_y) = piece.at(x as f64 + dx, y as f64 + dy)?;
                values.push(value);
                slopes.push((by_x, by_y));
            }
        }
        let norm = centre(&mut values)?;
        Some(Self { places, values, slopes, norm })
    }
}

/// Takes the mean away; the norm of what is left, `None` for a plain window.
fn centre(values: &mut [f64]) -> Option<f64> {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.iter_mut().for_each(|v| *v -= mean);
    let norm = values.iter().map(|v| v * v).sum::<f64>().sqrt();
    // Half a grey value of contrast is noise.
    (norm > 0.5 * (values.len() as f64).sqrt()).then_some(norm)
}

/// The right frames around where a window is.
struct Target {
    pieces: Vec<Piece>,
}

impl Target {
    fn new(
        stack: &RectifiedStack,
        (x, y): (usize, usize),
        radius: usize,
        at: Affine,
    ) -> Option<Self> {
        let middle = (x as i64 + at.u.round() as i64, y as i64 + at.v.round() as i64);
        Some(Self { pieces: pieces(&stack.right, middle, radius as i64 + MARGIN)? })
    }

    /// Zero-mean values of the warped window in all frames, and their norm.
    fn warped(
        &self,
        reference: &Reference,
        (x, y): (usize, usize),
        affine: &Affine,
        out: &mut Vec<f64>,
    ) -> Option<f64> {
        out.clear();
        for piece in &self.pieces {
            for (dx, dy) in &reference.places {
                let (wx, wy) = affine.warp(*dx, *dy);
                out.push(piece.at(x as f64 + wx, y as f64 + wy)?.0);
            }
        }
        centre(out)
    }
}

/// Refines the window at a place of the left canvas. `None` when it has no texture, leaves the image or
/// does not converge.
pub fn refine(
    stack: &RectifiedStack,
    place: (usize, usize),
    radius: usize,
    start: Affine,
) -> Option<Refined> {
    let reference = Reference::new(stack, place, radius)?;
    let target = Target::new(stack, place, radius, start)?;
    let pixels = reference.places.len();
    // Steepest descent of the left window by the six parameters, and its Gauss-Newton Hessian.
    let descent: Vec<Vector6<f64>> = reference
        .slopes
        .iter()
        .enumerate()
        .map(|(k, (gx, gy))| {
            let (dx, dy) = reference.places[k % pixels];
            Vector6::new(*gx, gx * dx, gx * dy, *gy, gy * dx, gy * dy)
        })
        .collect();
    let hessian: Matrix6<f64> = descent.iter().map(|d| d * d.transpose()).sum();
    let factor = hessian.cholesky()?;
    let mut affine = start;
    let mut right = Vec::with_capacity(reference.values.len());
    for _ in 0..STEPS_MAX {
        let norm = target.warped(&reference, place, &affine, &mut right)?;
        let scale = reference.norm / norm;
        let residual: Vector6<f64> = descent
            .iter()
            .zip(&right)
            .zip(&reference.values)
            .map(|((d, g), f)| d * (scale * g - f))
            .sum();
        let step = Affine::from_vector(&factor.solve(&residual));
        affine = affine.compose_inverse(&step)?;
        let r = radius as f64;
        let length = [step.u, step.v, step.ux * r, step.uy * r, step.vx * r, step.vy * r]
            .into_iter()
            .map(|v| v * v)
            .sum::<f64>()
            .sqrt();
        if !length.is_finite() {
            return None;
        }
        if length < CONVERGED_PX {
            let norm = target.warped(&reference, place, &affine, &mut right)?;
            let product: f64 = right.iter().zip(&reference.values).map(|(g, f)| g * f).sum();
            return Some(Refined { affine, zncc: product / (norm * reference.norm) });
        }
    }
    None
}

/// Similarity (ZNCC) of a window with its warped counterpart.
pub fn similarity(
    stack: &RectifiedStack,
    place: (usize, usize),
    radius: usize,
    affine: Affine,
) -> Option<f64> {
    let reference = Reference::new(stack, place, radius)?;
    let target = Target::new(stack, place, radius, affine)?;
    let mut right = Vec::new();
    let norm = target.warped(&reference, place, &affine, &mut right)?;
    let product: f64 = right.iter().zip(&reference.values).map(|(g, f)| g * f).sum();
    Some(product / (norm * reference.norm))
}
