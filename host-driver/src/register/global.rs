//! Global registration: lays one cloud on another from anywhere, without features or a start.
//!
//! Two points with normals fix a rigid motion. Pairs of points of the source are looked up among the
//! pairs of the target by what motion does not change (their distance and the angles of both normals
//! to it and to each other; after Drost et al. 2010); each match proposes a motion, and the motion
//! that lays most of the source on the target with agreeing normals wins.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use super::RegisterError;
use super::surface::{CloudSurface, Surface};
use super::thin::{CellMap, cell_key, thinned, thinned_by};
use crate::measure::units::bulk_extent;

/// How a motion is searched for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GlobalParams {
    /// Points of each cloud that pairs are made of.
    pub points: usize,
    /// Pairs of the source that are looked up.
    pub pairs: usize,
    /// Fewest of the source's points that the motion must lay on the target, a share.
    pub overlap_min: f64,
    /// Both clouds are in a sensor's frame: it saw them from the origin, so that normals have a side.
    pub seen_from_origin: bool,
}

impl Default for GlobalParams {
    fn default() -> Self {
        Self { points: 1200, pairs: 500, overlap_min: 0.3, seen_from_origin: false }
    }
}

/// A coarse motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coarse {
    /// Maps source points near the target.
    pub target_from_source: Isometry3<f64>,
    /// Share of the source's points that lie on the target with agreeing normals.
    pub overlap: f64,
    /// Distance within which a point counts as lying on the target, metres: where ICP starts.
    pub reach_m: f64,
}

/// Points of a cloud that normals are estimated from.
const DENSE: usize = 25_000;
/// Bins of an angle's cosine.
const ANGLE_BINS: f64 = 7.0;
/// Most target pairs that one source pair is tried on.
const TRIES: usize = 300;
/// Points that a motion is judged by at first; it is given up when the first 15 are nowhere.
const JUDGES: usize = 60;
/// Motions that are judged by all points.
const FINALISTS: usize = 60;
/// Normals agree when they are nearer than this (32 degrees): surfaces curve within the reach.
const NORMAL_COS: f64 = 0.85;
/// Points of the source that the last motions are judged by, finely.
const FINE: usize = 5000;
/// Motions that are judged finely.
const FINE_MOTIONS: usize = 8;

/// Points with normals, evenly spread.
struct Oriented {
    points: Vec<Point3<f64>>,
    normals: Vec<Vector3<f64>>,
}

impl Oriented {
    /// All points of a surface; normals look to the origin where that is the sensor.
    fn of_surface(dense: &CloudSurface, seen_from_origin: bool) -> Self {
        let points: Vec<Point3<f64>> = dense.points_m().iter().map(|p| Point3::from(*p)).collect();
        let side = |(p, n): (&Point3<f64>, &Vector3<f64>)| {
            if seen_from_origin && n.dot(&p.coords) > 0.0 { -n } else { *n }
        };
        let normals = points.iter().zip(dense.normals()).map(side).collect();
        Self { points, normals }
    }

    /// About `points` of them, evenly spread.
    fn thinned(&self, points: usize) -> Self {
        if self.points.len() <= points {
            return Self { points: self.points.clone(), normals: self.normals.clone() };
        }
        let (extent, _) = bulk_extent(&self.points);
        let mut cell_m = (extent / (points as f64).sqrt() / 2.0).max(1e-9);
        loop {
            let chosen = thinned_by(&self.points, cell_m);
            if chosen.len() <= points {
                let points = chosen.iter().map(|k| self.points[*k]).collect();
                let normals = chosen.iter().map(|k| self.normals[*k]).collect();
                return Self { points, normals };
            }
            cell_m *= (chosen.len() as f64 / points as f64).sqrt() * 1.05;
        }
    }
}

