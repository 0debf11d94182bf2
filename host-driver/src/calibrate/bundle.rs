//! Bundle adjustment: both cameras, the rig and all board poses at once.
//!
//! Minimises the robust sum of squared distances between where the target points are predicted and
//! where they were seen, by Levenberg-Marquardt. Each board pose appears in its own view only, so the
//! poses are eliminated (Schur complement) and a step solves for 22 unknowns whatever the number of
//! views. The inverse of that reduced system, times the variance of the residuals, is the covariance
//! of what the calibration file holds.

use nalgebra::{
    Isometry3, Matrix2x6, Matrix3, Matrix3x6, Matrix6, Point3, SMatrix, SVector, Translation3,
    UnitQuaternion, Vector2, Vector3, Vector6,
};

use super::Board;
use super::eccentricity;
use super::observations::{Observations, View};
use crate::{CameraIntrinsics, StereoCalibration};

/// Unknowns shared by all views: 8 of each camera, then the rig's rotation vector and translation.
pub const SHARED: usize = 22;

/// Names and units of the shared unknowns.
pub const SHARED_NAMES: [(&str, &str); SHARED] = [
    ("left fu", "px"),
    ("left fv", "px"),
    ("left pu", "px"),
    ("left pv", "px"),
    ("left k1", ""),
    ("left k2", ""),
    ("left p1", ""),
    ("left p2", ""),
    ("right fu", "px"),
    ("right fv", "px"),
    ("right pu", "px"),
    ("right pv", "px"),
    ("right k1", ""),
    ("right k2", ""),
    ("right p1", ""),
    ("right p2", ""),
    ("rig rotation x", "rad"),
    ("rig rotation y", "rad"),
    ("rig rotation z", "rad"),
    ("rig translation x", "m"),
    ("rig translation y", "m"),
    ("rig translation z", "m"),
];

/// Covariance, or normal matrix, of the shared unknowns.
pub type SharedMatrix = SMatrix<f64, SHARED, SHARED>;
type SharedVector = SVector<f64, SHARED>;
type SharedByPose = SMatrix<f64, SHARED, 6>;

/// How large residuals count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Loss {
    /// Squares near zero, linear beyond (Huber).
    #[default]
    Huber,
    /// Squares near zero, logarithmic beyond (Cauchy): for sets with many false points.
    Cauchy,
}

impl Loss {
    /// Residual, in standard deviations of one coordinate, at which the loss stops being a square:
    /// both keep 95 % of the efficiency of least squares on normal residuals.
    fn knee(self) -> f64 {
        match self {
            Self::Huber => 1.7,
            Self::Cauchy => 3.0,
        }
    }

    /// Loss and weight (half its derivative by the square) of a residual of `e` standard deviations.
    fn of(self, e: f64) -> (f64, f64) {
        let k = self.knee();
        match self {
            Self::Huber if e <= k => (e * e, 1.0),
            Self::Huber => (2.0 * k * e - k * k, k / e),
            Self::Cauchy => {
                let q = (e / k).powi(2);
                (k * k * q.ln_1p(), 1.0 / (1.0 + q))
            }
        }
    }
}

/// Cameras, rig and poses.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// Left and right camera.
    pub cameras: [CameraIntrinsics; 2],
    /// The rig.
    pub right_from_left: Isometry3<f64>,
    /// Board pose of each view in the left camera's frame; `None` for views that are left out.
    pub left_from_board: Vec<Option<Isometry3<f64>>>,
}

impl State {
    /// The calibration without date and temperature.
    pub fn calibration(&self) -> StereoCalibration {
        StereoCalibration {
            left: self.cameras[0].clone(),
            right: self.cameras[1].clone(),
            right_from_left: self.right_from_left,
            temperature_c: None,
            date: None,
        }
    }

    /// Board pose of view `view` in camera `side`'s frame.
    pub fn camera_from_board(&self, view: usize, side: usize) -> Option<Isometry3<f64>> {
        let left_from_board = self.left_from_board[view]?;
        Some(if side == 0 { left_from_board } else { self.right_from_left * left_from_board })
    }

    /// The same with one shared unknown moved.
    pub fn with_shared_moved(&self, unknown: usize, step: f64) -> Self {
        let mut shared = SharedVector::zeros();
        shared[unknown] = step;
        self.stepped(&shared, &vec![Some(Vector6::zeros()); self.left_from_board.len()])
    }

