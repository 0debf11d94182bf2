//! How far a cloud is from a reference: signed distances, their statistics and pictures.

use nalgebra::{Isometry3, Point3};
use rayon::prelude::*;
use serde::Serialize;
use stspp_matcher::Image;

use super::robust::is_finite;
use crate::export::colour;
use crate::register::surface::Surface;

/// Signed distances of a cloud's points from a reference surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Deviations {
    /// Metres, as many as points; positive on the sensor's side of the reference, NaN where the
    /// reference is farther away than was asked for.
    pub signed_m: Vec<f64>,
}

/// Statistics of [`Deviations`], in millimetres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DeviationSummary {
    /// Finite points of the cloud.
    pub points: usize,
    /// Part of them within the largest distance of the reference: only these count below.
    pub matched: f64,
    /// Mean of the signed distances.
    pub mean_mm: f64,
    /// RMS of the distances.
    pub rms_mm: f64,
    /// Median magnitude.
    pub median_mm: f64,
    /// 95th percentile of the magnitude.
    pub p95_mm: f64,
    /// Largest magnitude.
    pub max_mm: f64,
}

/// Distances of `points_m` from `reference`, at most `max_distance_m`. The points are in the left
/// camera's frame, `reference_from_left` lays them on the reference.
pub fn deviations(
    points_m: &[Point3<f64>],
    reference: &dyn Surface,
    reference_from_left: &Isometry3<f64>,
    max_distance_m: f64,
) -> Deviations {
    let sensor = reference_from_left * Point3::origin();
    let signed_m = points_m
        .par_iter()
        .map(|p| {
            if !is_finite(p) {
                return f64::NAN;
            }
            let moved = reference_from_left * p;
            let Some(closest) = reference.closest(&moved, max_distance_m) else { return f64::NAN };
            let normal = closest.normal;
            // Normals of meshes and clouds may point either way: the sensor's side is the outside.
            let outward = if normal.dot(&(sensor - closest.point_m)) < 0.0 { -1.0 } else { 1.0 };
            let along = (moved - closest.point_m).dot(&normal) * outward;
            if reference.is_sampled() { along } else { closest.distance_m.copysign(along) }
        })
        .collect();
    Deviations { signed_m }
}

impl Deviations {
    /// Their statistics; `None` when no point is near the reference.
    pub fn summary(&self, points_m: &[Point3<f64>]) -> Option<DeviationSummary> {
        let points = points_m.iter().filter(|p| is_finite(p)).count();
        let mut magnitudes: Vec<f64> =
            self.signed_m.iter().filter(|d| !d.is_nan()).map(|d| d.abs()).collect();
        if magnitudes.is_empty() {
            return None;
        }
        magnitudes.sort_unstable_by(f64::total_cmp);
        let n = magnitudes.len();
        let signed = self.signed_m.iter().filter(|d| !d.is_nan());
        Some(DeviationSummary {
            points,
            matched: n as f64 / points.max(1) as f64,
            mean_mm: signed.sum::<f64>() / n as f64 * 1e3,
            rms_mm: super::rms(magnitudes.iter().copied()) * 1e3,
            median_mm: magnitudes[n / 2] * 1e3,
            p95_mm: magnitudes[(n - 1) * 95 / 100] * 1e3,
            max_mm: magnitudes[n - 1] * 1e3,
        })
    }

    /// Colours of the points: blue is behind the reference, red before it, full at `full_mm`; dark is
    /// far from it.
    pub fn colours(&self, full_mm: f64) -> Vec<[u8; 3]> {
        self.signed_m
            .iter()
            .map(
                |d| {
                    if d.is_nan() { colour::INVALID } else { colour::diverging(d * 1e3 / full_mm) }
                },
            )
            .collect()
    }
}

/// Columns of a picture of a cloud.
const PICTURE_PX: usize = 1000;

/// A picture of coloured points as the left camera's centre sees them, the nearer before the farther.
pub fn picture(points_m: &[Point3<f64>], colours: &[[u8; 3]]) -> Image<[u8; 3]> {
    let seen = |p: &Point3<f64>| (p.z > 1e-6 && is_finite(p)).then(|| (p.x / p.z, p.y / p.z));
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let mut count = 0_usize;
    for (u, v) in points_m.iter().filter_map(seen) {
        (low, high) = ([low[0].min(u), low[1].min(v)], [high[0].max(u), high[1].max(v)]);
        count += 1;
    }
    if count == 0 {
        return Image::new(1, 1, colour::INVALID);
    }
    let sides = [0, 1].map(|k| (high[k] - low[k]).max(1e-6));
    // As many pixels as points would fill if they covered the box, so that no gaps show.
    let fitting = (count as f64 * sides[0] / sides[1]).sqrt() * 0.8;
    let columns = (fitting as usize).clamp(64, PICTURE_PX);
    let scale = (columns - 1) as f64 / sides[0];
    let rows = ((sides[1] * scale) as usize + 1).clamp(1, 4 * PICTURE_PX);
    let mut picture = Image::new(columns, rows, colour::INVALID);
    let mut nearest = Image::new(columns, rows, f64::INFINITY);
    for (p, colour) in points_m.iter().zip(colours) {
        let Some((u, v)) = seen(p) else { continue };
        let (x, y) = (((u - low[0]) * scale) as usize, ((v - low[1]) * scale) as usize);
        if nearest.get(x, y).is_some_and(|z| p.z < z) {
            nearest.set(x, y, p.z);
            picture.set(x, y, *colour);
        }
    }
    picture
}
