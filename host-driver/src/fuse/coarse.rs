//! Coarse poses of the views, near enough for ICP.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, UnitVector3, Vector3};

use super::sparse::Sparse;
use super::{FuseError, FuseParams, Start, View};
use crate::register::global::{self, GlobalParams};

/// First-from-view motions, and within what distance ICP may look from there.
#[derive(Debug, Clone)]
pub struct Poses {
    /// Maps each view near the first one's frame.
    pub first_from_view: Vec<Isometry3<f64>>,
    /// Distance between points that belong together, about, metres.
    pub reach_m: f64,
}

/// Coarse poses by the start that the parameters name.
///
/// # Errors
/// [`FuseError::Pair`] when two views cannot be laid on each other.
pub fn poses(
    views: &[View],
    sparse: &[Sparse],
    params: &FuseParams,
    progress: &mut dyn FnMut(String),
) -> Result<Poses, FuseError> {
    let mut global = |target: usize, source: usize| {
        progress(format!("laying {} on {}", views[source].name, views[target].name));
        pair(views, sparse, target, source, params.overlap_min)
    };
    let mut first_from_view = vec![Isometry3::identity()];
    let mut reach_m: f64 = 0.02;
    match params.start {
        Start::Given => first_from_view = vec![Isometry3::identity(); views.len()],
        Start::Guide => {
            for source in 1..views.len() {
                let coarse = global(0, source)?;
                reach_m = reach_m.max(coarse.reach_m);
                first_from_view.push(coarse.target_from_source);
            }
        }
        Start::Global => {
            for source in 1..views.len() {
                let coarse = global(source - 1, source)?;
                reach_m = reach_m.max(coarse.reach_m);
                first_from_view.push(first_from_view[source - 1] * coarse.target_from_source);
            }
        }
        Start::Turntable { step_rad, axis } => {
            let step = match axis {
                Some((through, direction)) => turn(&through, &direction, step_rad),
                None => {
                    let coarse = global(0, 1)?;
                    reach_m = reach_m.max(coarse.reach_m);
                    screw_free(&coarse.target_from_source, step_rad.abs(), &sparse[0])
                }
            };
            for _ in 1..views.len() {
                let last = first_from_view.last().copied().unwrap_or_default();
                first_from_view.push(last * step);
            }
        }
    }
    Ok(Poses { first_from_view, reach_m })
}

/// Lays view `source` on view `target` from anywhere.
///
/// # Errors
/// [`FuseError::Pair`].
pub fn pair(
    views: &[View],
    sparse: &[Sparse],
    target: usize,
    source: usize,
    overlap_min: f64,
) -> Result<global::Coarse, FuseError> {
    let params = GlobalParams { overlap_min, seen_from_origin: true, ..GlobalParams::default() };
    global::register(&sparse[source].points_m, &sparse[target].points_m, &params).map_err(|error| {
        FuseError::Pair {
            source_name: views[source].name.clone(),
            target_name: views[target].name.clone(),
            source: error,
        }
    })
}

/// The turn by `angle_rad` about an axis.
fn turn(through: &Point3<f64>, direction: &Vector3<f64>, angle_rad: f64) -> Isometry3<f64> {
    let rotation =
        UnitQuaternion::from_axis_angle(&UnitVector3::new_normalize(*direction), angle_rad);
    Isometry3::from_parts(Translation3::from(through - rotation * through), rotation)
}

/// The pure turn by `angle_rad` that is nearest to a motion: its axis is kept, its shift along the axis
/// is not, and its angle becomes what the turntable says.
fn screw_free(motion: &Isometry3<f64>, angle_rad: f64, seen: &Sparse) -> Isometry3<f64> {
    let Some((axis, angle)) = motion.rotation.axis_angle() else { return *motion };
    // The fixed points of the motion across the axis: (I - R) c = t.
    let (u, v) = {
        let helper = if axis.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
        let u = axis.cross(&helper).normalize();
        (u, axis.cross(&u))
    };
    let centroid = seen.centroid();
    // About the object's middle, so that the axis's place is as exact as it can be.
    let moved = motion * centroid - centroid;
    let (a, b) = (moved.dot(&u), moved.dot(&v));
    let half_cot = 0.5 / (0.5 * angle).tan();
    let through = centroid + u * (0.5 * a - half_cot * b) + v * (0.5 * b + half_cot * a);
    turn(&through, &axis, angle_rad)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_axis_of_a_turntable_is_found_from_one_step() {
        let through = Point3::new(0.05, 0.1, 0.95);
        let direction = Vector3::new(0.1, -1.0, 0.05).normalize();
        let exact = turn(&through, &direction, 0.5);
        let seen = Sparse::for_test(vec![Point3::new(0.0, 0.2, 0.8); 20]);
        // The step as it is, and with a shift along the axis and an angle that is off.
        let off = Isometry3::translation(direction.x, direction.y, direction.z * 1.0);
        let shifted = Isometry3::from_parts(
            Translation3::from(off.translation.vector * 0.003),
            UnitQuaternion::identity(),
        ) * exact;
        for motion in [exact, shifted] {
            let found = screw_free(&motion, 0.5, &seen);
            for p in [Point3::new(0.1, 0.0, 0.9), Point3::new(-0.1, 0.3, 1.0)] {
                assert!((found * p - exact * p).norm() < 1e-9, "{found}");
            }
        }
        // The axis may come out the other way round: the step stays the same motion.
        let back = screw_free(&exact.inverse(), 0.5, &seen);
        let p = Point3::new(0.1, 0.0, 0.9);
        assert!((back * p - exact.inverse() * p).norm() < 1e-9);
    }
}
