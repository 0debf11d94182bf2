//! Pictures for the report: small, in colour.

use nalgebra::Point3;
use stspp_matcher::Image;

use super::{ExperimentError, Picture};
use crate::accuracy::{CanvasTruth, maps};
use crate::export::images;
use crate::measure::deviation::{Deviations, picture};
use crate::{DepthFrame, image_io};

/// Every second pixel of each side: reports stay small.
fn halved<T: Copy>(image: &Image<T>) -> Image<T> {
    let (width, height) = (image.width().div_ceil(2), image.height().div_ceil(2));
    let rows = (0..height).flat_map(|y| image.row(2 * y).iter().step_by(2).copied());
    let pixels: Vec<T> = rows.collect();
    Image::from_vec(width, height, pixels).unwrap_or_else(|| image.clone())
}

/// The depth of a frame in colours.
pub fn depth(frame: &DepthFrame, caption: &str) -> Result<Picture, ExperimentError> {
    let range = images::colour_range_m(&frame.depth_m);
    let mut png = Vec::new();
    images::write_depth_colour_png(&mut png, &halved(&frame.depth_m), range)?;
    let caption = format!("{caption}; {:.3} m (red) to {:.3} m (blue)", range.0, range.1);
    Ok(Picture { caption, png })
}

/// The error of a frame's depth.
pub fn error(
    frame: &DepthFrame,
    truth: &CanvasTruth,
    full_mm: f32,
    caption: &str,
) -> Result<Picture, ExperimentError> {
    let mut png = Vec::new();
    let halved_frame = DepthFrame { depth_m: halved(&frame.depth_m), ..frame.clone() };
    let halved_truth = CanvasTruth {
        depth_m: halved(&truth.depth_m),
        visible_to_both: halved(&truth.visible_to_both),
        ..truth.clone()
    };
    maps::write_error_png(&mut png, &halved_frame, &halved_truth, full_mm)?;
    let caption = format!(
        "{caption}; blue {full_mm} mm too near, white exact, red too far; magenta missing, yellow off by \
         more than 5 mm"
    );
    Ok(Picture { caption, png })
}

/// The ZNCC of a frame.
pub fn zncc(frame: &DepthFrame, caption: &str) -> Result<Picture, ExperimentError> {
    let mut png = Vec::new();
    images::write_zncc_png(&mut png, &halved(&frame.zncc))?;
    Ok(Picture { caption: format!("{caption}; white is 1, black 0 or invalid"), png })
}

/// A raw image of the left camera.
pub fn raw(image: &Image<u8>, caption: &str) -> Result<Picture, ExperimentError> {
    let mut png = Vec::new();
    image_io::write_gray8(&mut png, &halved(image), &[])?;
    Ok(Picture { caption: caption.to_owned(), png })
}

/// The deviations of a cloud from its reference.
pub fn deviations(
    points_m: &[Point3<f64>],
    found: &Deviations,
    full_mm: f64,
    caption: &str,
) -> Result<Picture, ExperimentError> {
    let image = picture(points_m, &found.colours(full_mm));
    let image = if image.width() > 700 { halved(&image) } else { image };
    let mut png = Vec::new();
    image_io::write_rgb8(&mut png, &image, &[])?;
    let caption = format!("{caption}; blue {full_mm} mm behind the surface, red before it");
    Ok(Picture { caption, png })
}

/// A cloud from any side, lit from there: `seen_from_cloud` turns it before the eye.
pub fn shaded(
    points_m: &[Point3<f64>],
    normals: &[nalgebra::Vector3<f32>],
    seen_from_cloud: &nalgebra::Isometry3<f64>,
    caption: &str,
) -> Result<Picture, ExperimentError> {
    let (mut points, mut colours) = (Vec::new(), Vec::new());
    for (p, n) in points_m.iter().zip(normals) {
        let (p, n) = (seen_from_cloud * p, seen_from_cloud.rotation * n.cast::<f64>());
        // Backs are not seen.
        let towards = -n.dot(&p.coords.normalize());
        if towards <= 0.0 {
            continue;
        }
        let side = 0.35 * n.dot(&nalgebra::Vector3::new(-0.6, -0.7, -0.4)).max(0.0);
        let grey = (255.0 * (0.10 + 0.55 * towards + side).clamp(0.0, 1.0)) as u8;
        points.push(p);
        colours.push([grey, grey, (f64::from(grey) * 0.96) as u8]);
    }
    let image = picture(&points, &colours);
    let image = if image.width() > 500 { halved(&image) } else { image };
    let mut png = Vec::new();
    image_io::write_rgb8(&mut png, &image, &[])?;
    Ok(Picture { caption: caption.to_owned(), png })
}
