//! What a user can set: a few stable parameters, the rest under [`Advanced`].

/// Candidate disparities, both ends included, in pixels of the rectified canvas.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DisparityRange {
    /// Smallest disparity x_left - x_right.
    pub min_px: i32,
    /// Largest disparity.
    pub max_px: i32,
}

/// Order of the subset's shape function (paper eq 8).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum ShapeFunction {
    /// u, ux, uy: the least noise, right on surfaces that are flat within a subset.
    First,
    /// Also uxx, uyy, uxy: follows curvature.
    #[default]
    Second,
    /// The order per pixel that fits: first where flat, second where curved.
    Auto,
}

/// How the sub-pixel disparity is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Method {
    /// Parabola through the census costs (paper eq 6); no refinement.
    Parabola,
    /// Per-point inverse-compositional Gauss-Newton, as the paper does (eq 7-19).
    #[default]
    IcGn,
    /// Dense least squares with shared warps: the same estimate in real time.
    Dense,
}

/// Parameters of a match.
#[derive(Debug, Clone, PartialEq)]
pub struct Params {
    /// Candidate disparities.
    pub disparity: DisparityRange,
    /// How the sub-pixel disparity is found.
    pub method: Method,
    /// Order of the shape function.
    pub shape: ShapeFunction,
    /// Points with a lower ZNCC are invalid.
    pub zncc_min: f32,
    /// The rest.
    pub advanced: Advanced,
}

/// Parameters that few users need; the defaults are the paper's where it states one.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Advanced {
    /// Census window radius R: (2R+1) x (2R+1) x N samples (paper: 2).
    pub census_radius: usize,
    /// Radius of the second try at points of low similarity.
    pub retry_radius: usize,
    /// Points whose similarity 1 - cost is at most this are tried again (paper: 0.8).
    pub retry_similarity: f32,
    /// Subset radius of the refinement (paper: 4, a 9x9 window).
    pub subset_radius: usize,
    /// IC-GN ends when the 2-norm of the increment is at most this (paper: 0.001).
    pub convergence_px: f64,
    /// Most IC-GN iterations of a point.
    pub iterations_max: usize,
    /// Largest disagreement of left-right and right-left disparities.
    pub left_right_px: f32,
}

impl Default for Advanced {
    fn default() -> Self {
        Self {
            census_radius: 2,
            retry_radius: 4,
            retry_similarity: 0.8,
            subset_radius: 4,
            convergence_px: 1e-3,
            iterations_max: 12,
            left_right_px: 1.5,
        }
    }
}

impl Params {
    /// Defaults for the given candidate disparities.
    pub fn new(disparity: DisparityRange) -> Self {
        Self {
            disparity,
            method: Method::default(),
            shape: ShapeFunction::default(),
            zncc_min: 0.8,
            advanced: Advanced::default(),
        }
    }
}
