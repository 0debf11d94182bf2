//! Joint refinement: the poses of all views at once, by all pairs of points that belong together.
//!
//! A pair of points p and q of two views, in the first view's frame, is apart by d = n . (p - q), with n
//! the mean of both normals: with each view's own normal alone, the error of a curved surface that is
//! known at points only does not cancel (Rusinkiewicz 2019, "A symmetric objective function for ICP").
//! Pairs count by the noise model and, since what is wrong in a view is systematic and not noise, by
//! Tukey's biweight of their distance: folds, rims and wrong points have no say.
//!
//! ```text
//! d changes by  row . (xi_source - xi_target),  row = (p x n, n)
//! ```
//! with each view's twist xi (rotation vector, translation) in the first view's frame, which gives one
//! system of 6 unknowns for each view but the first.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, Point3, Vector3, Vector6};
use rayon::prelude::*;

use super::sparse::{Field, Sample, Sparse};
use crate::register::icp::check_rank;
use crate::register::{RegisterError, motion_of_twist};

/// Normals of points that belong together agree within 40 degrees.
const NORMAL_COS: f64 = 0.77;
/// The nearest point of the same place is nearer, across the normal, than so many spacings; beyond a
/// view's end it is farther.
const ACROSS: f64 = 1.0;
/// Tukey's constant: pairs farther apart than so many robust standard deviations do not count.
const TUKEY: f64 = 4.0;
/// The robust standard deviation is not taken for less than this, metres: rounding of the clouds.
const SCALE_MIN_M: f64 = 2e-6;
/// Least number of pairs of points of two views.
const PAIRS_MIN: usize = 100;
/// Most rounds.
const ROUNDS: usize = 25;
/// Size of what two views alone share, to tell whether they have settled, metres.
const ALONE_SIZE_M: f64 = 0.2;
/// Poses have settled when no view moves by more than this at the object's size, metres.
const SETTLED_M: f64 = 1e-6;

/// Two views that overlap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Link {
    /// The one view.
    pub target: usize,
    /// The other.
    pub source: usize,
}

/// What two views say of their poses, at the poses given.
#[derive(Debug, Clone)]
pub struct Normal {
    /// Normal matrix of a twist of the source about `centre_m`, per square metre.
    pub matrix: Matrix6<f64>,
    /// Right side of that twist.
    pub right: Vector6<f64>,
    /// Pairs of points that count.
    pub pairs: usize,
    /// Share of the samples that have a pair, of the view that is covered more.
    pub overlap: f64,
    /// Weighted RMS of the pairs' distances along the normal, metres.
    pub rms_m: f64,
    /// Weighted middle of the pairs in the first view's frame.
    pub middle_m: Point3<f64>,
}

/// A link alone: the motion that its pairs ask for, and what they say there.
///
/// # Errors
/// As [`solve`].
pub fn alone(
    sparse: &[Sparse],
    link: Link,
    first_from_view: &[Isometry3<f64>],
    gate_m: f64,
) -> Result<(Isometry3<f64>, Normal), RegisterError> {
    let mut poses = first_from_view.to_vec();
    let mut gate_m = gate_m;
    let mut round = 0;
    let mut centre = poses[link.source] * sparse[link.source].centroid();
    loop {
        round += 1;
        let normal = normal_of(sparse, link, &poses, &centre, &mut gate_m)?;
        check_rank(&normal.matrix)?;
        let factor = normal.matrix.cholesky().ok_or(RegisterError::Degenerate { free: 1 })?;
        let twist = -factor.solve(&normal.right);
        poses[link.source] = motion_about(&centre, &twist) * poses[link.source];
        centre = normal.middle_m;
        if moved_m(&twist, ALONE_SIZE_M) < SETTLED_M || round >= ROUNDS {
            return Ok((poses[link.target].inverse() * poses[link.source], normal));
        }
    }
}

/// The motion of a twist about `centre_m`.
fn motion_about(centre_m: &Point3<f64>, twist: &Vector6<f64>) -> Isometry3<f64> {
    let about = Isometry3::translation(centre_m.x, centre_m.y, centre_m.z);
    about * motion_of_twist(twist) * about.inverse()
}