    fn stepped(&self, shared: &SharedVector, poses: &[Option<Vector6<f64>>]) -> Self {
        let camera = |k: usize| {
            let mut values = self.cameras[k].to_vector();
            for (value, step) in values.iter_mut().zip(shared.iter().skip(8 * k)) {
                *value += step;
            }
            CameraIntrinsics::from_vector(values, self.cameras[k].resolution_px)
        };
        let rig = Vector6::from_fn(|k, _| shared[16 + k]);
        let moved = self.left_from_board.iter().zip(poses);
        Self {
            cameras: [camera(0), camera(1)],
            right_from_left: turned_and_moved(&self.right_from_left, &rig),
            left_from_board: moved
                .map(|(pose, step)| Some(turned_and_moved(&(*pose)?, step.as_ref()?)))
                .collect(),
        }
    }
}

/// `pose` turned by a rotation vector (after its own rotation) and moved.
pub fn turned_and_moved(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
    let translation = pose.translation.vector + Vector3::new(step[3], step[4], step[5]);
    Isometry3::from_parts(Translation3::from(translation), turn * pose.rotation)
}

/// A residual: which point in which view and camera, predicted minus seen, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// The view.
    pub view: usize,
    /// 0 left, 1 right.
    pub side: usize,
    /// The target point.
    pub point: usize,
    /// Predicted minus seen.
    pub px: Vector2<f64>,
    /// Weight by the loss: 1 for ordinary points, towards 0 for outliers.
    pub weight: f64,
}

/// The result.
#[derive(Debug, Clone)]
pub struct Adjusted {
    /// Cameras, rig, poses.
    pub state: State,
    /// All residuals of the views used.
    pub residuals: Vec<Residual>,
    /// Covariance of the shared unknowns.
    pub covariance: SharedMatrix,
    /// Standard deviation of one coordinate of a seen point, from the residuals.
    pub sigma_px: f64,
    /// Levenberg-Marquardt steps taken.
    pub steps: usize,
}

/// Why nothing was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum BundleError {
    /// The views do not determine all unknowns.
    #[error("the views do not determine the cameras and the rig")]
    Singular,
    /// The start is too far off, or the points are wrong.
    #[error("the adjustment diverged")]
    Diverged,
}

/// Rounds of re-estimating the residuals' scale.
const ROUNDS: usize = 5;
/// Steps in a round.
const STEPS_MAX: usize = 40;
/// Part of the cost by which the last step of a round still lowered it.
const CONVERGED: f64 = 1e-9;

/// Adjusts everything to the observations, from a start in which each view used has a pose.
///
/// # Errors
/// When the views do not suffice, or the start is no start.
pub fn adjust(
    observations: &Observations,
    start: State,
    loss: Loss,
) -> Result<Adjusted, BundleError> {
    let mut problem = Problem { observations, loss, sigma_px: 1.0, offsets: Vec::new() };
    let mut state = start;
    let mut steps = 0;
    for _ in 0..ROUNDS {
        problem.offsets = eccentricity::offsets(observations, &state);
        let residuals = problem.residuals(&state).ok_or(BundleError::Diverged)?;
        problem.sigma_px = scale(&residuals);
        let before = state.clone();
        steps += problem.descend(&mut state)?;
        if before == state {
            break;
        }
    }
    let residuals = problem.residuals(&state).ok_or(BundleError::Diverged)?;
    let normal = problem.normal(&state).ok_or(BundleError::Diverged)?;
    let reduced = normal.reduced(0.0).ok_or(BundleError::Singular)?;
    // Columns of unit length: the unknowns' units differ by six orders of magnitude.
    let unit = SharedVector::from_fn(|k, _| reduced.matrix[(k, k)].max(0.0).sqrt().recip());
    if unit.iter().any(|u| !u.is_finite()) {
        return Err(BundleError::Singular);
    }
    let unit = SharedMatrix::from_diagonal(&unit);
    let scaled = (unit * reduced.matrix * unit).cholesky().ok_or(BundleError::Singular)?;
    let weighted: f64 = residuals.iter().map(|r| r.weight * r.px.norm_squared()).sum();
    let poses = state.left_from_board.iter().flatten().count();
    let freedom = (2 * residuals.len()) as f64 - (SHARED + 6 * poses) as f64;
    if freedom <= 0.0 {
        return Err(BundleError::Singular);
    }
    let variance = weighted / freedom;
    // The normal matrix is in units of the scale used for the weights.
    let covariance = unit * scaled.inverse() * unit * (variance / problem.sigma_px.powi(2));
    Ok(Adjusted { state, residuals, covariance, sigma_px: variance.sqrt(), steps })
}

