//! Measurements on point clouds: shapes fitted by least squares.

pub mod plane;
pub mod sphere;

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