/// Finds the motion that lays `source_m` on `target_m`.
///
/// # Errors
/// [`RegisterError::TooFewPoints`]; [`RegisterError::NoPose`] when no motion lays enough of the source
/// on the target.
pub fn register(
    source_m: &[Point3<f64>],
    target_m: &[Point3<f64>],
    params: &GlobalParams,
) -> Result<Coarse, RegisterError> {
    let seen = params.seen_from_origin;
    let dense = CloudSurface::new(&thinned(source_m, DENSE))?;
    let source_dense = Oriented::of_surface(&dense, seen);
    let source = source_dense.thinned(params.points);
    let target_surface = CloudSurface::new(&thinned(target_m, DENSE))?;
    let target_dense = Oriented::of_surface(&target_surface, seen);
    let target = target_dense.thinned(params.points);
    let size = bulk_extent(source_m).0.min(bulk_extent(target_m).0);
    // A surface of that size has about (size / cell)^2 / 2 cells; points are about a cell apart.
    let cell = size / (params.points as f64).sqrt();
    let reach_m = 0.8 * cell;
    let lengths = 0.25 * size..0.7 * size;
    let table = pairs_by_key(&target, &lengths, cell);
    let near = Near::new(&target_dense, reach_m, seen);
    let count = source.points.len() as u64;
    let mut best: Vec<(f64, Isometry3<f64>)> = (0..params.pairs as u64)
        .into_par_iter()
        .flat_map_iter(|k| {
            let mut draw = crate::measure::robust::Draw(k.wrapping_mul(0xA24B_AED4_963E_E407));
            let pair = (0..50).find_map(|_| {
                let (i, j) = (draw.below(count as usize), draw.below(count as usize));
                let length = (source.points[j] - source.points[i]).norm();
                lengths.contains(&length).then_some((i, j))
            });
            let found = pair.into_iter().flat_map(|(i, j)| {
                let key = key(&source, i, j, cell);
                let matches = table.get(&key).map_or(&[][..], Vec::as_slice);
                let step = matches.len().div_ceil(TRIES).max(1);
                matches.iter().step_by(step).flat_map(move |&(a, b)| [(i, j, a, b)])
            });
            let mut kept: Vec<(f64, Isometry3<f64>)> = found
                .flat_map(|(i, j, a, b)| {
                    motions(&source, i, j, &target, [a as usize, b as usize], seen)
                })
                .filter_map(|motion| Some((near.judged(&source, &motion)?, motion)))
                .collect();
            kept.sort_by(|m, n| n.0.total_cmp(&m.0));
            kept.truncate(3);
            kept
        })
        .collect();
    best.sort_by(|m, n| n.0.total_cmp(&m.0));
    best.truncate(FINALISTS);
    let mut settled: Vec<(f64, Isometry3<f64>)> = best
        .par_iter()
        .map(|(_, motion)| {
            let motion = settle(&source.points, &target_surface, motion, reach_m);
            (fit(&source, &target_surface, &motion, 0.5 * reach_m), motion)
        })
        .collect();
    settled.sort_by(|m, n| n.0.total_cmp(&m.0));
    settled.truncate(FINE_MOTIONS);
    // Flat surfaces lie on each other nearly anywhere: what tells the right motion is how closely.
    let fine = source_dense.thinned(FINE);
    let winner = settled
        .par_iter()
        .map(|(_, motion)| {
            let motion = settle(&fine.points, &target_surface, motion, 0.5 * reach_m);
            (fit(&fine, &target_surface, &motion, 0.06 * reach_m), motion)
        })
        .max_by(|m, n| m.0.total_cmp(&n.0));
    let overlap = winner.as_ref().map_or(0.0, |(_, motion)| {
        on_target(&source, &target_surface, motion, reach_m) as f64 / source.points.len() as f64
    });
    match winner {
        Some((_, target_from_source)) if overlap >= params.overlap_min => {
            Ok(Coarse { target_from_source, overlap, reach_m: 0.5 * reach_m })
        }
        _ => Err(RegisterError::NoPose { overlap, needed: params.overlap_min }),
    }
}

