//! What users of depth cameras ask of a flat target: how much is filled, how exact and how quiet.
//!
//! All figures are over the pixels of a region. "Sub-pixel RMS" is the noise of the disparity, the
//! figure by which stereo sensors of any baseline and lens can be compared.

use nalgebra::{Matrix3, Point3, Vector3};
use serde::Serialize;

use super::plane::{self, PlaneFit};
use super::region::Region;
use super::robust::{self, Trim};
use super::{FitError, rms};
use crate::DepthFrame;

/// A depth frame of a flat target.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FlatTarget {
    /// Pixels of the region.
    pub pixels: usize,
    /// Part of them with a depth.
    pub fill_rate: f64,
    /// Depth of the fitted plane in the region's middle, metres.
    pub distance_m: f64,
    /// RMS of the distances from the fitted plane, all valid pixels, millimetres.
    pub plane_rms_mm: f64,
    /// The same relative to the distance, in per cent.
    pub plane_rms_percent: f64,
    /// RMS of the disparities about their own plane, pixels: a plane in space is one in disparity.
    pub subpixel_rms_px: f64,
    /// Points beyond four standard deviations, a share of the valid ones.
    pub outliers: f64,
    /// Signed median of depth minus true depth, millimetres; needs the true plane.
    pub z_accuracy_mm: Option<f64>,
    /// The same in per cent of the distance.
    pub z_accuracy_percent: Option<f64>,
}

/// Measures a flat target. `truth` is where it really stands, by a point and a normal, where known.
///
/// # Errors
/// Too few valid points.
pub fn flat_target(
    frame: &DepthFrame,
    region: &Region,
    truth: Option<(Point3<f64>, Vector3<f64>)>,
) -> Result<FlatTarget, FitError> {
    let [columns, rows] = region.pixels(frame);
    let pixels = columns.len() * rows.len();
    let samples: Vec<(usize, usize, Point3<f64>)> = region.samples(frame).collect();
    let points: Vec<Point3<f64>> = samples.iter().map(|s| s.2).collect();
    let trimmed = robust::fit::<PlaneFit>(&points, &Trim::default())?;
    let fit = trimmed.shape;
    let plane_rms_m = rms(points.iter().map(|p| fit.distance_m(p)));
    let disparities: Vec<Point3<f64>> = samples
        .iter()
        .map(|(x, y, _)| {
            Point3::new(*x as f64, *y as f64, f64::from(frame.disparity_px.row(*y)[*x]))
        })
        .collect();
    let distance_m = fit.point_m.z;
    let z_accuracy_m = truth.map(|(on_plane_m, normal)| {
        let mut errors: Vec<f64> = points
            .iter()
            .map(|p| {
                // Along z, to where the true plane is.
                (p - on_plane_m).dot(&normal) / normal.z
            })
            .filter(|e| e.is_finite())
            .collect();
        median(&mut errors)
    });
    Ok(FlatTarget {
        pixels,
        fill_rate: points.len() as f64 / pixels.max(1) as f64,
        distance_m,
        plane_rms_mm: plane_rms_m * 1e3,
        plane_rms_percent: 100.0 * plane_rms_m / distance_m,
        subpixel_rms_px: graph_rms(&disparities).unwrap_or(f64::NAN),
        outliers: trimmed.rejected(),
        z_accuracy_mm: z_accuracy_m.map(|e| e * 1e3),
        z_accuracy_percent: z_accuracy_m.map(|e| 100.0 * e / distance_m),
    })
}

/// RMS of z about the plane z = a + b x + c y.
fn graph_rms(points: &[Point3<f64>]) -> Option<f64> {
    let n = points.len() as f64;
    let mean = points.iter().fold(Vector3::zeros(), |s, p| s + p.coords) / n;
    let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
    for p in points {
        let d = p.coords - mean;
        let row = Vector3::new(d.x, d.y, 1.0);
        a += row * row.transpose();
        b += row * d.z;
    }
    let s = a.cholesky()?.solve(&b);
    Some(rms(points.iter().map(|p| {
        let d = p.coords - mean;
        d.z - s.x * d.x - s.y * d.y - s.z
    })))
}