/// How far a twist moves points of an object of this size.
fn moved_m(twist: &Vector6<f64>, size_m: f64) -> f64 {
    twist.fixed_rows::<3>(3).norm() + size_m * twist.fixed_rows::<3>(0).norm()
}

/// A pair of points in the first view's frame.
struct Match {
    at_m: Point3<f64>,
    normal: Vector3<f64>,
    /// n . (source - target).
    apart_m: f64,
    variance_m2: f64,
}

/// Refines the poses of all views by the links; `gate_m` is how far apart points may be at first.
///
/// # Errors
/// [`RegisterError::NoOverlap`] for a link without pairs, [`RegisterError::Degenerate`] when a view can
/// slide.
pub fn solve(
    sparse: &[Sparse],
    links: &[Link],
    first_from_view: &mut [Isometry3<f64>],
    gate_m: f64,
    rounds: &mut dyn FnMut(usize),
) -> Result<(), RegisterError> {
    let views = first_from_view.len();
    let (centre, size_m) = extent(sparse, first_from_view);
    let mut gates: Vec<f64> = vec![gate_m; links.len()];
    for round in 0..ROUNDS {
        rounds(round);
        let mut matrix = DMatrix::<f64>::zeros(6 * views, 6 * views);
        let mut right = DVector::<f64>::zeros(6 * views);
        for (link, gate) in links.iter().zip(&mut gates) {
            let normal = normal_of(sparse, *link, first_from_view, &centre, gate)?;
            let (t, s) = (6 * link.target, 6 * link.source);
            for (row, column, sign) in [(s, s, 1.0), (t, t, 1.0), (s, t, -1.0), (t, s, -1.0)] {
                let mut block = matrix.fixed_view_mut::<6, 6>(row, column);
                block += normal.matrix * sign;
            }
            let mut part = right.fixed_rows_mut::<6>(s);
            part += normal.right;
            let mut part = right.fixed_rows_mut::<6>(t);
            part -= normal.right;
        }
        // The first view stays where it is.
        let unknown = 6 * (views - 1);
        let matrix = matrix.view((6, 6), (unknown, unknown)).into_owned();
        let right = right.rows(6, unknown).into_owned();
        let factor = matrix.cholesky().ok_or(RegisterError::Degenerate { free: 1 })?;
        let step = -factor.solve(&right);
        let mut farthest_m: f64 = 0.0;
        for (view, pose) in first_from_view.iter_mut().enumerate().skip(1) {
            let twist: Vector6<f64> = step.fixed_rows::<6>(6 * (view - 1)).into_owned();
            farthest_m = farthest_m.max(moved_m(&twist, size_m));
            *pose = motion_about(&centre, &twist) * *pose;
        }
        if farthest_m < SETTLED_M {
            break;
        }
    }
    Ok(())
}

