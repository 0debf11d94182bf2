//! Depth, disparity and similarity as image files.

use std::io::{self, Write};

use stspp_matcher::Image;
use tiff::encoder::{TiffEncoder, colortype::Gray32Float};
use tiff::tags::Tag;

use super::colour;
use crate::image_io;

/// Metres per unit of `depth.png`.
pub const DEPTH_PNG_UNIT_M: f32 = 1e-4;

/// Depth as 16-bit PNG in units of 0.1 mm, 0 is invalid. What is beyond 6.5535 m is invalid too.
///
/// # Errors
/// From `out`.
pub fn write_depth_png(out: &mut dyn Write, depth_m: &Image<f32>) -> io::Result<()> {
    let units = depth_m.map(|z| {
        let value = (z / DEPTH_PNG_UNIT_M).round();
        if (1.0..=65_535.0).contains(&value) { value as u16 } else { 0 }
    });
    let texts = [
        ("Unit", "0.1 mm per grey level, 0 is invalid"),
        ("Title", "Depth: z in the left camera's (cam0) frame"),
    ];
    image_io::write_gray16(out, &units, &texts)
}

/// Depth as colours between two depths; invalid pixels are almost black.
///
/// # Errors
/// From `out`.
pub fn write_depth_colour_png(
    out: &mut dyn Write,
    depth_m: &Image<f32>,
    range_m: (f32, f32),
) -> io::Result<()> {
    let table = colour::table();
    let (near, far) = range_m;
    let scale = 255.0 / (far - near).max(1e-6);
    let rgb = depth_m.map(|z| {
        if z.is_finite() {
            // Near is warm, as in most depth pictures.
            table[((far - z) * scale).round().clamp(0.0, 255.0) as usize]
        } else {
            colour::INVALID
        }
    });
    let legend = format!("Colour from {near:.4} m (red) to {far:.4} m (blue); dark is invalid");
    image_io::write_rgb8(out, &rgb, &[("Description", &legend)])
}

/// ZNCC as 8-bit PNG: 255 is 1, 0 is 0 or invalid.
///
/// # Errors
/// From `out`.
pub fn write_zncc_png(out: &mut dyn Write, zncc: &Image<f32>) -> io::Result<()> {
    // A cast from f32 saturates and takes NaN to 0.
    let grey = zncc.map(|v| (v * 255.0).round() as u8);
    image_io::write_gray8(out, &grey, &[("Unit", "255 is a ZNCC of 1, 0 is 0 or invalid")])
}

/// Disparity as 32-bit float TIFF, NaN is invalid.
///
/// # Errors
/// From `out`.
pub fn write_disparity_tiff(out: &mut dyn Write, disparity_px: &Image<f32>) -> io::Result<()> {
    let text = "Disparity x_left - x_right in px of the rectified canvas, NaN is invalid";
    write_float_tiff(out, disparity_px, text)
}

/// Speed along depth as 32-bit float TIFF in metres per second, NaN is invalid.
///
/// # Errors
/// From `out`.
pub fn write_depth_rate_tiff(out: &mut dyn Write, rate_m_per_s: &Image<f32>) -> io::Result<()> {
    let text =
        "Speed along +z of the left camera in m/s (positive: away), 0 at rest, NaN is invalid";
    write_float_tiff(out, rate_m_per_s, text)
}

fn write_float_tiff(out: &mut dyn Write, map: &Image<f32>, text: &str) -> io::Result<()> {
    let size = |side: usize| u32::try_from(side).map_err(io::Error::other);
    let (width, height) = (size(map.width())?, size(map.height())?);
    let mut file = io::Cursor::new(Vec::with_capacity(map.as_slice().len() * 4 + 4096));
    let written = || -> tiff::TiffResult<()> {
        let mut encoder = TiffEncoder::new(&mut file)?;
        let mut image = encoder.new_image::<Gray32Float>(width, height)?;
        image.encoder().write_tag(Tag::ImageDescription, text)?;
        image.write_data(map.as_slice())
    };
    let mut written = written;
    written().map_err(io::Error::other)?;
    out.write_all(file.get_ref())
}

/// Depths between which a colour picture shows most: the 1st and 99th percentile of the valid ones.
pub fn colour_range_m(depth_m: &Image<f32>) -> (f32, f32) {
    let mut valid: Vec<f32> =
        depth_m.as_slice().iter().step_by(7).copied().filter(|z| z.is_finite()).collect();
    if valid.is_empty() {
        return (0.8, 2.0);
    }
    valid.sort_unstable_by(f32::total_cmp);
    let at = |part: f32| valid[((valid.len() - 1) as f32 * part) as usize];
    let (near, far) = (at(0.01), at(0.99));
    // A flat plane is not blown up to all colours by its noise.
    let widen = (0.01 - (far - near)).max(0.0) / 2.0;
    (near - widen, far + widen)
}