/// The best pose of one view with everything else fixed, and its residuals. `None` when there is none.
pub fn adjust_pose(
    board: &Board,
    view: &View,
    state: &State,
    start: Isometry3<f64>,
) -> Option<(Isometry3<f64>, Vec<Residual>)> {
    let observations = Observations {
        board: *board,
        resolution_px: state.cameras[0].resolution_px,
        views: vec![view.clone()],
    };
    let mut state = State { left_from_board: vec![Some(start)], ..state.clone() };
    let offsets = eccentricity::offsets(&observations, &state);
    let problem =
        Problem { observations: &observations, loss: Loss::Cauchy, sigma_px: 1.0, offsets };
    let mut damping = 1e-3;
    for _ in 0..STEPS_MAX {
        let normal = problem.normal(&state)?;
        let part = normal.poses[0].as_ref()?;
        let step = -part.damped(damping).cholesky()?.solve(&part.right);
        let next = state.stepped(&SharedVector::zeros(), &[Some(step)]);
        match problem.cost(&next).filter(|cost| *cost < normal.cost) {
            Some(cost) => {
                state = next;
                damping = (damping / 10.0).max(1e-12);
                if normal.cost - cost <= CONVERGED * normal.cost {
                    break;
                }
            }
            None if damping > 1e12 => break,
            None => damping *= 8.0,
        }
    }
    Some((state.left_from_board[0]?, problem.residuals(&state)?))
}

/// Standard deviation of one coordinate, from the median length: half the lengths of normal vectors
/// in the plane are below 1.1774 standard deviations.
fn scale(residuals: &[Residual]) -> f64 {
    let mut lengths: Vec<f64> = residuals.iter().map(|r| r.px.norm()).collect();
    lengths.sort_unstable_by(f64::total_cmp);
    let median = lengths.get(lengths.len() / 2).copied().unwrap_or(1.0);
    (median / 1.1774).max(1e-6)
}

struct Problem<'a> {
    observations: &'a Observations,
    loss: Loss,
    sigma_px: f64,
    /// Where a target is seen, relative to where its centre is imaged; in the order of the residuals.
    offsets: Vec<Vector2<f64>>,
}

/// The normal equations, poses apart.
struct Normal {
    cost: f64,
    shared: SharedMatrix,
    shared_right: SharedVector,
    poses: Vec<Option<PosePart>>,
}

#[derive(Clone)]
struct PosePart {
    own: Matrix6<f64>,
    cross: SharedByPose,
    right: Vector6<f64>,
}

/// The normal equations of the shared unknowns alone.
struct Reduced {
    matrix: SharedMatrix,
    right: SharedVector,
}

impl Normal {
    /// Eliminates the poses, with each diagonal raised by the part `damping`.
    fn reduced(&self, damping: f64) -> Option<Reduced> {
        let mut matrix = self.shared;
        for k in 0..SHARED {
            matrix[(k, k)] *= 1.0 + damping;
        }
        let mut right = self.shared_right;
        for part in self.poses.iter().flatten() {
            let inverse = part.damped(damping).cholesky()?.inverse();
            let through = part.cross * inverse;
            matrix -= through * part.cross.transpose();
            right -= through * part.right;
        }
        Some(Reduced { matrix, right })
    }

    /// A step of the shared unknowns and of each pose.
    fn step(&self, damping: f64) -> Option<(SharedVector, Vec<Option<Vector6<f64>>>)> {
        let reduced = self.reduced(damping)?;
        let unit = SharedVector::from_fn(|k, _| reduced.matrix[(k, k)].max(1e-300).sqrt().recip());
        let scaling = SharedMatrix::from_diagonal(&unit);
        let factor = (scaling * reduced.matrix * scaling).cholesky()?;
        let shared = -(scaling * factor.solve(&(scaling * reduced.right)));
        let pose = |part: &PosePart| {
            let factor = part.damped(damping).cholesky()?;
            Some(-factor.solve(&(part.right + part.cross.transpose() * shared)))
        };
        let mut poses = Vec::with_capacity(self.poses.len());
        for part in &self.poses {
            poses.push(match part {
                Some(part) => Some(pose(part)?),
                None => None,
            });
        }
        Some((shared, poses))
    }
}

impl PosePart {
    fn damped(&self, damping: f64) -> Matrix6<f64> {
        let mut own = self.own;
        for k in 0..6 {
            own[(k, k)] *= 1.0 + damping;
        }
        own
    }
}

