//! Fusion: several views of a thing into one model.
//!
//! ```text
//! views ─► coarse (turntable, guide, global) ─► pairwise ICP ─► robust pose graph (to 0.1 mm)
//!                                                                    │
//!                  sparse, without rims ─► all views at once (refine: loops closed)
//!                                                                    │
//!          model ◄─ layers, strays removed ◄─ weighted grid ◄────────┘
//! ```
//! The model is in the frame of the first view. Points are weighted by the noise model: the depth
//! noise of a stereo sensor grows with the square of the distance, and with the angle at which the
//! surface is seen.

pub mod align;
pub mod coarse;
pub mod grid;
pub mod noise;
pub mod refine;
pub mod sparse;
pub mod view;

use nalgebra::{Isometry3, Point3, Vector3};
use serde::Serialize;

pub use view::View;

use crate::register::RegisterError;

/// How the views are brought near each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// They are near each other as they are.
    Given,
    /// Each on the one before, from anywhere.
    Global,
    /// Each on the first, which shows everything, from anywhere.
    Guide,
    /// The object turned by the same angle between views, about an axis that is found from the first
    /// two, or given.
    Turntable {
        /// Angle from a view to the next, radians; the sign is found when the axis is.
        step_rad: f64,
        /// A point on the axis and its direction in the first view's frame.
        axis: Option<(Point3<f64>, Vector3<f64>)>,
    },
}

/// How views are fused.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FuseParams {
    /// How the views are brought near each other.
    pub start: Start,
    /// Edge of the model's cells, metres: about its point spacing.
    pub cell_m: f64,
    /// Spacing of the points that ICP uses, metres.
    pub icp_cell_m: f64,
    /// Points seen at a more grazing angle do not count, degrees.
    pub incidence_max_deg: f64,
    /// Surfaces closer than this behind or before a better one are taken for errors, metres.
    pub layer_m: f64,
    /// Pairs of views with less overlap are not registered, a share.
    pub overlap_min: f64,
}

impl Default for FuseParams {
    fn default() -> Self {
        Self {
            start: Start::Global,
            cell_m: 5e-4,
            icp_cell_m: 2e-3,
            incidence_max_deg: 72.0,
            layer_m: 4e-3,
            overlap_min: 0.25,
        }
    }
}

/// Why views cannot be fused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FuseError {
    /// One view is none.
    #[error("expected at least two views, got {got}")]
    Views {
        /// Views given.
        got: usize,
    },
    /// A parameter that cannot be.
    #[error("{name}: expected {expected}")]
    Parameter {
        /// Its name.
        name: &'static str,
        /// What it has to be.
        expected: &'static str,
    },
    /// A view shows no surface.
    #[error(
        "{name}: its points make no surface that another view could be laid on (a line, a scatter, or \
         all seen too aslant)"
    )]
    View {
        /// The view.
        name: String,
    },
    /// A pair of views cannot be registered.
    #[error("{source_name} onto {target_name}: {source}")]
    Pair {
        /// The view registered.
        source_name: String,
        /// The view registered onto.
        target_name: String,
        /// Why.
        source: RegisterError,
    },
    /// The views fall apart.
    #[error(
        "{name} is connected to no other view by an overlap of {:.0} % or more: take views in between, \
         or leave it out", 100.0 * .needed
    )]
    Apart {
        /// The view.
        name: String,
        /// Overlap needed, a share.
        needed: f64,
    },
}

/// How far a pair of views was from agreeing with all others.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PairReport {
    /// View registered onto.
    pub target: usize,
    /// View registered.
    pub source: usize,
    /// Share of the source that is on the target.
    pub overlap: f64,
    /// RMS of the point-to-plane distances, millimetres.
    pub rms_mm: f64,
    /// The motion that the pair alone asks for.
    #[serde(skip)]
    pub target_from_source: Isometry3<f64>,
    /// How far the pair's own motion and the closed poses disagree at the overlap, millimetres.
    pub closed_mm: f64,
}

/// The fused model.
#[derive(Debug, Clone)]
pub struct Model {
    /// Points with normals, noise and brightness, in the first view's frame.
    pub points: Vec<ModelPoint>,
    /// Maps each view into the first one's frame.
    pub first_from_view: Vec<Isometry3<f64>>,
    /// Every registered pair.
    pub pairs: Vec<PairReport>,
    /// How far the chain of neighbours, each registered alone, misses its start when it comes round, at the
    /// object's middle, millimetres; `None` without a loop.
    pub loop_open_mm: Option<f64>,
    /// How far any registered pair, alone, would still move from the poses that all views were given
    /// together, at the middle of its overlap, millimetres.
    pub loop_closed_mm: f64,
    /// Points that went in, over all views.
    pub points_in: usize,
    /// Cells that were removed as strays or as layers of errors.
    pub removed: usize,
}

/// A point of a [`Model`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModelPoint {
    /// Position in the first view's frame, metres.
    pub point_m: Point3<f64>,
    /// Unit normal towards the sensors that saw it.
    pub normal: Vector3<f32>,
    /// One standard deviation along the normal by the noise model, millimetres.
    pub noise_mm: f32,
    /// Brightness, 0 to 255.
    pub intensity: u8,
    /// Views that saw it.
    pub views: u8,
}

/// Fuses views; `progress` is told each step.
///
/// # Errors
/// [`FuseError`].
pub fn fuse(
    views: &[View],
    params: &FuseParams,
    progress: &mut dyn FnMut(String),
) -> Result<Model, FuseError> {
    check(views, params)?;
    let sparse = sparse::Sparse::of_all(views, params, progress)?;
    let start = coarse::poses(views, &sparse, params, progress)?;
    let aligned = align::align(views, &sparse, &start, params, progress)?;
    progress("fusing".into());
    let fused = grid::fuse(views, &aligned.first_from_view, params, progress);
    Ok(Model {
        points: fused.points,
        first_from_view: aligned.first_from_view,
        pairs: aligned.pairs,
        loop_open_mm: aligned.loop_open_mm,
        loop_closed_mm: aligned.loop_closed_mm,
        points_in: views.iter().map(|v| v.points_m.len()).sum(),
        removed: fused.removed,
    })
}

fn check(views: &[View], params: &FuseParams) -> Result<(), FuseError> {
    if views.len() < 2 {
        return Err(FuseError::Views { got: views.len() });
    }
    let wrong = |name, expected| Err(FuseError::Parameter { name, expected });
    let p = params;
    if !(1e-5..=0.1).contains(&p.cell_m) {
        return wrong("cell", "0.01 to 100 mm");
    }
    if !(p.cell_m..=0.1).contains(&p.icp_cell_m) {
        return wrong("ICP spacing", "at least the cell, at most 100 mm");
    }
    if !(10.0..=90.0).contains(&p.incidence_max_deg) {
        return wrong("largest incidence", "10 to 90 degrees");
    }
    if let Start::Turntable { step_rad, .. } = p.start
        && !(1e-3..=1.6).contains(&step_rad.abs())
    {
        return wrong("turntable step", "a step of 0.06 to 90 degrees");
    }
    Ok(())
}
