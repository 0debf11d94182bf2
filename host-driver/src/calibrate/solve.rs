//! From sightings of a board to a calibration.

use nalgebra::{Isometry3, Point3, Vector3};

use super::bundle::{self, Adjusted, BundleError, Loss, State};
use super::observations::Observations;
use super::zhang::{self, POINTS_MIN};
use crate::StereoCalibration;

/// Fewest views in which both cameras see enough of the board. Fewer determine the cameras in theory
/// only.
pub const STEREO_VIEWS_MIN: usize = 4;

/// A view is left out when its residuals are this many times the median view's...
const OUTLIER_RATIO: f64 = 4.0;
/// ... and above this many pixels.
const OUTLIER_PX: f64 = 0.15;

/// Why there is no calibration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SolveError {
    /// Too few usable views.
    #[error(
        "{usable} of {given} image pairs show at least {POINTS_MIN} points of the board to both \
         cameras: expected at least {STEREO_VIEWS_MIN}, better 25"
    )]
    TooFew {
        /// Views that both cameras see.
        usable: usize,
        /// Views given.
        given: usize,
    },
    /// The adjustment failed.
    #[error(
        "{0}: expected boards at several distances, tilted by 20 to 40 degrees in all directions"
    )]
    Bundle(#[from] BundleError),
    /// The result is no rig.
    #[error("the result is no possible sensor: {0}")]
    Implausible(#[from] crate::calibration::FieldError),
}

/// What became of a view.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewFit {
    /// Root mean square of the distances between predicted and seen points, in px, for the left and
    /// the right camera; NaN where nothing was seen.
    pub rms_px: [f64; 2],
    /// Root mean square distance from the epipolar lines, in px.
    pub epipolar_rms_px: f64,
    /// Size of the triangulated board relative to the stated one.
    pub scale: f64,
    /// Distance of the board's middle from the left camera along its axis.
    pub distance_m: f64,
    /// Angles of the board's normal against the sensor's axis about the vertical and the horizontal
    /// axis.
    pub tilt_deg: [f64; 2],
    /// Whether the calibration rests on it.
    pub is_used: bool,
}

/// A solved calibration.
#[derive(Debug, Clone)]
pub struct Solution {
    /// The adjustment.
    pub adjusted: Adjusted,
    /// View by view; `None` for views with too few points.
    pub views: Vec<Option<ViewFit>>,
}

impl Solution {
    /// The calibration without date and temperature.
    pub fn calibration(&self) -> StereoCalibration {
        self.adjusted.state.calibration()
    }

    /// Root mean square of the distances between predicted and seen points of the used views, for the
    /// left and the right camera.
    pub fn rms_px(&self) -> [f64; 2] {
        [0, 1].map(|side| {
            rms(self.adjusted.residuals.iter().filter(|r| r.side == side).map(|r| r.px.norm()))
        })
    }

    /// Standard deviation of the depth, in metres, that is measured at `depth_m` on the sensor's axis,
    /// from the calibration's uncertainty alone.
    pub fn depth_sigma_m(&self, depth_m: f64) -> Option<f64> {
        let state = &self.adjusted.state;
        let calibration = state.calibration();
        let (left, right) = on_axis_px(&calibration, depth_m)?;
        // Depth of the same pixels when one unknown is off by its own standard deviation, which is
        // small enough for the derivative.
        let mut gradient = nalgebra::SVector::<f64, { bundle::SHARED }>::zeros();
        for k in 0..bundle::SHARED {
            let step = self.adjusted.covariance[(k, k)].sqrt();
            if step.is_nan() || step <= 0.0 {
                return None;
            }
            let depth = |sign: f64| {
                let moved = state.with_shared_moved(k, sign * step).calibration();
                Some(moved.triangulate(left, right)?.z)
            };
            gradient[k] = (depth(1.0)? - depth(-1.0)?) / (2.0 * step);
        }
        Some((gradient.transpose() * self.adjusted.covariance * gradient)[0].max(0.0).sqrt())
    }