/// What a motion does not change of a pair. Normals count without their sign.
fn key(cloud: &Oriented, i: usize, j: usize, cell: f64) -> u64 {
    let d = cloud.points[j] - cloud.points[i];
    let length = d.norm();
    let (n, m) = (cloud.normals[i], cloud.normals[j]);
    let bin = |cosine: f64| (cosine.abs().min(1.0) * ANGLE_BINS).round() as u64;
    let length_bin = (length / (0.7 * cell)).round() as u64;
    length_bin << 24 | bin(n.dot(&d) / length) << 16 | bin(m.dot(&d) / length) << 8 | bin(n.dot(&m))
}

fn pairs_by_key(
    cloud: &Oriented,
    lengths: &std::ops::Range<f64>,
    cell: f64,
) -> CellMap<Vec<(u32, u32)>> {
    let mut table: CellMap<Vec<(u32, u32)>> = CellMap::default();
    for i in 0..cloud.points.len() {
        for j in 0..cloud.points.len() {
            let length = (cloud.points[j] - cloud.points[i]).norm();
            if i != j && lengths.contains(&length) {
                table.entry(key(cloud, i, j, cell)).or_default().push((i as u32, j as u32));
            }
        }
    }
    table
}

/// The two motions that lay pair (i, j) of the source on pair (a, b) of the target: the first normals
/// agree or oppose each other. Those under which the second normals disagree are left out.
fn motions(
    source: &Oriented,
    i: usize,
    j: usize,
    target: &Oriented,
    [a, b]: [usize; 2],
    sided: bool,
) -> Vec<Isometry3<f64>> {
    let frame = |d: &Vector3<f64>, n: &Vector3<f64>| {
        let x = d.normalize();
        let y = (n - x * n.dot(&x)).try_normalize(0.15)?;
        Some(Matrix3::from_columns(&[x, y, x.cross(&y)]))
    };
    let from = frame(&(source.points[j] - source.points[i]), &source.normals[i]);
    let middle =
        |cloud: &Oriented, i: usize, j: usize| nalgebra::center(&cloud.points[i], &cloud.points[j]);
    let mut motions = Vec::new();
    let signs: &[f64] = if sided { &[1.0] } else { &[1.0, -1.0] };
    for &sign in signs {
        let to = frame(&(target.points[b] - target.points[a]), &(target.normals[a] * sign));
        let (Some(from), Some(to)) = (from, to) else { continue };
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(
            to * from.transpose(),
        ));
        let agrees = (rotation * source.normals[j]).dot(&target.normals[b]);
        if (if sided { agrees } else { agrees.abs() }) < NORMAL_COS {
            continue;
        }
        let shift = middle(target, a, b) - rotation * middle(source, i, j);
        motions.push(Isometry3::from_parts(Translation3::from(shift), rotation));
    }
    motions
}

/// Points with normals by place, for judging many motions: cells within the reach of the target's.
struct Near {
    cells: CellMap<(Point3<f64>, Vector3<f64>)>,
    reach_m: f64,
    sided: bool,
}

