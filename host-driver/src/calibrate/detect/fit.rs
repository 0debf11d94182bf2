//! Fits of small models of grey values: Levenberg-Marquardt on the pixels of a window.

use nalgebra::{SMatrix, SVector};

use super::gray::Gray;

/// Steps of a fit.
const STEPS_MAX: usize = 20;

/// A pixel of a window: its place relative to the window's origin, and its grey value.
#[derive(Debug, Clone, Copy)]
pub struct Pixel {
    /// To the right of the origin.
    pub x: f64,
    /// Below the origin.
    pub y: f64,
    /// Grey value.
    pub value: f64,
}

/// The pixels within `reach` of (`x`, `y`) that `selects` takes, relative to it.
pub fn window(
    gray: &Gray,
    (x, y): (f64, f64),
    reach: f64,
    selects: impl Fn(f64, f64) -> bool,
) -> Vec<Pixel> {
    let range = |centre: f64, size: usize| {
        let first = (centre - reach).ceil().max(0.0) as usize;
        let last = ((centre + reach).floor().max(-1.0) + 1.0) as usize;
        first.min(size)..last.min(size)
    };
    let mut pixels = Vec::new();
    for row in range(y, gray.height()) {
        for column in range(x, gray.width()) {
            let (dx, dy) = (column as f64 - x, row as f64 - y);
            if selects(dx, dy) {
                let value = f64::from(gray.pixels.row(row)[column]);
                pixels.push(Pixel { x: dx, y: dy, value });
            }
        }
    }
    pixels
}

/// A fitted model.
#[derive(Debug, Clone, Copy)]
pub struct Fitted<const N: usize> {
    /// The parameters.
    pub parameters: SVector<f64, N>,
    /// Root mean square of what the model leaves, in grey values.
    pub rms: f64,
}

/// Fits `model` to pixels from `start`; `steps` are the parameters' natural steps, for derivatives and
/// for the end. `None` when the pixels do not determine the parameters.
pub fn fit<const N: usize>(
    pixels: &[Pixel],
    start: SVector<f64, N>,
    steps: &SVector<f64, N>,
    model: impl Fn(&SVector<f64, N>, f64, f64) -> f64,
) -> Option<Fitted<N>> {
    if pixels.len() <= N {
        return None;
    }
    let cost = |p: &SVector<f64, N>| {
        pixels.iter().map(|pixel| (model(p, pixel.x, pixel.y) - pixel.value).powi(2)).sum::<f64>()
    };
    let mut p = start;
    let mut least = cost(&p);
    let mut damping = 1e-3;
    for _ in 0..STEPS_MAX {
        let mut moved = [p; N];
        for (k, moved) in moved.iter_mut().enumerate() {
            moved[k] += steps[k];
        }
        let mut normal = SMatrix::<f64, N, N>::zeros();
        let mut right = SVector::<f64, N>::zeros();
        for pixel in pixels {
            let value = model(&p, pixel.x, pixel.y);
            // In units of the natural steps, which makes the unknowns comparable.
            let slope =
                SVector::<f64, N>::from_fn(|k, _| model(&moved[k], pixel.x, pixel.y) - value);
            normal += slope * slope.transpose();
            right += slope * (pixel.value - value);
        }
        let mut lowered = false;
        let mut length = 0.0;
        while damping < 1e9 {
            let mut damped = normal;
            for k in 0..N {
                damped[(k, k)] *= 1.0 + damping;
            }
            let Some(factor) = damped.cholesky() else {
                damping *= 10.0;
                continue;
            };
            let step = factor.solve(&right);
            let next = p + step.component_mul(steps);
            let next_cost = cost(&next);
            if next_cost <= least {
                length = step.amax();
                (p, least, lowered) = (next, next_cost, true);
                damping = (damping / 10.0).max(1e-9);
                break;
            }
            damping *= 10.0;
        }
        if !lowered || length < 0.05 {
            break;
        }
    }
    let rms = (least / pixels.len() as f64).sqrt();
    (rms.is_finite() && p.iter().all(|v| v.is_finite())).then_some(Fitted { parameters: p, rms })
}

/// A black-to-white edge blurred by a Gaussian, from -1 to 1: the error function (Abramowitz and
/// Stegun, 7.1.26, to 1.5e-7).
pub fn edge(distance_in_sigmas: f64) -> f64 {
    let x = (distance_in_sigmas * std::f64::consts::FRAC_1_SQRT_2).abs();
    let t = 1.0 / (1.0 + 0.327_591_1 * x);
    let polynomial = t
        * (0.254_829_592
            + t * (-0.284_496_736
                + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    (1.0 - polynomial * (-x * x).exp()).copysign(distance_in_sigmas)
}
