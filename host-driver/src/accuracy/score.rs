//! A depth frame against the truth.

use nalgebra::Point3;
use serde::Serialize;
use stspp_hil_sim::world::World;
use stspp_matcher::Image;

use super::CanvasTruth;
use crate::DepthFrame;
use crate::measure::{FitError, plane, rms, sphere};

/// Depth errors beyond this are outliers.
pub const OUTLIER_M: f32 = 5e-3;

/// How a depth frame compares with the truth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Score {
    /// Valid points.
    pub points: usize,
    /// Pixels whose surface both cameras see.
    pub visible: usize,
    /// Part of those that are reconstructed within 5 mm in depth.
    pub completeness: f64,
    /// Part of the valid points that are off by more than 5 mm in depth, or where nothing is.
    pub outliers: f64,
    /// The same among the points that both cameras see.
    pub outliers_visible: f64,
    /// RMS of the error along the ray over points within 5 mm, in millimetres.
    pub surface_rms_mm: f64,
    /// RMS of the same points' distance from the true surface, along its normal, in millimetres: what a
    /// comparison of the cloud with the surface gives. Where a surface is seen at a grazing angle it is a
    /// fraction of the error along the ray.
    pub normal_rms_mm: f64,
    /// Median of that error's magnitude, in millimetres.
    pub surface_median_mm: f64,
}

/// Compares a frame with the truth.
pub fn score(frame: &DepthFrame, truth: &CanvasTruth) -> Score {
    let (mut points, mut visible, mut good, mut wrong, mut wrong_visible) = (0, 0, 0, 0, 0);
    let (mut errors_mm, mut normal_mm) = (Vec::new(), Vec::new());
    for y in 0..frame.depth_m.height() {
        let pixels = frame.depth_m.row(y).iter().zip(truth.depth_m.row(y));
        for (x, ((z, true_z), both)) in pixels.zip(truth.visible_to_both.row(y)).enumerate() {
            let both = *both != 0;
            visible += usize::from(both);
            if !z.is_finite() {
                continue;
            }
            points += 1;
            if (z - true_z).abs() <= OUTLIER_M {
                good += usize::from(both);
                errors_mm.push(truth.error_along_ray_m(x, y, *z) * 1e3);
                normal_mm.push(truth.error_normal_m(x, y, *z) * 1e3);
            } else {
                wrong += 1;
                wrong_visible += usize::from(both);
            }
        }
    }
    let part = |n: usize, of: usize| n as f64 / of.max(1) as f64;
    let surface_rms_mm = rms(errors_mm.iter().copied());
    let middle = errors_mm.len() / 2;
    let surface_median_mm = if errors_mm.is_empty() {
        f64::NAN
    } else {
        let (_, median, _) =
            errors_mm.select_nth_unstable_by(middle, |a, b| a.abs().total_cmp(&b.abs()));
        median.abs()
    };
    Score {
        points,
        visible,
        completeness: part(good, visible),
        outliers: part(wrong, points),
        outliers_visible: part(wrong_visible, points),
        surface_rms_mm,
        normal_rms_mm: rms(normal_mm),
        surface_median_mm,
    }
}

/// Valid points of an object within 5 mm of the truth, whose surroundings of `margin` pixels belong
/// to the object and are seen by both cameras too (no depth step disturbs them), and that neither camera
/// sees at a more grazing angle than `incidence_max_deg`.
pub fn object_points(
    frame: &DepthFrame,
    truth: &CanvasTruth,
    world: &World,
    object: &str,
    margin: usize,
    incidence_max_deg: f32,
) -> Vec<Point3<f64>> {
    let (width, height) = (truth.object.width(), truth.object.height());
    let of_object = |index: u8| index != 0 && world.object_name(usize::from(index) - 1) == object;
    let mut inside = Image::new(width, height, false);
    for y in 0..height {
        for x in 0..width {
            let both = truth.visible_to_both.get(x, y) != Some(0);
            inside.set(x, y, both && truth.object.get(x, y).is_some_and(of_object));
        }
    }
    let inside = eroded(&inside, margin);
    let mut points = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let (z, true_z) = (frame.depth_m.row(y)[x], truth.depth_m.row(y)[x]);
            let steep = truth.incidence_deg.row(y)[x] > incidence_max_deg;
            if inside.row(y)[x] && !steep && (z - true_z).abs() <= OUTLIER_M {
                let d = f64::from(frame.disparity_px.row(y)[x]);
                points.extend(frame.geometry.point_left_m(x as f64, y as f64, d));
            }
        }
    }
    points
}

