//! Measurements on point clouds and depth frames.
//!
//! ```text
//! points ─► region ─► robust (plane, sphere, circle, cylinder) ─► form, size, spacing
//!        └► find (spheres anywhere)                           └► deviation from a mesh or cloud
//! depth frames ─► camera (fill rate, Z accuracy, sub-pixel RMS, temporal noise)
//! ```
//! Form and size errors are named after VDI/VDE 2634 part 2 and computed as it describes them; they
//! are no certificate, which takes calibrated artefacts and the standard's whole procedure.

pub mod camera;
pub mod circle;
pub mod cylinder;
pub mod deviation;
pub mod find;
pub mod form;
pub mod mesh_file;
pub mod plane;
pub mod region;
pub mod robust;
pub mod sphere;
pub mod units;

/// Why a shape could not be fitted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FitError {
    /// Too few points.
    #[error("{shape} fit: expected at least {needed} finite points, got {got}")]
    TooFewPoints {
        /// The shape.
        shape: &'static str,
        /// Points needed.
        needed: usize,
        /// Finite points given.
        got: usize,
    },
    /// There is no such shape, or there are fewer than wanted.
    #[error(
        "found {found} of {wanted} {shape}s: none (other) stands out of the points; give its radius, \
         or a region around it"
    )]
    NotFound {
        /// The shape.
        shape: &'static str,
        /// Shapes found.
        found: usize,
        /// Shapes wanted.
        wanted: usize,
    },
    /// The points do not determine the shape.
    #[error("{shape} fit: {reason}; choose a larger or another region")]
    Degenerate {
        /// The shape.
        shape: &'static str,
        /// What is wrong with the points.
        reason: &'static str,
    },
}

/// Root mean square; 0 of nothing.
pub fn rms(values: impl IntoIterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0_usize);
    for value in values {
        sum += value * value;
        count += 1;
    }
    if count == 0 { 0.0 } else { (sum / count as f64).sqrt() }
}
