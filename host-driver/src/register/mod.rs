//! Registration: which rigid motion lays one cloud on another cloud or on a mesh.
//!
//! ```text
//! anywhere      ──► global ──► a start
//! source points ──► closest point on a Surface ──► point-to-plane step ──► target_from_source
//!                        (cloud or mesh)                (icp)
//! many clouds   ──► pairwise motions ──► pose_graph ──► one motion each, loops closed
//! ```
//! All lengths are metres, all motions are named `a_from_b`.

pub mod global;
pub mod icp;
pub mod mesh_surface;
pub mod normals;
pub mod pose_graph;
pub mod surface;
pub mod thin;
pub(crate) mod tree;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3, Vector6};

/// What registration cannot work with.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RegisterError {
    /// A cloud is too small.
    #[error("{what} has {got} usable points, at least {needed} are needed")]
    TooFewPoints {
        /// Which cloud.
        what: &'static str,
        /// Finite points in it.
        got: usize,
        /// The least number.
        needed: usize,
    },
    /// The clouds do not meet.
    #[error(
        "only {pairs} points of the source are within {max_distance_m} m of the target: the clouds \
         do not overlap there; start from a better pose or allow a larger distance"
    )]
    NoOverlap {
        /// Pairs found.
        pairs: usize,
        /// The largest distance of a pair.
        max_distance_m: f64,
    },
    /// The surfaces can slide on each other.
    #[error(
        "the overlap does not fix the pose: it can slide or turn along {free} of 6 directions (a \
         plane on a plane, a sphere on a sphere); add views with more shape"
    )]
    Degenerate {
        /// Number of directions that are not fixed.
        free: usize,
    },
    /// No motion lays one cloud on the other.
    #[error(
        "no pose lays more than {:.0} % of the source on the target ({:.0} % are needed): the clouds \
         do not overlap, or are not of the same object and scale",
        100.0 * .overlap, 100.0 * .needed
    )]
    NoPose {
        /// The largest overlap found, a share.
        overlap: f64,
        /// The least share that counts.
        needed: f64,
    },
    /// A mesh without area.
    #[error("the mesh has no triangle with area")]
    EmptyMesh,
    /// A pose graph whose parts are not connected.
    #[error("view {view} is not connected to view 0 by any registered pair")]
    Disconnected {
        /// The first such view.
        view: usize,
    },
}

/// The rigid motion of a twist: rotation vector (radians) in rows 0..3, translation (metres) in 3..6.
pub(crate) fn motion_of_twist(twist: &Vector6<f64>) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(twist[0], twist[1], twist[2]));
    Isometry3::from_parts(Translation3::new(twist[3], twist[4], twist[5]), rotation)
}

/// The inverse of [`motion_of_twist`].
pub(crate) fn twist_of_motion(motion: &Isometry3<f64>) -> Vector6<f64> {
    let (r, t) = (motion.rotation.scaled_axis(), motion.translation.vector);
    Vector6::new(r.x, r.y, r.z, t.x, t.y, t.z)
}