/// Noise over a sequence of frames of a still scene.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TemporalNoise {
    /// Frames.
    pub frames: usize,
    /// Pixels of the region that are valid in every frame.
    pub pixels: usize,
    /// Median over these of the standard deviation of depth, millimetres.
    pub median_std_mm: f64,
    /// 95th percentile of the same.
    pub p95_std_mm: f64,
    /// Median standard deviation of the disparity, pixels.
    pub median_std_px: f64,
    /// Pixels that are valid in some frames but not in all, a share of those valid in any.
    pub flicker: f64,
}

/// Collects frames one by one, so that a sequence need not be held.
#[derive(Debug, Clone, Default)]
pub struct Temporal {
    frames: usize,
    size: [usize; 2],
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
    /// Count, mean and sum of squares of depth, then mean and squares of disparity, by pixel.
    sums: Vec<[f64; 5]>,
}

impl Temporal {
    /// Adds a frame; all frames have the same canvas.
    pub fn add(&mut self, frame: &DepthFrame, region: &Region) {
        let size = [frame.depth_m.width(), frame.depth_m.height()];
        if self.frames == 0 || self.size != size {
            let [columns, rows] = region.pixels(frame);
            let sums = vec![[0.0; 5]; columns.len() * rows.len()];
            *self = Self { frames: 0, size, columns, rows, sums };
        }
        self.frames += 1;
        let mut sums = self.sums.iter_mut();
        for y in self.rows.clone() {
            for x in self.columns.clone() {
                let Some(sum) = sums.next() else { return };
                let z = f64::from(frame.depth_m.row(y)[x]);
                let d = f64::from(frame.disparity_px.row(y)[x]);
                if z.is_finite() && d.is_finite() {
                    // Welford's running mean and squares: no cancellation.
                    sum[0] += 1.0;
                    let dz = z - sum[1];
                    sum[1] += dz / sum[0];
                    sum[2] += dz * (z - sum[1]);
                    let dd = d - sum[3];
                    sum[3] += dd / sum[0];
                    sum[4] += dd * (d - sum[3]);
                }
            }
        }
    }

    /// The noise so far; `None` with fewer than two frames or no pixel that is valid in all.
    pub fn noise(&self) -> Option<TemporalNoise> {
        let full = self.frames as f64;
        let in_all: Vec<&[f64; 5]> = self.sums.iter().filter(|s| s[0] == full).collect();
        if self.frames < 2 || in_all.is_empty() {
            return None;
        }
        let any = self.sums.iter().filter(|s| s[0] > 0.0).count();
        let std = |k: usize| -> Vec<f64> {
            in_all.iter().map(|s| (s[k] / (full - 1.0)).sqrt()).collect()
        };
        let mut depth = std(2);
        let rank = (depth.len() - 1) * 95 / 100;
        let p95 = *depth.select_nth_unstable_by(rank, f64::total_cmp).1;
        Some(TemporalNoise {
            frames: self.frames,
            pixels: in_all.len(),
            median_std_mm: median(&mut depth) * 1e3,
            p95_std_mm: p95 * 1e3,
            median_std_px: median(&mut std(4)),
            flicker: (any - in_all.len()) as f64 / any.max(1) as f64,
        })
    }
}

fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The plane of a truth given as the distance of a target that faces the rectified cameras.
pub fn facing_plane(frame: &DepthFrame, distance_m: f64) -> (Point3<f64>, Vector3<f64>) {
    let normal = frame.geometry.rect_from_left.inverse() * -Vector3::z();
    (Point3::from(-normal * distance_m), normal)
}

/// The plane fit of all valid pixels of a region, outliers included.
///
/// # Errors
/// Too few valid points.
pub fn plane_of(frame: &DepthFrame, region: &Region) -> Result<PlaneFit, FitError> {
    let points: Vec<_> = region.samples(frame).map(|s| s.2).collect();
    plane::fit(&points)
}
