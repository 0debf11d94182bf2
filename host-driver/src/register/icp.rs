//! Point-to-plane iterative closest points (Chen and Medioni 1992), with a distance gate that closes
//! as the pose settles and trimming of the worst pairs.

use super::surface::Surface;
use super::{RegisterError, motion_of_twist};
use nalgebra::{Isometry3, Matrix6, Point3, SymmetricEigen, Vector3, Vector6};
use rayon::prelude::*;

/// How a cloud is registered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IcpParams {
    /// Pairs further apart than this are ignored at the start, metres.
    pub max_distance_m: f64,
    /// The gate never closes further than this, metres.
    pub min_distance_m: f64,
    /// Share of the closest pairs that is used, 0 to 1: outliers sit in the rest.
    pub keep: f64,
    /// Most iterations at full density.
    pub iterations_max: usize,
    /// Points of the source used while the pose is still coarse.
    pub coarse_points: usize,
    /// The pose has settled when a step turns by less than this, radians, and moves by less than
    /// [`IcpParams::settled_m`].
    pub settled_rad: f64,
    /// See [`IcpParams::settled_rad`], metres.
    pub settled_m: f64,
}

impl Default for IcpParams {
    fn default() -> Self {
        Self {
            max_distance_m: 0.02,
            min_distance_m: 0.001,
            keep: 0.9,
            iterations_max: 20,
            coarse_points: 20_000,
            settled_rad: 1e-7,
            settled_m: 1e-7,
        }
    }
}

/// A registered cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct IcpResult {
    /// Maps source points onto the target.
    pub target_from_source: Isometry3<f64>,
    /// RMS of the point-to-plane distances of the pairs kept, metres.
    pub rms_m: f64,
    /// Share of the source's points that have a pair.
    pub overlap: f64,
    /// Normal matrix of the twist (rotation about the pairs' centroid in rows 0..3, translation in
    /// 3..6) at the solution: the information that a pose graph weighs this pair with.
    pub information: Matrix6<f64>,
    /// Centroid of the pairs in the target's frame, about which `information` is taken.
    pub centroid_m: Point3<f64>,
    /// Whether the pose settled within the iterations allowed.
    pub settled: bool,
}

impl IcpResult {
    /// [`IcpResult::information`] for a twist about the target's origin, as a pose graph's edges are
    /// weighed: the centroid moves by t + w x c.
    pub fn information_about_origin(&self) -> Matrix6<f64> {
        let mut centroid_from_origin = Matrix6::identity();
        let cross = self.centroid_m.coords.cross_matrix();
        centroid_from_origin.fixed_view_mut::<3, 3>(3, 0).copy_from(&-cross);
        centroid_from_origin.transpose() * self.information * centroid_from_origin
    }
}

/// A source point and the closest point of the target.
struct Pair {
    /// Signed distance along the target's normal, metres.
    plane_m: f64,
    /// Distance between the two points, metres: never less, and of the order of the point spacing
    /// where the target is a cloud.
    point_m: f64,
    normal: Vector3<f64>,
    /// The source point in the target's frame.
    moved_m: Point3<f64>,
}

const LEAST_PAIRS: usize = 12;
/// Each level of density has about so many times the points of the one before. The pose of a level is
/// off by the noise over the root of its points, so that few steps remain on the next.
const LEVEL: usize = 8;
/// A move of this share of the points' distance leaves nearly all pairs as they are.
const PAIRS_HOLD: f64 = 0.005;

