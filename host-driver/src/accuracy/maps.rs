//! Error maps as pictures.

use std::io::{self, Write};

use stspp_matcher::Image;

use super::CanvasTruth;
use super::score::OUTLIER_M;
use crate::export::colour;
use crate::{DepthFrame, image_io};

/// Seen by both cameras but not reconstructed.
const MISSING: [u8; 3] = [255, 0, 255];
/// Off by more than 5 mm.
const OUTLIER: [u8; 3] = [255, 255, 0];
/// Not seen by both cameras.
const UNSEEN: [u8; 3] = [24, 24, 28];

/// Writes the depth error as a picture: blue is too near, red too far, white exact, full colour at
/// `full_mm`; magenta is missing, yellow off by more than 5 mm.
///
/// # Errors
/// From `out`.
pub fn write_error_png(
    out: &mut dyn Write,
    frame: &DepthFrame,
    truth: &CanvasTruth,
    full_mm: f32,
) -> io::Result<()> {
    let (width, height) = (frame.depth_m.width(), frame.depth_m.height());
    let mut picture = Image::new(width, height, UNSEEN);
    for y in 0..height {
        let rows = frame.depth_m.row(y).iter().zip(truth.depth_m.row(y));
        for (x, (z, true_z)) in rows.enumerate() {
            let error = z - true_z;
            let colour = if z.is_nan() {
                if truth.visible_to_both.row(y)[x] == 0 {
                    continue;
                }
                MISSING
            } else if error.abs() <= OUTLIER_M {
                colour::diverging(f64::from(error * 1e3 / full_mm))
            } else {
                OUTLIER
            };
            picture.set(x, y, colour);
        }
    }
    let legend = format!("Depth error: blue -{full_mm} mm, white 0, red +{full_mm} mm");
    image_io::write_rgb8(out, &picture, &[("Description", &legend)])
}
