//! The files that a depth frame is given out as.

use serde_json::Value;

use super::folder::{OutputError, OutputFolder};
use super::{images, ply};
use crate::DepthFrame;

/// Outputs that are not always wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Extras {
    /// The speed along depth, where motion is estimated: `depth_rate.tiff` (f32, metres per second,
    /// positive away from the sensor, NaN invalid), and a property of the cloud's points.
    pub depth_rate: bool,
}

/// Writes `cloud.ply`, `disparity.tiff`, `depth.png`, `depth_color.png`, `zncc.png` and `report.json`,
/// and what `extras` asks for. `progress` is told each file.
///
/// # Errors
/// From the file system.
pub fn write(
    out: &mut OutputFolder,
    frame: &DepthFrame,
    report: &Value,
    extras: Extras,
    progress: &mut dyn FnMut(&'static str),
) -> Result<(), OutputError> {
    progress("cloud.ply");
    let mut cloud = frame.point_cloud();
    if !extras.depth_rate {
        cloud.depth_rate_m_per_s.clear();
    }
    out.file("cloud.ply", |w| ply::write(w, &cloud))?;
    drop(cloud);
    progress("disparity.tiff");
    out.file("disparity.tiff", |w| images::write_disparity_tiff(w, &frame.disparity_px))?;
    progress("depth.png");
    out.file("depth.png", |w| images::write_depth_png(w, &frame.depth_m))?;
    progress("depth_color.png");
    let range_m = images::colour_range_m(&frame.depth_m);
    out.file("depth_color.png", |w| images::write_depth_colour_png(w, &frame.depth_m, range_m))?;
    progress("zncc.png");
    out.file("zncc.png", |w| images::write_zncc_png(w, &frame.zncc))?;
    if let Some(rate) = frame.depth_rate_m_per_s.as_ref().filter(|_| extras.depth_rate) {
        progress("depth_rate.tiff");
        out.file("depth_rate.tiff", |w| images::write_depth_rate_tiff(w, rate))?;
    }
    progress("report.json");
    out.file("report.json", |w| writeln!(w, "{report:#}"))
}