/// Registers the finite points of `source_m` on `target`, starting from `target_from_source`.
///
/// # Errors
/// [`RegisterError::TooFewPoints`], [`RegisterError::NoOverlap`] and [`RegisterError::Degenerate`].
pub fn register(
    source_m: &[Point3<f64>],
    target: &dyn Surface,
    target_from_source: Isometry3<f64>,
    params: &IcpParams,
) -> Result<IcpResult, RegisterError> {
    let source: Vec<Point3<f64>> =
        source_m.iter().copied().filter(|p| p.coords.iter().all(|c| c.is_finite())).collect();
    if source.len() < LEAST_PAIRS {
        return Err(RegisterError::TooFewPoints {
            what: "the source cloud",
            got: source.len(),
            needed: LEAST_PAIRS,
        });
    }
    let mut pose = target_from_source;
    let mut gate_m = params.max_distance_m;
    let mut points = params.coarse_points.max(LEAST_PAIRS);
    while points < source.len() {
        let stride = source.len().div_ceil(points);
        let coarse: Vec<_> = source.iter().copied().step_by(stride).collect();
        // Coarse steps only bring the pose near; what they cannot settle the dense ones will.
        let settled = (params.settled_rad * 100.0, params.settled_m * 100.0);
        let most = 4 * params.iterations_max;
        iterate(&coarse, target, &mut pose, &mut gate_m, params, most, settled)?;
        points = points.saturating_mul(LEVEL);
    }
    let settled = (params.settled_rad, params.settled_m);
    iterate(&source, target, &mut pose, &mut gate_m, params, params.iterations_max, settled)
}

fn iterate(
    source: &[Point3<f64>],
    target: &dyn Surface,
    pose: &mut Isometry3<f64>,
    gate_m: &mut f64,
    params: &IcpParams,
    iterations_max: usize,
    (settled_rad, settled_m): (f64, f64),
) -> Result<IcpResult, RegisterError> {
    let mut iteration = 0;
    loop {
        iteration += 1;
        let pairs = pair(source, target, pose, *gate_m, params.keep)?;
        let (normal, right, centroid_m, squares) = normal_equations(&pairs);
        check_rank(&normal)?;
        let twist = -normal.cholesky().ok_or(RegisterError::Degenerate { free: 1 })?.solve(&right);
        *pose = about(&centroid_m, &motion_of_twist(&twist)) * *pose;
        let moved_m = twist.fixed_rows::<3>(3).norm();
        let turned_rad = twist.fixed_rows::<3>(0).norm();
        // Six times the median holds nearly all true pairs, whatever noise or spacing it comes from.
        let median_m = median(pairs.iter().map(|p| p.point_m));
        *gate_m = (*gate_m).min((6.0 * median_m).max(2.0 * moved_m).max(params.min_distance_m));
        // A step of a tenth of the pose's own standard deviation says nothing any more: with noisy
        // clouds, pairs change for ever without leading anywhere.
        let variance = squares / pairs.len() as f64;
        let gained = twist.dot(&(normal * twist));
        // Nor does a step that is small against the distance of a cloud's points: hardly any pair would
        // change, and for these pairs this step is the last already.
        let reach_m = pairs.iter().step_by(64).map(|p| (p.moved_m - centroid_m).norm());
        let farthest_m = moved_m + turned_rad * reach_m.fold(0.0, f64::max);
        let settled = (turned_rad < settled_rad && moved_m < settled_m)
            || gained < 0.01 * variance
            || (target.is_sampled() && farthest_m < PAIRS_HOLD * median_m);
        if settled || iteration >= iterations_max {
            // The last step was small: its pairs still are the closest, and their squares are what a
            // least-squares step leaves.
            return Ok(IcpResult {
                target_from_source: *pose,
                rms_m: ((squares - gained).max(0.0) / pairs.len() as f64).sqrt(),
                overlap: pairs.len() as f64 / (params.keep * source.len() as f64),
                information: normal,
                centroid_m,
                settled,
            });
        }
    }
}