/// What a link says at the poses given, about `centre_m`. `gate_m` closes to what the pairs need.
///
/// # Errors
/// [`RegisterError::NoOverlap`].
pub fn normal_of(
    sparse: &[Sparse],
    link: Link,
    first_from_view: &[Isometry3<f64>],
    centre_m: &Point3<f64>,
    gate_m: &mut f64,
) -> Result<Normal, RegisterError> {
    let (of_target, of_source) = (&sparse[link.target], &sparse[link.source]);
    let (target, source) = (&first_from_view[link.target], &first_from_view[link.source]);
    let mut matches = pairs(of_source, source, of_target.field.as_ref(), target, *gate_m);
    let back = pairs(of_target, target, of_source.field.as_ref(), source, *gate_m);
    let share = |pairs: usize, of: &Sparse| pairs as f64 / of.samples.len().max(1) as f64;
    let overlap = share(matches.len(), of_source).max(share(back.len(), of_target));
    matches.extend(back.into_iter().map(|m| Match { apart_m: -m.apart_m, ..m }));
    if matches.len() < PAIRS_MIN {
        return Err(RegisterError::NoOverlap { pairs: matches.len(), max_distance_m: *gate_m });
    }
    // Distances against their noise, and how much of it they really scatter.
    let mut scores: Vec<f64> =
        matches.iter().map(|m| m.apart_m.abs() / m.variance_m2.sqrt()).collect();
    let middle = scores.len() / 2;
    let median = *scores.select_nth_unstable_by(middle, f64::total_cmp).1;
    let mean_variance_m2 =
        matches.iter().map(|m| m.variance_m2).sum::<f64>() / matches.len() as f64;
    let scale = (1.4826 * median).max(SCALE_MIN_M / mean_variance_m2.sqrt());
    *gate_m = gate_m.min((3.0 * TUKEY * scale * mean_variance_m2.sqrt()).max(5e-5));
    let (mut matrix, mut right) = (Matrix6::zeros(), Vector6::zeros());
    let (mut weights, mut squares, mut sum, mut counted) = (0.0, 0.0, Vector3::zeros(), 0);
    for m in &matches {
        let sigma_m = scale * m.variance_m2.sqrt();
        let beyond = m.apart_m / (TUKEY * sigma_m);
        if beyond.abs() >= 1.0 {
            continue;
        }
        let weight = (1.0 - beyond * beyond).powi(2) / (sigma_m * sigma_m);
        let turn = (m.at_m - centre_m).cross(&m.normal);
        let row = Vector6::new(turn.x, turn.y, turn.z, m.normal.x, m.normal.y, m.normal.z);
        matrix.ger(weight, &row, &row, 1.0);
        right.axpy(weight * m.apart_m, &row, 1.0);
        weights += weight;
        squares += weight * m.apart_m * m.apart_m;
        sum += m.at_m.coords * weight;
        counted += 1;
    }
    Ok(Normal {
        matrix,
        right,
        pairs: counted,
        overlap,
        rms_m: (squares / weights).sqrt(),
        middle_m: Point3::from(sum / weights),
    })
}

/// Samples of one view and the nearest ones of another, in the first view's frame.
fn pairs(
    from: &Sparse,
    first_from_from: &Isometry3<f64>,
    onto: Option<&Field>,
    first_from_onto: &Isometry3<f64>,
    gate_m: f64,
) -> Vec<Match> {
    let Some(onto) = onto else { return Vec::new() };
    let onto_from_from = first_from_onto.inverse() * first_from_from;
    let across_m = ACROSS * onto.spacing_m;
    from.samples
        .par_iter()
        .filter_map(|sample| {
            let moved = Sample {
                point_m: onto_from_from * sample.point_m,
                normal: onto_from_from.rotation * sample.normal,
                ..*sample
            };
            let near = onto.nearest(&moved.point_m);
            if near.normal.dot(&moved.normal) < NORMAL_COS {
                return None;
            }
            let normal = (near.normal + moved.normal).normalize();
            let offset = moved.point_m - near.point_m;
            let apart_m = offset.dot(&normal);
            let across = (offset - normal * apart_m).norm();
            (apart_m.abs() <= gate_m && across <= across_m).then(|| Match {
                at_m: first_from_onto * moved.point_m,
                normal: first_from_onto.rotation * normal,
                apart_m,
                variance_m2: moved.sigma_m * moved.sigma_m + near.sigma_m * near.sigma_m,
            })
        })
        .collect()
}

/// Middle of all views' samples in the first view's frame, and their RMS distance from it, metres.
pub fn extent(sparse: &[Sparse], first_from_view: &[Isometry3<f64>]) -> (Point3<f64>, f64) {
    let places: Vec<Point3<f64>> = sparse
        .iter()
        .zip(first_from_view)
        .flat_map(|(s, pose)| s.samples.iter().step_by(16).map(move |p| pose * p.point_m))
        .collect();
    let count = places.len().max(1) as f64;
    let middle =
        Point3::from(places.iter().fold(Vector3::zeros(), |sum, p| sum + p.coords) / count);
    let squares: f64 = places.iter().map(|p| (p - middle).norm_squared()).sum();
    (middle, (squares / count).sqrt())
}