    /// Error of the depth that this calibration gives for the point at `depth_m` on the axis of the
    /// true rig: what [`Self::depth_sigma_m`] estimates.
    pub fn depth_error_on_axis_m(&self, truth: &StereoCalibration, depth_m: f64) -> Option<f64> {
        let (left, right) = on_axis_px(truth, depth_m)?;
        Some(self.calibration().triangulate(left, right)?.z - depth_m)
    }
}

/// Where both cameras see the point at `depth_m` on the sensor's axis, which begins midway between
/// them.
fn on_axis_px(
    calibration: &StereoCalibration,
    depth_m: f64,
) -> Option<(nalgebra::Vector2<f64>, nalgebra::Vector2<f64>)> {
    let middle = calibration.right_from_left.inverse().translation.vector / 2.0;
    let point = Point3::from(middle + axis(calibration) * (depth_m - middle.z));
    let left = calibration.left.project(&point)?;
    let right = calibration.right.project(&(calibration.right_from_left * point))?;
    Some((left, right))
}

/// Mean of the optical axes in the left camera's frame.
pub fn axis(calibration: &StereoCalibration) -> Vector3<f64> {
    let right = calibration.right_from_left.rotation.inverse() * Vector3::z();
    let axis = right + Vector3::z();
    axis / axis.z
}

/// Root mean square; NaN of nothing.
pub fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, n), v| (sum + v * v, n + 1.0));
    (sum / count).sqrt()
}

/// Calibrates the rig.
///
/// # Errors
/// When there are too few views or they do not determine the rig.
pub fn solve(observations: &Observations, loss: Loss) -> Result<Solution, SolveError> {
    let starts = [0, 1].map(|side| zhang::estimate(observations, side));
    let both = |view: usize| {
        Some((starts[0].camera_from_board[view]?, starts[1].camera_from_board[view]?))
    };
    let rigs: Vec<Isometry3<f64>> = (0..observations.views.len())
        .filter_map(both)
        .map(|(left, right)| right * left.inverse())
        .collect();
    if rigs.len() < STEREO_VIEWS_MIN {
        return Err(SolveError::TooFew { usable: rigs.len(), given: observations.views.len() });
    }
    let right_from_left = middle_of(&rigs);
    let poses = |view: usize| {
        let [left, right] = [0, 1].map(|side| starts[side].camera_from_board[view]);
        left.or_else(|| Some(right_from_left.inverse() * right?))
    };
    let state = State {
        cameras: starts.clone().map(|start| start.camera),
        right_from_left,
        left_from_board: (0..observations.views.len()).map(poses).collect(),
    };
    let mut adjusted = bundle::adjust(observations, state, loss)?;
    let mut views = fits(observations, &adjusted);
    let poses_of_all = adjusted.state.left_from_board.clone();
    // Views that do not fit are left out, the worst first, as long as enough remain.
    while let Some(worst) = worst_outlier(observations, &views) {
        let mut state = adjusted.state.clone();
        state.left_from_board[worst] = None;
        adjusted = bundle::adjust(observations, state, loss)?;
        views = fits(observations, &adjusted);
    }
    // What was left out is reported against the final cameras, with its own best pose.
    for (view, pose) in poses_of_all.iter().enumerate() {
        if views[view].is_none()
            && let Some(pose) = pose
        {
            views[view] = fit_left_out(observations, &adjusted, view, *pose);
        }
    }
    let solution = Solution { adjusted, views };
    solution.calibration().validate()?;
    Ok(solution)
}

/// The pose that is nearest to all others.
fn middle_of(rigs: &[Isometry3<f64>]) -> Isometry3<f64> {
    let distance = |a: &Isometry3<f64>, b: &Isometry3<f64>| {
        let apart = a.translation.vector - b.translation.vector;
        (apart.norm() + a.rotation.angle_to(&b.rotation)).min(1.0)
    };
    let total = |a: &Isometry3<f64>| rigs.iter().map(|b| distance(a, b)).sum::<f64>();
    rigs.iter().copied().min_by(|a, b| total(a).total_cmp(&total(b))).unwrap_or_default()
}

