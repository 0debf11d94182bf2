//! The files that a depth frame is given out as.

use serde_json::Value;

use super::folder::{OutputError, OutputFolder};
use super::{images, ply};
use crate::DepthFrame;

/// Writes `cloud.ply`, `disparity.tiff`, `depth.png`, `depth_color.png`, `zncc.png` and `report.json`.
/// `progress` is told each file.
///
/// # Errors
/// From the file system.
pub fn write(
    out: &mut OutputFolder,
    frame: &DepthFrame,
    report: &Value,
    progress: &mut dyn FnMut(&'static str),
) -> Result<(), OutputError> {
    progress("cloud.ply");
    let cloud = frame.point_cloud();
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
    progress("report.json");
    out.file("report.json", |w| writeln!(w, "{report:#}"))
}
