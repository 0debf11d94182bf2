//! Pose graph: one motion per view from motions between pairs of views, loops closed.
//!
//! Edges are weighed by their information and, since a pair that was registered wrongly is wrong by far
//! more than its information says, robustly: by Geman and McClure's weight of how far its points are
//! from where the poses put them.

use super::{RegisterError, motion_of_twist, twist_of_motion};
use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, Vector6};

/// A registered pair of views.
#[derive(Debug, Clone, PartialEq)]
pub struct Edge {
    /// The view that was registered onto.
    pub target: usize,
    /// The view that was registered.
    pub source: usize,
    /// Maps points of `source` to `target`.
    pub target_from_source: Isometry3<f64>,
    /// Weight of the twist's components about the target's origin, as
    /// [`super::icp::IcpResult::information_about_origin`].
    pub information: Matrix6<f64>,
}

/// Poses of all views that agree best with the edges.
#[derive(Debug, Clone, PartialEq)]
pub struct Solved {
    /// Maps each view's points into view 0's frame; the first is the identity.
    pub first_from_view: Vec<Isometry3<f64>>,
    /// Largest disagreement of an edge with the poses, metres of translation.
    pub worst_m: f64,
    /// Largest disagreement of an edge with the poses, radians.
    pub worst_rad: f64,
    /// How much each edge counted, 0 to 1: wrong ones hardly.
    pub trust: Vec<f64>,
}

/// Edges that are farther off than this, and than is usual for the others, lose their say, metres.
const TRUSTED_M: f64 = 1e-3;
/// How much of the limit is left each round.
const CLOSING: f64 = 0.7;
/// Most rounds.
const ROUNDS: usize = 60;

/// Poses of `views` views by robust Gauss-Newton over all edges, started along the spanning tree of the
/// edges with most information.
///
/// # Errors
/// [`RegisterError::Disconnected`].
pub fn solve(views: usize, edges: &[Edge]) -> Result<Solved, RegisterError> {
    let mut poses = spanning_tree(views, edges)?;
    let unknowns = 6 * views.saturating_sub(1);
    let mut trust = vec![1.0; edges.len()];
    // A wrong edge may be part of the tree, so that others look wrong at first: all are trusted then,
    // and the limit closes round by round (graduated non-convexity, Yang et al. 2020).
    let mut limit_m = f64::INFINITY;
    for _ in 0..ROUNDS {
        let mut normal = DMatrix::<f64>::zeros(unknowns, unknowns);
        let mut right = DVector::<f64>::zeros(unknowns);
        trust = trusted(&poses, edges, &mut limit_m);
        for (edge, trust) in edges.iter().zip(&trust) {
            let [by_target, by_source] = jacobians(&poses, edge);
            let residual = residual(&poses, edge);
            for (view, by) in [(edge.target, &by_target), (edge.source, &by_source)] {
                let Some(row) = view.checked_sub(1) else { continue };
                let weighted = by.transpose() * edge.information * *trust;
                let mut part = right.fixed_rows_mut::<6>(6 * row);
                part += weighted * residual;
                for (other, by_other) in [(edge.target, &by_target), (edge.source, &by_source)] {
                    let Some(column) = other.checked_sub(1) else { continue };
                    let mut block = normal.fixed_view_mut::<6, 6>(6 * row, 6 * column);
                    block += weighted * by_other;
                }
            }
        }
        let Some(factor) = normal.cholesky() else { break };
        let step = -factor.solve(&right);
        for (view, pose) in poses.iter_mut().enumerate().skip(1) {
            let twist: Vector6<f64> = step.fixed_rows::<6>(6 * (view - 1)).into_owned();
            *pose = motion_of_twist(&twist) * *pose;
        }
        if step.norm() < 1e-10 {
            break;
        }
    }
    let worst = |part: fn(&Vector6<f64>) -> f64| {
        edges.iter().map(|e| part(&residual(&poses, e))).fold(0.0, f64::max)
    };
    Ok(Solved {
        worst_rad: worst(|r| r.fixed_rows::<3>(0).norm()),
        worst_m: worst(|r| r.fixed_rows::<3>(3).norm()),
        first_from_view: poses,
        trust,
    })
}

/// How much each edge counts: 1 in agreement, 1/4 at the limit, hardly beyond. The limit closes.
fn trusted(poses: &[Isometry3<f64>], edges: &[Edge], limit_m: &mut f64) -> Vec<f64> {
    let off_m: Vec<f64> = edges.iter().map(|edge| off_m(poses, edge)).collect();
    let mut sorted = off_m.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let usual_m = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let worst_m = sorted.last().copied().unwrap_or(0.0);
    let closing_m = if limit_m.is_finite() { *limit_m * CLOSING } else { 2.0 * worst_m };
    *limit_m = closing_m.max(TRUSTED_M).max(3.0 * usual_m);
    off_m.into_iter().map(|off| (1.0 + (off / *limit_m).powi(2)).powi(-2)).collect()
}

/// RMS distance, along their normals, of an edge's points from where the poses put them, metres: the
/// translation's information is the points' number over their variance.
fn off_m(poses: &[Isometry3<f64>], edge: &Edge) -> f64 {
    let residual = residual(poses, edge);
    let squares = residual.dot(&(edge.information * residual));
    let points = edge.information.fixed_view::<3, 3>(3, 3).trace();
    if points > 0.0 { (squares / points).max(0.0).sqrt() } else { 0.0 }
}

