//! The turn of the right camera that explains vertical disparities.
//!
//! Angles are about the right camera's own axes. In the middle of the image a pitch (about x) shifts
//! all rows alike, f times the angle; a roll (about z) shifts them in proportion to x. A yaw (about y)
//! moves points along the rows, where it looks like another depth; across them it is seen only as a
//! keystone, f x y times the angle with x and y in focal lengths: at most 0.09 f times the angle in
//! the corners of this sensor's field, 0.15 px for 0.05 degrees.

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use serde::Serialize;

use super::{CheckError, Match, Matches};
use crate::StereoCalibration;
use crate::calibration::essential;

/// Residual at which the weight of a window falls, in robust standard deviations (Cauchy).
const KNEE: f64 = 2.4;
/// Standard deviations from which on an angle is real.
pub const SIGNIFICANT: f64 = 4.0;
/// Index of the yaw among the angles.
const YAW: usize = 1;
/// Rounds of the reweighted fit.
const ROUNDS: usize = 20;
/// Blocks across and down that are left out in turn to see how far the result hangs on each.
const BLOCKS: usize = 3;

/// Axes about which a turn is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Axes {
    /// About x: up and down.
    pub pitch: bool,
    /// About y: left and right, seen in the second order only.
    pub yaw: bool,
    /// About z.
    pub roll: bool,
}

impl Default for Axes {
    fn default() -> Self {
        Self { pitch: true, yaw: true, roll: true }
    }
}

impl Axes {
    fn free(&self) -> Vec<usize> {
        let wanted = [self.pitch, self.yaw, self.roll];
        (0..3).filter(|&k| wanted[k]).collect()
    }
}

/// A turn of the right camera about its own centre.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Drift {
    /// Angles about the camera's x (pitch), y (yaw) and z (roll) axes, all fitted together.
    pub angles_deg: [f64; 3],
    /// Their standard deviations, from the scatter of the windows and from leaving out parts of the
    /// field; 0 for axes that were not looked at.
    pub sigmas_deg: [f64; 3],
    /// The turn to correct: without a yaw that is within [`SIGNIFICANT`] standard deviations, the
    /// other angles then fitted without it. An uncertain yaw is the one error that costs depth.
    pub correction_deg: [f64; 3],
    /// Robust standard deviation of what the turn leaves, in px.
    pub rest_px: f64,
}

impl Drift {
    /// Whether any angle to correct is larger than its uncertainty.
    pub fn is_significant(&self) -> bool {
        (0..3).any(|k| {
            self.correction_deg[k] != 0.0
                && self.angles_deg[k].abs() > SIGNIFICANT * self.sigmas_deg[k]
        })
    }

    /// A calibration with the turn corrected.
    pub fn applied(&self, calibration: &StereoCalibration) -> StereoCalibration {
        let turn = Vector3::from(self.correction_deg.map(f64::to_radians));
        let right_from_left = turned(&calibration.right_from_left, &turn);
        StereoCalibration { right_from_left, ..calibration.clone() }
    }
}

/// The rig with its right camera turned about its own centre.
fn turned(right_from_left: &Isometry3<f64>, turn: &Vector3<f64>) -> Isometry3<f64> {
    UnitQuaternion::from_scaled_axis(*turn) * right_from_left
}

/// Distance of a window's right ray from the epipolar line of its left one, in units of the focal
/// length; positive below.
pub fn vertical(essential: &Matrix3<f64>, found: &Match) -> f64 {
    let line = essential * found.left_ray;
    let distance = found.right_ray.dot(&line) / line.xy().norm();
    distance * line.y.signum()
}

