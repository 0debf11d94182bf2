//! What a user can set: a few stable parameters, the rest under [`Advanced`].

use crate::{
    Error, Level, dense::RADIUS_LIMIT as DENSE_RADIUS_LIMIT, icgn::prepare::SUBSET_RADIUS_LIMIT,
};

/// Largest magnitude of a disparity, in pixels.
pub const DISPARITY_LIMIT_PX: i32 = 16_384;

/// Largest radius of a window, in pixels.
pub const RADIUS_LIMIT: usize = 8;

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
    Second,
    /// The order per pixel that fits: first where flat, second where curved.
    #[default]
    Auto,
}

/// How the sub-pixel disparity is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Method {
    /// Parabola through the census costs (paper eq 6); no refinement.
    Parabola,
    /// Per-point inverse-compositional Gauss-Newton, as the paper does (eq 7-19).
    IcGn,
    /// Dense least squares with shared warps: the same estimate in real time.
    #[default]
    Dense,
}

/// How grey values between the right images' pixels are found by IC-GN.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Interpolation {
    /// Cubic B-spline with prefilter: four taps.
    Cubic,
    /// Quintic B-spline with prefilter: six taps, about a fifth less noise than the cubic one.
    #[default]
    Quintic,
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
    /// Whether the disparity's rate is estimated, so that a moving surface measures as well as one at
    /// rest and its depth is the newest frame's. By [`Method::Dense`] from three frames on; the other
    /// methods give a mean over the frames.
    pub motion: bool,
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
    /// Subset radius of the refinement (paper: 4, a 9x9 window): 2 to 8, for IC-GN at most 7.
    pub subset_radius: usize,
    /// IC-GN ends when the 2-norm of the increment is at most this (paper: 0.001).
    pub convergence_px: f64,
    /// Most IC-GN iterations of a point.
    pub iterations_max: usize,
    /// Largest disagreement of left-right and right-left disparities.
    pub left_right_px: f32,
    /// How much worse, as a part of all census bits, the best candidate more than two pixels away
    /// must be than the winner.
    pub uniqueness: f32,
    /// Connected regions of fewer pixels are removed.
    pub region_min: usize,
    /// A window pixel belongs to the centre's surface when its coarse disparity is at most this far
    /// from the local fit.
    pub surface_px: f32,
    /// Whether [`Method::Dense`] lets the pixels' own grey values decide at depth steps, as
    /// [`Method::IcGn`] always does; from two frames on. On the simulated part 0.03 % of the points are
    /// then wrong instead of 2.7 %, and 0.9 % fewer are found; with three frames 0.26 instead of 3.5 %,
    /// and 1.1 % fewer.
    pub settle_steps: bool,
    /// Interpolation of the right images in IC-GN.
    pub interpolation: Interpolation,
    /// Highest SIMD level to use; the machine's best when `None`.
    pub level_max: Option<Level>,
    /// Threads of the matcher's own pool; rayon's process-wide pool when `None`.
    pub threads: Option<usize>,
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
            uniqueness: 0.02,
            region_min: 60,
            surface_px: 1.5,
            settle_steps: true,
            interpolation: Interpolation::default(),
            level_max: None,
            threads: None,
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
            motion: true,
            advanced: Advanced::default(),
        }
    }

    /// Checks every field.
    ///
    /// # Errors
    /// [`Error::Parameter`] names the first field outside its range.
    pub fn check(&self) -> Result<(), Error> {
        fn within<T: PartialOrd + std::fmt::Display>(
            name: &'static str,
            value: T,
            min: T,
            max: T,
        ) -> Result<(), Error> {
            if value >= min && value <= max {
                return Ok(());
            }
            let (got, allowed) = (value.to_string(), format!("{min} to {max}"));
            Err(Error::Parameter { name, got, allowed })
        }
        let DisparityRange { min_px, max_px } = self.disparity;
        within("disparity.min_px", min_px, -DISPARITY_LIMIT_PX, DISPARITY_LIMIT_PX)?;
        within("disparity.max_px", max_px, min_px, DISPARITY_LIMIT_PX)?;
        within("zncc_min", self.zncc_min, -1.0, 1.0)?;
        let a = &self.advanced;
        within("advanced.census_radius", a.census_radius, 1, RADIUS_LIMIT)?;
        within("advanced.retry_radius", a.retry_radius, a.census_radius, RADIUS_LIMIT)?;
        within("advanced.retry_similarity", a.retry_similarity, 0.0, 1.0)?;
        let subset_radius_max = match self.method {
            Method::IcGn => SUBSET_RADIUS_LIMIT,
            Method::Dense | Method::Parabola => DENSE_RADIUS_LIMIT,
        };
        within("advanced.subset_radius", a.subset_radius, 2, subset_radius_max)?;
        within("advanced.convergence_px", a.convergence_px, 1e-9, 1.0)?;
        within("advanced.iterations_max", a.iterations_max, 1, 1000)?;
        within("advanced.left_right_px", a.left_right_px, 0.0, 1e6)?;
        within("advanced.uniqueness", a.uniqueness, 0.0, 1.0)?;
        within("advanced.surface_px", a.surface_px, 0.1, 1e6)?;
        Ok(())
    }
}
