//! Fits that outliers do not disturb: a start by least quantile of squares (Rousseeuw 1984), then
//! least squares over the points within a few standard deviations, until the choice settles.

use nalgebra::Point3;
use rayon::prelude::*;

use super::{FitError, rms};

/// A shape that points can be fitted with.
pub trait Shape: Copy + Send + Sync {
    /// Its name, for errors.
    const NAME: &'static str;
    /// Points that the start is computed from.
    const SAMPLE: usize;

    /// The least-squares shape of all points.
    ///
    /// # Errors
    /// Too few points, or points that do not determine the shape.
    fn fit(points_m: &[Point3<f64>]) -> Result<Self, FitError>;

    /// Improves on a shape that is nearly right; by default from nothing.
    ///
    /// # Errors
    /// As [`Shape::fit`].
    fn refit(self, points_m: &[Point3<f64>]) -> Result<Self, FitError> {
        Self::fit(points_m)
    }

    /// A shape through [`Shape::SAMPLE`] points, or `None` when they determine none.
    fn through(sample_m: &[Point3<f64>]) -> Option<Self> {
        Self::fit(sample_m).ok()
    }

    /// Signed distance of a point from the surface, metres.
    fn distance_m(&self, point_m: &Point3<f64>) -> f64;
}

/// How outliers are told from points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trim {
    /// Largest share of outliers that is coped with, 0 to 0.8. With 0 all points are used.
    pub outliers_max: f64,
    /// Points beyond so many standard deviations are outliers.
    pub sigmas: f64,
    /// Points this close are never outliers, metres: below it, distances are rounding.
    pub floor_m: f64,
}

impl Default for Trim {
    fn default() -> Self {
        Self { outliers_max: 0.4, sigmas: 4.0, floor_m: 1e-8 }
    }
}

/// A shape and the points that belong to it.
#[derive(Debug, Clone, PartialEq)]
pub struct Trimmed<S> {
    /// The least-squares shape of the points used.
    pub shape: S,
    /// Whether each of the points given was used; not-finite ones are not.
    pub used: Vec<bool>,
    /// RMS of the used points' distances, metres.
    pub rms_m: f64,
    /// Finite points given.
    pub finite: usize,
}

impl<S> Trimmed<S> {
    /// Number of points used.
    pub fn points(&self) -> usize {
        self.used.iter().filter(|used| **used).count()
    }

    /// Finite points that were not used, as a share.
    pub fn rejected(&self) -> f64 {
        1.0 - self.points() as f64 / self.finite.max(1) as f64
    }
}

/// Candidates tried: with 40 % outliers and 5 points a sample, one in 13 is free of them.
const CANDIDATES: usize = 160;
/// Points that candidates are judged by.
const JUDGES: usize = 1500;
/// Rounds of trimming and fitting again, at most.
const ROUNDS: usize = 25;

/// Fits a shape to the points that agree on one.
///
/// # Errors
/// As [`Shape::fit`].
pub fn fit<S: Shape>(points_m: &[Point3<f64>], trim: &Trim) -> Result<Trimmed<S>, FitError> {
    let finite: Vec<Point3<f64>> = points_m.iter().copied().filter(is_finite).collect();
    if finite.len() < S::SAMPLE {
        return Err(FitError::TooFewPoints {
            shape: S::NAME,
            needed: S::SAMPLE,
            got: finite.len(),
        });
    }
    let mut shape = if trim.outliers_max > 0.0 {
        start(&finite, trim.outliers_max.min(0.8))?
    } else {
        S::fit(&finite)?
    };
    let mut limit_m = f64::INFINITY;
    if trim.outliers_max > 0.0 {
        let keep = 1.0 - trim.outliers_max.min(0.8);
        let mut before = 0;
        for _ in 0..ROUNDS {
            limit_m = (trim.sigmas * sigma_m(&shape, &finite, keep)).max(trim.floor_m);
            let near: Vec<_> =
                finite.iter().copied().filter(|p| shape.distance_m(p).abs() <= limit_m).collect();
            shape = shape.refit(&near)?;
            if near.len() == before {
                break;
            }
            before = near.len();
        }
    }
    let used: Vec<bool> =
        points_m.iter().map(|p| is_finite(p) && shape.distance_m(p).abs() <= limit_m).collect();
    let rms_m = rms(points_m
        .iter()
        .zip(&used)
        .filter(|(_, used)| **used)
        .map(|(p, _)| shape.distance_m(p)));
    Ok(Trimmed { shape, used, rms_m, finite: finite.len() })
}

/// The candidate through few points whose distances are smallest at the quantile that is kept.
fn start<S: Shape>(points_m: &[Point3<f64>], outliers_max: f64) -> Result<S, FitError> {
    let stride = points_m.len().div_ceil(JUDGES);
    let judges: Vec<_> = points_m.iter().step_by(stride).collect();
    let rank = ((judges.len() as f64 * (1.0 - outliers_max)) as usize).min(judges.len() - 1);
    (0..CANDIDATES as u64)
        .into_par_iter()
        .filter_map(|candidate| {
            let mut draw = Draw(candidate.wrapping_mul(0x9E37_79B9_7F4A_7C15));
            let sample: Vec<_> =
                (0..S::SAMPLE).map(|_| points_m[draw.below(points_m.len())]).collect();
            let shape = S::through(&sample)?;
            let mut distances: Vec<f64> =
                judges.iter().map(|p| shape.distance_m(p).abs()).collect();
            let score = *distances.select_nth_unstable_by(rank, f64::total_cmp).1;
            score.is_finite().then_some((score, shape))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, shape)| shape)
        // Why nothing can be drawn through the points is what a plain fit says of all of them.
        .map_or_else(|| S::fit(points_m), Ok)
}

/// Standard deviation of the distances by the median of those that are surely none of outliers.
fn sigma_m<S: Shape>(shape: &S, points_m: &[Point3<f64>], keep: f64) -> f64 {
    let mut distances: Vec<f64> = points_m.par_iter().map(|p| shape.distance_m(p).abs()).collect();
    let rank = ((distances.len() as f64 * keep) as usize).clamp(1, distances.len() - 1);
    let (sure, _, _) = distances.select_nth_unstable_by(rank, f64::total_cmp);
    let middle = sure.len() / 2;
    let median = *sure.select_nth_unstable_by(middle, f64::total_cmp).1;
    // The median of the lower `keep` share of a normal distribution's magnitudes is between 0.39
    // (keep = 0.6) and 0.67 standard deviations (keep = 1); linear in between to 2 %.
    median / (0.39 + (0.6745 - 0.39) * (keep - 0.6) / 0.4).max(0.12)
}

pub(crate) fn is_finite(point: &Point3<f64>) -> bool {
    point.coords.iter().all(|c| c.is_finite())
}

/// A small generator of draws (SplitMix64): the same points always give the same fit.
pub(crate) struct Draw(pub u64);

impl Draw {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number below `limit`, which is not 0.
    pub fn below(&mut self, limit: usize) -> usize {
        ((u128::from(self.next()) * limit as u128) >> 64) as usize
    }
}