/// Pixels whose square of `margin` around them is all set.
fn eroded(image: &Image<bool>, margin: usize) -> Image<bool> {
    let (width, height) = (image.width(), image.height());
    // Lengths of the runs that end at each pixel, first along rows, then along columns of those.
    let side = 2 * margin + 1;
    let mut rows = Image::new(width, height, false);
    for y in 0..height {
        let mut run = 0;
        for x in 0..width {
            run = if image.row(y)[x] { run + 1 } else { 0 };
            if run >= side {
                rows.set(x - margin, y, true);
            }
        }
    }
    let mut out = Image::new(width, height, false);
    for x in 0..width {
        let mut run = 0;
        for y in 0..height {
            run = if rows.row(y)[x] { run + 1 } else { 0 };
            if run >= side {
                out.set(x, y - margin, true);
            }
        }
    }
    out
}

/// RMS of a plane fit over the central half (by area) of the valid canvas, and the mean error along
/// the ray there, in millimetres.
///
/// # Errors
/// When too few points are valid.
pub fn central_plane_mm(frame: &DepthFrame, truth: &CanvasTruth) -> Result<(f64, f64), FitError> {
    // The box of what both cameras see; its middle, with the area halved.
    let (mut x0, mut x1, mut y0, mut y1) = (usize::MAX, 0, usize::MAX, 0);
    for y in 0..truth.visible_to_both.height() {
        for (x, both) in truth.visible_to_both.row(y).iter().enumerate() {
            if *both != 0 {
                (x0, x1, y0, y1) = (x0.min(x), x1.max(x), y0.min(y), y1.max(y));
            }
        }
    }
    let half = |a: usize, b: usize| {
        let margin = (b.saturating_sub(a) as f64 * (0.5 - 0.5_f64.sqrt() / 2.0)) as usize;
        (a.saturating_add(margin), b.saturating_sub(margin))
    };
    let ((x0, x1), (y0, y1)) = (half(x0, x1), half(y0, y1));
    let mut points = Vec::new();
    let (mut sum_m, mut count) = (0.0, 0_u32);
    for y in y0..=y1.min(frame.depth_m.height().saturating_sub(1)) {
        for x in x0..=x1 {
            let error = truth.error_along_ray_m(x, y, frame.depth_m.row(y)[x]);
            if error.abs() <= f64::from(OUTLIER_M) {
                (sum_m, count) = (sum_m + error, count + 1);
            }
            let d = frame.disparity_px.row(y)[x];
            points.extend(frame.geometry.point_left_m(x as f64, y as f64, f64::from(d)));
        }
    }
    let bias_mm = sum_m / f64::from(count.max(1)) * 1e3;
    plane::fit(&points).map(|fit| (fit.rms_m * 1e3, bias_mm))
}

/// Sphere fit over the points of the object "sphere": RMS and radius error in millimetres.
///
/// # Errors
/// When too few points are valid.
pub fn sphere_rms_mm(
    frame: &DepthFrame,
    truth: &CanvasTruth,
    world: &World,
    radius_m: f64,
    margin: usize,
    incidence_max_deg: f32,
) -> Result<(f64, f64), FitError> {
    let points = object_points(frame, truth, world, "sphere", margin, incidence_max_deg);
    let fit = sphere::fit(&points)?;
    Ok((fit.rms_m * 1e3, (fit.radius_m - radius_m) * 1e3))
}