/// The used view that fits worst, if it is an outlier and can be spared.
fn worst_outlier(observations: &Observations, views: &[Option<ViewFit>]) -> Option<usize> {
    let total = |fit: &ViewFit| rms(fit.rms_px.into_iter().filter(|v| v.is_finite()));
    let used: Vec<(usize, f64)> = views
        .iter()
        .enumerate()
        .filter_map(|(view, fit)| Some((view, total(fit.as_ref()?))))
        .collect();
    let is_stereo = |view: usize| {
        observations.views[view].left.len().min(observations.views[view].right.len()) >= POINTS_MIN
    };
    let stereo = used.iter().filter(|(view, _)| is_stereo(*view)).count();
    let mut sorted: Vec<f64> = used.iter().map(|(_, rms)| *rms).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2)?;
    let (view, worst) = used.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    (stereo > STEREO_VIEWS_MIN && *worst > OUTLIER_PX && *worst > OUTLIER_RATIO * median)
        .then_some(*view)
}

fn fits(observations: &Observations, adjusted: &Adjusted) -> Vec<Option<ViewFit>> {
    (0..observations.views.len())
        .map(|view| {
            let pose = adjusted.state.left_from_board[view]?;
            let side_rms = |side: usize| {
                let of_side =
                    adjusted.residuals.iter().filter(|r| (r.view, r.side) == (view, side));
                rms(of_side.map(|r| r.px.norm()))
            };
            Some(fit(observations, adjusted, view, pose, [0, 1].map(side_rms), true))
        })
        .collect()
}

/// The fit of a view that the calibration does not rest on: its pose adjusted alone.
fn fit_left_out(
    observations: &Observations,
    adjusted: &Adjusted,
    view: usize,
    pose: Isometry3<f64>,
) -> Option<ViewFit> {
    let (pose, residuals) =
        bundle::adjust_pose(&observations.board, &observations.views[view], &adjusted.state, pose)?;
    let side_rms =
        |side: usize| rms(residuals.iter().filter(|r| r.side == side).map(|r| r.px.norm()));
    Some(fit(observations, adjusted, view, pose, [0, 1].map(side_rms), false))
}

fn fit(
    observations: &Observations,
    adjusted: &Adjusted,
    view: usize,
    left_from_board: Isometry3<f64>,
    rms_px: [f64; 2],
    is_used: bool,
) -> ViewFit {
    let calibration = adjusted.state.calibration();
    let seen = &observations.views[view];
    let distances = seen.shared().filter_map(|(_, l, r)| calibration.epipolar_px(l, r));
    let points: Vec<_> = seen
        .shared()
        .filter_map(|(point, l, r)| {
            Some((observations.board.point_m(point), calibration.triangulate(l, r)?))
        })
        .collect();
    // Ratio of the mean distances from the middle.
    let n = points.len().max(1) as f64;
    let stated_middle = points.iter().map(|(p, _)| p.coords).sum::<nalgebra::Vector2<f64>>() / n;
    let seen_middle = points.iter().map(|(_, p)| p.coords).sum::<Vector3<f64>>() / n;
    let stated: f64 = points.iter().map(|(p, _)| (p.coords - stated_middle).norm_squared()).sum();
    let measured: f64 = points.iter().map(|(_, p)| (p.coords - seen_middle).norm_squared()).sum();
    // The board's z points away from the sensor.
    let axis = axis(&calibration).normalize();
    let normal = left_from_board.rotation * Vector3::z();
    let across = Vector3::y().cross(&axis).normalize();
    let down = axis.cross(&across);
    let tilt = |towards: &Vector3<f64>| normal.dot(towards).atan2(normal.dot(&axis)).to_degrees();
    ViewFit {
        rms_px,
        epipolar_rms_px: rms(distances),
        scale: (measured / stated).sqrt(),
        distance_m: left_from_board.translation.z,
        tilt_deg: [tilt(&across), tilt(&down)],
        is_used,
    }
}
