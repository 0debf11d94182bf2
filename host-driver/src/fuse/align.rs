//! Fine poses of the views: ICP between all pairs that overlap, a pose graph over them, and all poses at
//! once.

use nalgebra::{Isometry3, Point3};

use super::coarse::Poses;
use super::refine::{self, Link};
use super::sparse::Sparse;
use super::{FuseError, FuseParams, PairReport, View};
use crate::register::RegisterError;
use crate::register::icp::{self, IcpParams};
use crate::register::pose_graph::{self, Edge};
use crate::register::surface::Surface;

/// Farthest pairs of points once the pose graph is solved, metres.
const FINE_M: f64 = 0.004;
/// Points that the overlap of a pair is estimated by.
const OVERLAP_POINTS: usize = 3000;
/// Without the rims, and counting only points whose normals agree, overlaps are smaller than the
/// clouds': this share of the least one is enough for a pair that holds views together.
const INNER_SHARE: f64 = 0.5;
/// Points of a view that coarse ICP uses.
const COARSE_POINTS: usize = 12_000;

/// Poses with loops closed.
pub struct Aligned {
    /// Maps each view into the first one's frame.
    pub first_from_view: Vec<Isometry3<f64>>,
    /// Every registered pair.
    pub pairs: Vec<PairReport>,
    /// How far the chain missed its start, millimetres.
    pub loop_open_mm: Option<f64>,
    /// How far any pair disagrees with the closed poses, millimetres.
    pub loop_closed_mm: f64,
}

/// A link and what it says alone.
struct Pair {
    link: Link,
    target_from_source: Isometry3<f64>,
    said: refine::Normal,
}

/// Fine poses, from coarse ones.
///
/// # Errors
/// [`FuseError::Pair`] for two views that cannot be registered, [`FuseError::Apart`].
pub fn align(
    views: &[View],
    sparse: &[Sparse],
    start: &Poses,
    params: &FuseParams,
    progress: &mut dyn FnMut(String),
) -> Result<Aligned, FuseError> {
    let mut poses = near(views, sparse, start, params, progress)?;
    let pairs = links(views, sparse, &poses, params, progress);
    let links: Vec<Link> = pairs.iter().map(|p| p.link).collect();
    if let Some(view) = apart(views.len(), &links) {
        return Err(FuseError::Apart {
            name: views[view].name.clone(),
            needed: params.overlap_min,
        });
    }
    refine::solve(sparse, &links, &mut poses, FINE_M, &mut |round| {
        progress(format!("all {} views at once, round {}", views.len(), round + 1));
    })
    .map_err(all_views)?;
    let reports: Vec<PairReport> = pairs.iter().map(|p| report(p, &poses)).collect();
    Ok(Aligned {
        loop_open_mm: loop_open_mm(views.len(), &pairs, sparse),
        loop_closed_mm: reports.iter().map(|p| p.closed_mm).fold(0.0, f64::max),
        pairs: reports,
        first_from_view: poses,
    })
}

/// What no single pair of views is to blame for.
fn all_views(source: RegisterError) -> FuseError {
    FuseError::Pair { source_name: "the views".into(), target_name: "each other".into(), source }
}

/// Poses by ICP between all pairs that overlap and a pose graph: to the tenths of a millimetre.
fn near(
    views: &[View],
    sparse: &[Sparse],
    start: &Poses,
    params: &FuseParams,
    progress: &mut dyn FnMut(String),
) -> Result<Vec<Isometry3<f64>>, FuseError> {
    let poses = &start.first_from_view;
    let mut edges = Vec::new();
    for target in 0..views.len() {
        for source in target + 1..views.len() {
            let guess = poses[target].inverse() * poses[source];
            let overlap = overlap(&sparse[source], &sparse[target], &guess, start.reach_m);
            if overlap < params.overlap_min {
                continue;
            }
            progress(format!("{} onto {}", views[source].name, views[target].name));
            match register(&sparse[source], &sparse[target], guess, start.reach_m) {
                Ok(found) if found.overlap < params.overlap_min => {}
                Ok(found) => edges.push(Edge {
                    target,
                    source,
                    target_from_source: found.target_from_source,
                    information: found.information_about_origin() / found.rms_m.max(1e-6).powi(2),
                }),
                // Of many pairs, some may slide or miss; the graph tells when a view is left alone.
                Err(error) if views.len() == 2 => {
                    return Err(FuseError::Pair {
                        source_name: views[source].name.clone(),
                        target_name: views[target].name.clone(),
                        source: error,
                    });
                }
                Err(_) => {}
            }
        }
    }
    let solved = pose_graph::solve(views.len(), &edges).map_err(|error| match error {
        RegisterError::Disconnected { view } => {
            FuseError::Apart { name: views[view].name.clone(), needed: params.overlap_min }
        }
        source => all_views(source),
    })?;
    Ok(solved.first_from_view)
}