impl Near {
    fn new(target: &Oriented, reach_m: f64, sided: bool) -> Self {
        let mut cells = CellMap::default();
        let all = || target.points.iter().zip(&target.normals);
        for (point, normal) in all() {
            cells.entry(cell_key(point, reach_m)).or_insert((*point, *normal));
        }
        // Cells around come after, so that they never take an own one's place.
        for (point, normal) in all() {
            for (axis, sign) in [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)] {
                let mut beside = *point;
                beside[axis] += sign * reach_m;
                cells.entry(cell_key(&beside, reach_m)).or_insert((*point, *normal));
            }
        }
        Self { cells, reach_m, sided }
    }

    /// How well the judges lie on the target; `None` when it is hopeless.
    fn judged(&self, source: &Oriented, motion: &Isometry3<f64>) -> Option<f64> {
        let step = (source.points.len() / JUDGES).max(1);
        let (mut on, mut score) = (0, 0.0);
        for (k, i) in (0..source.points.len()).step_by(step).enumerate() {
            let moved = motion * source.points[i];
            if let Some((point, normal)) = self.cells.get(&cell_key(&moved, self.reach_m)) {
                let dot = (motion * source.normals[i]).dot(normal);
                let agrees = if self.sided { dot } else { dot.abs() };
                let off = (moved - point).dot(normal) / self.reach_m;
                if agrees > NORMAL_COS && off.abs() < 1.0 {
                    on += 1;
                    score += (1.0 - off * off) * (agrees - NORMAL_COS);
                }
            }
            if k == 14 && on < 4 {
                return None;
            }
        }
        Some(score)
    }
}

/// How closely the source lies on the target: 1 a point that is on it, less with the distance along the
/// normal, 0 from `width_m` on.
fn fit(source: &Oriented, target: &CloudSurface, motion: &Isometry3<f64>, width_m: f64) -> f64 {
    let mut sum = 0.0;
    for (point, normal) in source.points.iter().zip(&source.normals) {
        let moved = motion * point;
        let Some(closest) = target.closest(&moved, 8.0 * width_m) else { continue };
        let off = (moved - closest.point_m).dot(&closest.normal) / width_m;
        if off.abs() < 1.0 && (motion * normal).dot(&closest.normal).abs() > NORMAL_COS {
            sum += 1.0 - off * off;
        }
    }
    sum
}

/// How many of the source's points lie on the target.
fn on_target(
    source: &Oriented,
    target: &CloudSurface,
    motion: &Isometry3<f64>,
    reach_m: f64,
) -> usize {
    let lies = |(point, normal): &(&Point3<f64>, &Vector3<f64>)| {
        let closest = target.closest(&(motion * *point), reach_m);
        closest.is_some_and(|c| (motion * *normal).dot(&c.normal).abs() > NORMAL_COS)
    };
    source.points.iter().zip(&source.normals).filter(lies).count()
}

/// A few point-to-plane steps, so that a motion is judged by where it leads.
fn settle(
    source_m: &[Point3<f64>],
    target: &CloudSurface,
    motion: &Isometry3<f64>,
    reach_m: f64,
) -> Isometry3<f64> {
    let params = super::icp::IcpParams {
        max_distance_m: 1.5 * reach_m,
        min_distance_m: 0.3 * reach_m,
        keep: 0.9,
        iterations_max: 12,
        coarse_points: usize::MAX,
        ..super::icp::IcpParams::default()
    };
    super::icp::register(source_m, target, *motion, &params)
        .map_or(*motion, |settled| settled.target_from_source)
}

/// Points spread over a mesh by area, as many as global registration and ICP need of a target.
pub fn samples_of_mesh(triangles: &[[Point3<f64>; 3]]) -> Vec<Point3<f64>> {
    const SAMPLES: f64 = 60_000.0;
    let area = |t: &[Point3<f64>; 3]| (t[1] - t[0]).cross(&(t[2] - t[0])).norm() / 2.0;
    let total: f64 = triangles.iter().map(area).filter(|a| a.is_finite()).sum();
    let mut draw = crate::measure::robust::Draw(1);
    let mut uniform = move || draw.next() as f64 / u64::MAX as f64;
    let (mut owed, mut samples) = (0.0, Vec::new());
    for t in triangles {
        let share = area(t) / total * SAMPLES;
        owed += if share.is_finite() { share } else { 0.0 };
        while owed >= 1.0 {
            owed -= 1.0;
            let (mut u, mut v) = (uniform(), uniform());
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            samples.push(t[0] + (t[1] - t[0]) * u + (t[2] - t[0]) * v);
        }
    }
    samples
}