/// Fits the turn to windows.
///
/// # Errors
/// When no axis is looked at, or the windows do not determine one.
pub fn fit(
    calibration: &StereoCalibration,
    matches: &Matches,
    axes: Axes,
) -> Result<Drift, CheckError> {
    let free = axes.free();
    if free.is_empty() {
        return Err(CheckError::Drift("no axis is looked at"));
    }
    let all: Vec<&Match> = matches.matches.iter().collect();
    let undetermined = CheckError::Drift("they lie too close together");
    let whole = fit_turn(&calibration.right_from_left, &all, &free).ok_or(undetermined)?;
    // How far the result hangs on a part of the field: a jackknife over blocks, which sees errors that
    // neighbouring windows share.
    let blocks = blocks(&all);
    let mut parts = Vec::new();
    for block in 0..BLOCKS * BLOCKS {
        let rest: Vec<&Match> =
            all.iter().zip(&blocks).filter(|(_, b)| **b != block).map(|(m, _)| *m).collect();
        if rest.len() < all.len() {
            parts.extend(fit_turn(&calibration.right_from_left, &rest, &free).map(|f| f.turn));
        }
    }
    let n = parts.len().max(1) as f64;
    let mean = parts.iter().sum::<Vector3<f64>>() / n;
    let spread = parts.iter().map(|p| (p - mean).component_mul(&(p - mean))).sum::<Vector3<f64>>();
    let jackknife = (spread * ((n - 1.0) / n)).map(f64::sqrt);
    let sigma = whole.sigma.sup(&jackknife);
    let mut correction = whole.turn;
    let mut rest = whole.rest;
    if axes.yaw && whole.turn[YAW].abs() <= SIGNIFICANT * sigma[YAW] {
        let others: Vec<usize> = free.into_iter().filter(|&k| k != YAW).collect();
        (correction, rest) = match fit_turn(&calibration.right_from_left, &all, &others) {
            Some(fit) => (fit.turn, fit.rest),
            None => (Vector3::zeros(), whole.rest),
        };
    }
    Ok(Drift {
        correction_deg: correction.map(f64::to_degrees).into(),
        angles_deg: whole.turn.map(f64::to_degrees).into(),
        sigmas_deg: sigma.map(f64::to_degrees).into(),
        rest_px: rest * matches.focal_px,
    })
}

struct Fit {
    turn: Vector3<f64>,
    sigma: Vector3<f64>,
    rest: f64,
}

fn fit_turn(right_from_left: &Isometry3<f64>, matches: &[&Match], free: &[usize]) -> Option<Fit> {
    let residuals = |turn: &Vector3<f64>| -> Vec<f64> {
        let essential = essential(&turned(right_from_left, turn));
        matches.iter().map(|found| vertical(&essential, found)).collect()
    };
    let mut turn = Vector3::zeros();
    let step = 1e-6;
    let mut normal = Matrix3::identity();
    let mut scale = 0.0;
    for _ in 0..ROUNDS {
        let rest = residuals(&turn);
        scale = robust_sigma(&rest).max(1e-9);
        let slopes: Vec<Vec<f64>> = free
            .iter()
            .map(|&k| {
                let mut moved = turn;
                moved[k] += step;
                residuals(&moved).iter().zip(&rest).map(|(a, b)| (a - b) / step).collect()
            })
            .collect();
        normal = Matrix3::identity();
        let mut right = Vector3::zeros();
        for (i, &k) in free.iter().enumerate() {
            normal[(k, k)] = 0.0;
            for (n, r) in rest.iter().enumerate() {
                let weight = 1.0 / (1.0 + (r / (KNEE * scale)).powi(2));
                right[k] += weight * slopes[i][n] * r;
                for (j, &m) in free.iter().enumerate() {
                    normal[(k, m)] += weight * slopes[i][n] * slopes[j][n];
                }
            }
        }
        let change = normal.cholesky()?.solve(&right);
        turn -= change;
        if change.norm() < 1e-10 {
            break;
        }
    }
    if !turn.iter().all(|v| v.is_finite()) || turn.norm() > 0.1 {
        return None;
    }
    let inverse = normal.try_inverse()?;
    let mut sigma = Vector3::zeros();
    for &k in free {
        sigma[k] = scale * inverse[(k, k)].max(0.0).sqrt();
    }
    Some(Fit { turn, sigma, rest: scale })
}

/// Standard deviation by the median of the magnitudes.
pub fn robust_sigma(values: &[f64]) -> f64 {
    let mut magnitudes: Vec<f64> = values.iter().map(|v| v.abs()).collect();
    magnitudes.sort_unstable_by(f64::total_cmp);
    1.4826 * magnitudes.get(magnitudes.len() / 2).copied().unwrap_or(0.0)
}

/// Block of the field that each window is in.
fn blocks(matches: &[&Match]) -> Vec<usize> {
    let range = |value: &dyn Fn(&Match) -> f64| {
        let low = matches.iter().map(|m| value(m)).fold(f64::INFINITY, f64::min);
        let high = matches.iter().map(|m| value(m)).fold(f64::NEG_INFINITY, f64::max);
        (low, (high - low).max(1e-9))
    };
    let (x, y) = (|m: &Match| m.left_px.x, |m: &Match| m.left_px.y);
    let ((x0, width), (y0, height)) = (range(&x), range(&y));
    let block = |at: f64| ((at * BLOCKS as f64) as usize).min(BLOCKS - 1);
    matches
        .iter()
        .map(|m| block((y(m) - y0) / height) * BLOCKS + block((x(m) - x0) / width))
        .collect()
}