impl Problem<'_> {
    /// Steps until the cost does not fall any more; the number of steps.
    fn descend(&self, state: &mut State) -> Result<usize, BundleError> {
        let mut damping = 1e-3;
        let mut normal = self.normal(state).ok_or(BundleError::Diverged)?;
        for step in 1..=STEPS_MAX {
            let mut lowered = None;
            while damping < 1e12 {
                if let Some((shared, poses)) = normal.step(damping) {
                    let next = state.stepped(&shared, &poses);
                    if let Some(cost) = self.cost(&next).filter(|cost| *cost < normal.cost) {
                        lowered = Some((next, cost));
                        break;
                    }
                }
                damping *= 8.0;
            }
            let Some((next, cost)) = lowered else { return Ok(step) };
            let is_converged = normal.cost - cost <= CONVERGED * normal.cost;
            *state = next;
            if is_converged {
                return Ok(step);
            }
            damping = (damping / 10.0).max(1e-12);
            normal = self.normal(state).ok_or(BundleError::Diverged)?;
        }
        Ok(STEPS_MAX)
    }

    /// All residuals; `None` when a point is behind a camera.
    fn residuals(&self, state: &State) -> Option<Vec<Residual>> {
        let mut residuals = Vec::new();
        for (view, seen) in self.observations.views.iter().enumerate() {
            for side in 0..2 {
                let Some(pose) = state.camera_from_board(view, side) else { continue };
                for sighting in seen.side(side) {
                    let p = self.observations.board.point_m(sighting.point);
                    let point = pose * Point3::new(p.x, p.y, 0.0);
                    let offset = self.offset(residuals.len());
                    let px = state.cameras[side].project(&point)? + offset - sighting.pixel;
                    if !px.norm().is_finite() {
                        return None;
                    }
                    let weight = self.loss.of(px.norm() / self.sigma_px).1;
                    residuals.push(Residual { view, side, point: sighting.point, px, weight });
                }
            }
        }
        Some(residuals)
    }

    fn offset(&self, index: usize) -> Vector2<f64> {
        self.offsets.get(index).copied().unwrap_or_default()
    }

    fn cost(&self, state: &State) -> Option<f64> {
        let residuals = self.residuals(state)?;
        Some(residuals.iter().map(|r| self.loss.of(r.px.norm() / self.sigma_px).0).sum())
    }

    fn normal(&self, state: &State) -> Option<Normal> {
        let mut normal = Normal {
            cost: 0.0,
            shared: SharedMatrix::zeros(),
            shared_right: SharedVector::zeros(),
            poses: vec![None; self.observations.views.len()],
        };
        let rig_rotation = state.right_from_left.rotation.to_rotation_matrix();
        let mut index = 0;
        for (view, seen) in self.observations.views.iter().enumerate() {
            let Some(left_from_board) = state.left_from_board[view] else { continue };
            let mut part = PosePart {
                own: Matrix6::zeros(),
                cross: SharedByPose::zeros(),
                right: Vector6::zeros(),
            };
            for side in 0..2 {
                for sighting in seen.side(side) {
                    let p = self.observations.board.point_m(sighting.point);
                    let turned = left_from_board.rotation * Vector3::new(p.x, p.y, 0.0);
                    let in_left = turned + left_from_board.translation.vector;
                    let mut left_by_pose = Matrix3x6::zeros();
                    left_by_pose.fixed_columns_mut::<3>(0).copy_from(&-turned.cross_matrix());
                    left_by_pose.fixed_columns_mut::<3>(3).copy_from(&Matrix3::identity());
                    let (in_camera, by_pose) = if side == 0 {
                        (in_left, left_by_pose)
                    } else {
                        let turned = rig_rotation * in_left;
                        (turned + state.right_from_left.translation.vector, {
                            rig_rotation.matrix() * left_by_pose
                        })
                    };
                    let projection =
                        state.cameras[side].project_with_derivatives(&Point3::from(in_camera))?;
                    let px = projection.pixel + self.offset(index) - sighting.pixel;
                    index += 1;
                    let (loss, weight) = self.loss.of(px.norm() / self.sigma_px);
                    normal.cost += loss;
                    let weight = weight / self.sigma_px.powi(2);
                    let by_pose: Matrix2x6<f64> = projection.by_point * by_pose;
                    let mut by_shared = SMatrix::<f64, 2, SHARED>::zeros();
                    by_shared.fixed_columns_mut::<8>(8 * side).copy_from(&projection.by_intrinsics);
                    if side == 1 {
                        let turned = in_camera - state.right_from_left.translation.vector;
                        by_shared
                            .fixed_columns_mut::<3>(16)
                            .copy_from(&(-projection.by_point * turned.cross_matrix()));
                        by_shared.fixed_columns_mut::<3>(19).copy_from(&projection.by_point);
                    }
                    let weighted = by_shared.transpose() * weight;
                    normal.shared += weighted * by_shared;
                    normal.shared_right += weighted * px;
                    part.cross += weighted * by_pose;
                    let weighted = by_pose.transpose() * weight;
                    part.own += weighted * by_pose;
                    part.right += weighted * px;
                }
            }
            normal.poses[view] = Some(part);
        }
        Some(normal)
    }
}