/// Twist of (target_from_source measured)^-1 (target_from_source of the poses): zero in agreement.
fn residual(poses: &[Isometry3<f64>], edge: &Edge) -> Vector6<f64> {
    let posed = poses[edge.target].inverse() * poses[edge.source];
    twist_of_motion(&(posed * edge.target_from_source.inverse()))
}

/// Derivatives of the residual by the twists of target's and source's pose, by central differences:
/// exact to 1e-9, and there are few edges.
fn jacobians(poses: &[Isometry3<f64>], edge: &Edge) -> [Matrix6<f64>; 2] {
    const STEP: f64 = 1e-6;
    [edge.target, edge.source].map(|view| {
        let mut by = Matrix6::zeros();
        for i in 0..6 {
            let at = |amount: f64| {
                let mut moved = [poses[edge.target], poses[edge.source]];
                let mut twist = Vector6::zeros();
                twist[i] = amount;
                let index = usize::from(view == edge.source);
                moved[index] = motion_of_twist(&twist) * moved[index];
                let local = Edge { target: 0, source: 1, ..edge.clone() };
                residual(&moved, &local)
            };
            by.set_column(i, &((at(STEP) - at(-STEP)) / (2.0 * STEP)));
        }
        by
    })
}

fn spanning_tree(views: usize, edges: &[Edge]) -> Result<Vec<Isometry3<f64>>, RegisterError> {
    let mut poses: Vec<Option<Isometry3<f64>>> = vec![None; views];
    if let Some(first) = poses.first_mut() {
        *first = Some(Isometry3::identity());
    }
    let strength = |edge: &Edge| edge.information.fixed_view::<3, 3>(3, 3).trace();
    let mut strongest: Vec<&Edge> = edges.iter().collect();
    strongest.sort_by(|a, b| strength(b).total_cmp(&strength(a)));
    // The strongest edge that leads to a new view, again and again.
    loop {
        let mut grown = false;
        for edge in &strongest {
            match (poses[edge.target], poses[edge.source]) {
                (Some(target), None) => {
                    poses[edge.source] = Some(target * edge.target_from_source);
                    grown = true;
                    break;
                }
                (None, Some(source)) => {
                    poses[edge.target] = Some(source * edge.target_from_source.inverse());
                    grown = true;
                    break;
                }
                _ => {}
            }
        }
        if !grown {
            break;
        }
    }
    poses
        .into_iter()
        .enumerate()
        .map(|(view, pose)| pose.ok_or(RegisterError::Disconnected { view }))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turntable(views: usize, view: usize) -> Isometry3<f64> {
        let angle = std::f64::consts::TAU * view as f64 / views as f64;
        Isometry3::rotation(nalgebra::Vector3::y() * angle)
            * Isometry3::translation(0.02 * (view as f64).sin(), 0.01 * view as f64, 0.9)
    }

    fn edge(from: &[Isometry3<f64>], target: usize, source: usize) -> Edge {
        let target_from_source = from[target].inverse() * from[source];
        Edge { target, source, target_from_source, information: Matrix6::identity() }
    }

    #[test]
    fn a_loop_with_drift_is_closed_and_its_error_spread() {
        let n = 12;
        let truth: Vec<_> = (0..n).map(|i| turntable(n, i)).collect();
        let mut edges: Vec<_> = (0..n).map(|i| edge(&truth, i, (i + 1) % n)).collect();
        let exact = solve(n, &edges).unwrap();
        for (pose, t) in exact.first_from_view.iter().zip(&truth) {
            let error = twist_of_motion(&(pose.inverse() * truth[0].inverse() * t));
            assert!(error.norm() < 1e-9, "{error}");
        }
        // One edge is off by 1.2 mm. The twelve edges share it: about 0.1 mm each.
        edges[5].target_from_source.translation.x += 1.2e-3;
        let spread = solve(n, &edges).unwrap();
        assert!(spread.worst_m < 1.5e-4 && spread.worst_m > 0.5e-4, "{}", spread.worst_m);
    }

    #[test]
    fn wrong_edges_have_no_say() {
        let n = 12;
        let truth: Vec<_> = (0..n).map(|i| turntable(n, i)).collect();
        let mut edges: Vec<_> = (0..n).map(|i| edge(&truth, i, (i + 1) % n)).collect();
        edges.extend((0..n).map(|i| edge(&truth, i, (i + 2) % n)));
        // One neighbour has slid by 30 mm, one pair is half a turn off.
        edges[4].target_from_source.translation.y += 0.03;
        edges[17].target_from_source *= Isometry3::rotation(nalgebra::Vector3::y() * 3.0);
        let solved = solve(n, &edges).unwrap();
        for (pose, t) in solved.first_from_view.iter().zip(&truth) {
            let error = twist_of_motion(&(pose.inverse() * truth[0].inverse() * t));
            assert!(error.norm() < 1e-4, "{error}");
        }
        let distrusted: Vec<usize> = (0..2 * n).filter(|k| solved.trust[*k] < 0.1).collect();
        assert_eq!(distrusted, [4, 17]);
    }

    #[test]
    fn a_view_without_edges_is_named() {
        let truth: Vec<_> = (0..3).map(|i| turntable(3, i)).collect();
        let error = solve(3, &[edge(&truth, 0, 1)]).unwrap_err();
        assert_eq!(error, RegisterError::Disconnected { view: 2 });
    }
}
