//! Fine poses of the views: ICP between all pairs that overlap, and a pose graph over them.

use nalgebra::{Isometry3, Point3, Vector3};

use super::coarse::Poses;
use super::{FuseError, FuseParams, PairReport, View};
use crate::register::RegisterError;
use crate::register::icp::{self, IcpParams};
use crate::register::pose_graph::{self, Edge};
use crate::register::surface::{CloudSurface, Surface};
use crate::register::thin::thinned_by;

/// The good points of a view, spread evenly, ready to be searched.
pub struct Sparse {
    /// Points in the view's own frame, metres.
    pub points_m: Vec<Point3<f64>>,
    surface: Option<CloudSurface>,
}

/// Farthest pairs of an ICP that starts at closed poses, metres.
const FINE_M: f64 = 0.004;
/// Points that the overlap of a pair is estimated by.
const OVERLAP_POINTS: usize = 3000;

impl Sparse {
    /// The sparse clouds of all views.
    ///
    /// # Errors
    /// A view without enough good points.
    pub fn of_all(
        views: &[View],
        params: &FuseParams,
        progress: &mut dyn FnMut(String),
    ) -> Result<Vec<Self>, FuseError> {
        views
            .iter()
            .map(|view| {
                progress(format!("{}: spreading points", view.name));
                Self::of(view, params).map_err(|source| FuseError::Pair {
                    source_name: view.name.clone(),
                    target_name: "the model".into(),
                    source,
                })
            })
            .collect()
    }

    fn of(view: &View, params: &FuseParams) -> Result<Self, RegisterError> {
        let cos_min = params.incidence_max_deg.to_radians().cos() as f32;
        let good: Vec<Point3<f64>> = (0..view.points_m.len())
            .filter(|&k| view.sigma_m[k].is_finite() && view.incidence_cos[k] >= cos_min)
            .map(|k| view.points_m[k].cast())
            .collect();
        let chosen = thinned_by(&good, params.icp_cell_m);
        let points_m: Vec<_> = chosen.into_iter().map(|k| good[k]).collect();
        // The surface is denser than the source: its normals and its points' spacing set the limit.
        let dense = thinned_by(&good, (params.icp_cell_m / 2.0).max(params.cell_m));
        let dense: Vec<_> = dense.into_iter().map(|k| good[k]).collect();
        let surface = Some(CloudSurface::new(&dense)?);
        Ok(Self { points_m, surface })
    }

    /// Middle of its points.
    pub fn centroid(&self) -> Point3<f64> {
        let sum = self.points_m.iter().fold(Vector3::zeros(), |s, p| s + p.coords);
        Point3::from(sum / self.points_m.len().max(1) as f64)
    }

    #[cfg(test)]
    pub(super) fn for_test(points_m: Vec<Point3<f64>>) -> Self {
        Self { points_m, surface: None }
    }
}

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

/// A registered pair.
struct Pair {
    edge: Edge,
    centroid_m: Point3<f64>,
    overlap: f64,
    rms_m: f64,
}

/// Fine poses, from coarse ones.
///
/// # Errors
/// [`FuseError::Pair`] for neighbours that cannot be registered, [`FuseError::Apart`].
pub fn align(
    views: &[View],
    sparse: &[Sparse],
    start: &Poses,
    params: &FuseParams,
    progress: &mut dyn FnMut(String),
) -> Result<Aligned, FuseError> {
    let mut poses = start.first_from_view.clone();
    let mut reach_m = start.reach_m;
    let mut pairs = Vec::new();
    // From coarse poses first; from closed ones then, with a gate that leaves wrong pairs no room.
    for round in 0..2 {
        pairs.clear();
        for target in 0..views.len() {
            for source in target + 1..views.len() {
                let guess = poses[target].inverse() * poses[source];
                let overlap = overlap(&sparse[source], &sparse[target], &guess, reach_m);
                if overlap < params.overlap_min {
                    continue;
                }
                progress(format!(
                    "round {} of 2: {} onto {}",
                    round + 1,
                    views[source].name,
                    views[target].name
                ));
                let found = register(&sparse[source], &sparse[target], guess, reach_m);
                match found {
                    Ok(found) => {
                        if found.overlap < params.overlap_min {
                            continue;
                        }
                        let edge = Edge {
                            target,
                            source,
                            target_from_source: found.target_from_source,
                            information: found.information_about_origin()
                                / found.rms_m.max(1e-6).powi(2),
                        };
                        pairs.push(Pair {
                            edge,
                            centroid_m: found.centroid_m,
                            overlap: found.overlap,
                            rms_m: found.rms_m,
                        });
                    }
                    // Distant pairs may slide or miss; the graph tells when a view is left alone.
                    Err(error) if source == target + 1 && views.len() == 2 => {
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
        let edges: Vec<Edge> = pairs.iter().map(|p| p.edge.clone()).collect();
        let solved = pose_graph::solve(views.len(), &edges).map_err(|error| match error {
            RegisterError::Disconnected { view } => {
                FuseError::Apart { name: views[view].name.clone(), needed: params.overlap_min }
            }
            source => FuseError::Pair {
                source_name: "the views".into(),
                target_name: "each other".into(),
                source,
            },
        })?;
        poses = solved.first_from_view;
        reach_m = FINE_M;
    }
    let reports: Vec<PairReport> = pairs.iter().map(|p| report(p, &poses)).collect();
    Ok(Aligned {
        loop_open_mm: loop_open_mm(views.len(), &pairs, sparse),
        loop_closed_mm: reports.iter().map(|p| p.closed_mm).fold(0.0, f64::max),
        pairs: reports,
        first_from_view: poses,
    })
}

fn register(
    source: &Sparse,
    target: &Sparse,
    guess: Isometry3<f64>,
    reach_m: f64,
) -> Result<icp::IcpResult, RegisterError> {
    let surface = target.surface.as_ref().ok_or(RegisterError::EmptyMesh)?;
    let params = IcpParams {
        max_distance_m: reach_m,
        keep: 0.85,
        iterations_max: 30,
        settled_rad: 1e-6,
        settled_m: 1e-6,
        ..IcpParams::default()
    };
    icp::register(&source.points_m, surface, guess, &params)
}

/// Share of the source's points that are near the target.
fn overlap(source: &Sparse, target: &Sparse, guess: &Isometry3<f64>, reach_m: f64) -> f64 {
    let Some(surface) = &target.surface else { return 0.0 };
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
    let Edge { target, source, target_from_source, .. } = &pair.edge;
    let closed = poses[*target].inverse() * poses[*source];
    let in_source = target_from_source.inverse() * pair.centroid_m;
    let off = closed * in_source - target_from_source * in_source;
    PairReport {
        target: *target,
        source: *source,
        overlap: pair.overlap,
        rms_mm: pair.rms_m * 1e3,
        closed_mm: off.norm() * 1e3,
    }
}

/// How far the chain view by view misses the first view when it comes round, at the object's middle;
/// `None` when the last view does not overlap the first.
fn loop_open_mm(views: usize, pairs: &[Pair], sparse: &[Sparse]) -> Option<f64> {
    let motion = |target: usize, source: usize| {
        let of = |p: &&Pair| p.edge.target == target && p.edge.source == source;
        pairs.iter().find(of).map(|p| p.edge.target_from_source)
    };
    if views < 3 {
        return None;
    }
    let mut chain = Isometry3::identity();
    for source in 1..views {
        chain *= motion(source - 1, source)?;
    }
    let round = chain * motion(0, views - 1)?.inverse();
    let middle = sparse[0].centroid();
    Some((round * middle - middle).norm() * 1e3)
}