fn register(
    source: &Sparse,
    target: &Sparse,
    guess: Isometry3<f64>,
    reach_m: f64,
) -> Result<icp::IcpResult, RegisterError> {
    let surface = target.surface().ok_or(RegisterError::EmptyMesh)?;
    let params = IcpParams {
        max_distance_m: reach_m,
        keep: 0.85,
        iterations_max: 30,
        settled_rad: 1e-5,
        settled_m: 1e-5,
        ..IcpParams::default()
    };
    let step = source.points_m.len().div_ceil(COARSE_POINTS).max(1);
    let points: Vec<_> = source.points_m.iter().copied().step_by(step).collect();
    icp::register(&points, surface, guess, &params)
}

/// Pairs of views that overlap at poses that are nearly right, each registered alone.
fn links(
    views: &[View],
    sparse: &[Sparse],
    poses: &[Isometry3<f64>],
    params: &FuseParams,
    progress: &mut dyn FnMut(String),
) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for target in 0..views.len() {
        for source in target + 1..views.len() {
            let link = Link { target, source };
            let guess = poses[target].inverse() * poses[source];
            let least = INNER_SHARE * params.overlap_min;
            if overlap(&sparse[source], &sparse[target], &guess, FINE_M) < least {
                continue;
            }
            progress(format!("{} and {} alone", views[source].name, views[target].name));
            let found = refine::alone(sparse, link, poses, FINE_M);
            if let Ok((target_from_source, said)) = found
                && said.overlap >= least
            {
                pairs.push(Pair { link, target_from_source, said });
            }
        }
    }
    // Pairs of little overlap only where they are needed: they can slide.
    pairs.sort_by(|a: &Pair, b: &Pair| b.said.overlap.total_cmp(&a.said.overlap));
    let mut part: Vec<usize> = (0..views.len()).collect();
    pairs.retain(|pair| {
        let (target, source) = (part[pair.link.target], part[pair.link.source]);
        part.iter_mut().filter(|p| **p == source).for_each(|p| *p = target);
        pair.said.overlap >= params.overlap_min || target != source
    });
    pairs.sort_by_key(|pair| (pair.link.target, pair.link.source));
    pairs
}

/// The first view that no links lead to from the first one.
fn apart(views: usize, links: &[Link]) -> Option<usize> {
    let mut reached = vec![false; views];
    reached[0] = true;
    for _ in 0..views {
        for Link { target, source } in links {
            let either = reached[*target] || reached[*source];
            (reached[*target], reached[*source]) = (either, either);
        }
    }
    reached.iter().position(|r| !r)
}

/// Share of the source's points that are near the target.
fn overlap(source: &Sparse, target: &Sparse, guess: &Isometry3<f64>, reach_m: f64) -> f64 {
    let Some(surface) = target.surface() else { return 0.0 };
    let step = source.points_m.len().div_ceil(OVERLAP_POINTS).max(1);
    let near = source
        .points_m
        .iter()
        .step_by(step)
        .filter(|p| surface.closest(&(guess * *p), reach_m).is_some())
        .count();
    near as f64 / source.points_m.len().div_ceil(step).max(1) as f64
}

fn report(pair: &Pair, poses: &[Isometry3<f64>]) -> PairReport {
    let Link { target, source } = pair.link;
    let closed = poses[target].inverse() * poses[source];
    let in_target = poses[target].inverse() * pair.said.middle_m;
    let in_source = closed.inverse() * in_target;
    let off = closed * in_source - pair.target_from_source * in_source;
    PairReport {
        target,
        source,
        overlap: pair.said.overlap,
        target_from_source: pair.target_from_source,
        rms_mm: pair.said.rms_m * 1e3,
        closed_mm: off.norm() * 1e3,
    }
}

/// How far the chain view by view misses the first view when it comes round, at the object's middle;
/// `None` when the last view does not overlap the first.
fn loop_open_mm(views: usize, pairs: &[Pair], sparse: &[Sparse]) -> Option<f64> {
    let motion = |target: usize, source: usize| {
        let link = Link { target, source };
        pairs.iter().find(|p| p.link == link).map(|p| p.target_from_source)
    };
    if views < 3 {
        return None;
    }
    let mut chain = Isometry3::identity();
    for source in 1..views {
        chain *= motion(source - 1, source)?;
    }
    let round = chain * motion(0, views - 1)?.inverse();
    let middle: Point3<f64> = sparse[0].centroid();
    Some((round * middle - middle).norm() * 1e3)
}