/// The `keep` closest pairs within `gate_m`, in the source's order.
fn pair(
    source: &[Point3<f64>],
    target: &dyn Surface,
    pose: &Isometry3<f64>,
    gate_m: f64,
    keep: f64,
) -> Result<Vec<Pair>, RegisterError> {
    let mut pairs: Vec<Pair> = source
        .par_iter()
        .filter_map(|point| {
            let moved = pose * point;
            let closest = target.closest(&moved, gate_m)?;
            Some(Pair {
                plane_m: (moved - closest.point_m).dot(&closest.normal),
                point_m: closest.distance_m,
                normal: closest.normal,
                moved_m: moved,
            })
        })
        .collect();
    let kept = (pairs.len() as f64 * keep.clamp(0.0, 1.0)) as usize;
    if kept < LEAST_PAIRS {
        return Err(RegisterError::NoOverlap { pairs: pairs.len(), max_distance_m: gate_m });
    }
    if kept < pairs.len() {
        let mut distances: Vec<f64> = pairs.iter().map(|p| p.plane_m.abs()).collect();
        let (_, limit, _) = distances.select_nth_unstable_by(kept - 1, f64::total_cmp);
        let limit = *limit;
        pairs.retain(|p| p.plane_m.abs() <= limit);
    }
    Ok(pairs)
}

/// Normal matrix and right side of the least-squares twist about the pairs' centroid, that centroid,
/// and the sum of squared distances. The distance of a pair changes by n . (w x r + t) with the
/// rotation vector w, the translation t, and r from the centroid.
fn normal_equations(pairs: &[Pair]) -> (Matrix6<f64>, Vector6<f64>, Point3<f64>, f64) {
    let sum = pairs.iter().fold(Vector3::zeros(), |sum, p| sum + p.moved_m.coords);
    let centroid = sum / pairs.len() as f64;
    // Chunks are summed in order, so that the result does not depend on the number of threads.
    let chunks: Vec<_> = pairs
        .par_chunks(4096)
        .map(|chunk| {
            let mut normal = Matrix6::zeros();
            let mut right = Vector6::zeros();
            let mut squares = 0.0;
            for Pair { plane_m: distance, normal: n, moved_m, .. } in chunk {
                let turn = (moved_m.coords - centroid).cross(n);
                let row = Vector6::new(turn.x, turn.y, turn.z, n.x, n.y, n.z);
                normal.ger(1.0, &row, &row, 1.0);
                right.axpy(*distance, &row, 1.0);
                squares += distance * distance;
            }
            (normal, right, squares)
        })
        .collect();
    let zero = (Matrix6::zeros(), Vector6::zeros(), 0.0);
    let (normal, right, squares) =
        chunks.into_iter().fold(zero, |a, b| (a.0 + b.0, a.1 + b.1, a.2 + b.2));
    (normal, right, Point3::from(centroid), squares)
}

/// Refuses overlaps that leave the pose free, by the normal matrix of a twist about their middle. The
/// rotation block is scaled by the pairs' spread, so that all six eigenvalues are shares of the pairs
/// (by weight: the normals are of unit length) that fix a direction.
pub(crate) fn check_rank(normal: &Matrix6<f64>) -> Result<(), RegisterError> {
    let turn = normal.fixed_view::<3, 3>(0, 0).trace();
    let shift = normal.fixed_view::<3, 3>(3, 3).trace();
    let scale = if turn > 0.0 { (shift / turn).sqrt() } else { 1.0 };
    let mut scaled = *normal / shift;
    for i in 0..3 {
        scaled.row_mut(i).scale_mut(scale);
        scaled.column_mut(i).scale_mut(scale);
    }
    let eigenvalues = SymmetricEigen::new(scaled).eigenvalues;
    // Noise of the normals alone gives about 1e-5 on a plane of good data.
    let free = eigenvalues.iter().filter(|v| **v < 1e-4).count();
    if free == 0 { Ok(()) } else { Err(RegisterError::Degenerate { free }) }
}

/// `motion`, which turns about the origin, as a motion that turns about `centre`.
fn about(centre: &Point3<f64>, motion: &Isometry3<f64>) -> Isometry3<f64> {
    let to_centre = Isometry3::translation(centre.x, centre.y, centre.z);
    to_centre * motion * to_centre.inverse()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
