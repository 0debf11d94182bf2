//! `report.json`: what was computed, from what, how, and how long it took.

use serde::Serialize;
use serde_json::{Value, json};
use stspp_matcher::{Image, Params};

use crate::cpu_time::Step;
use crate::export::images::DEPTH_PNG_UNIT_M;
use crate::reconstruct::Reconstruction;
use crate::{DepthFrame, RectifiedGeometry};

/// Median of the finite values.
fn median(image: &Image<f32>) -> Option<f32> {
    let mut values: Vec<f32> = image.as_slice().iter().copied().filter(|v| v.is_finite()).collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// What the pixels hold.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Valid points.
    pub points: usize,
    /// Valid points as a part of the canvas pixels that the left camera saw; parts that the right
    /// camera cannot see count as missing.
    pub completeness: f64,
    /// Nearest valid depth in metres.
    pub depth_min_m: Option<f32>,
    /// Median depth in metres.
    pub depth_median_m: Option<f32>,
    /// Farthest valid depth in metres.
    pub depth_max_m: Option<f32>,
    /// Median ZNCC.
    pub zncc_median: Option<f32>,
    /// Part of the points with a ZNCC above 0.8.
    pub zncc_above_0_8: f64,
}

impl Summary {
    /// Summarises a frame of which the left camera saw `seen_pixels`.
    pub fn of(frame: &DepthFrame, seen_pixels: usize) -> Self {
        let depths = || frame.depth_m.as_slice().iter().copied().filter(|z| z.is_finite());
        let points = depths().count();
        let similar = frame.zncc.as_slice().iter().filter(|v| **v > 0.8).count();
        Self {
            points,
            completeness: points as f64 / seen_pixels.max(1) as f64,
            depth_min_m: depths().reduce(f32::min),
            depth_median_m: median(&frame.depth_m),
            depth_max_m: depths().reduce(f32::max),
            zncc_median: median(&frame.zncc),
            zncc_above_0_8: similar as f64 / points.max(1) as f64,
        }
    }
}

/// Most memory that this process has used so far; `None` where the system does not tell.
pub fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kib: u64 = line.split_ascii_whitespace().nth(1)?.parse().ok()?;
    Some(kib * 1024)
}

/// The matcher's parameters as JSON.
pub fn params_json(params: &Params) -> Value {
    let a = &params.advanced;
    json!({
        "method": format!("{:?}", params.method),
        "shape_function": format!("{:?}", params.shape),
        "disparity_min_px": params.disparity.min_px,
        "disparity_max_px": params.disparity.max_px,
        "zncc_min": params.zncc_min,
        "census_radius": a.census_radius,
        "retry_radius": a.retry_radius,
        "retry_similarity": a.retry_similarity,
        "subset_radius": a.subset_radius,
        "convergence_px": a.convergence_px,
        "iterations_max": a.iterations_max,
        "left_right_px": a.left_right_px,
        "settle_steps": a.settle_steps,
    })
}

/// The canvas's geometry as JSON.
pub fn geometry_json(geometry: &RectifiedGeometry) -> Value {
    let rows: Vec<Vec<f64>> = geometry
        .rect_from_left
        .matrix()
        .row_iter()
        .map(|row| row.iter().copied().collect())
        .collect();
    json!({
        "width_px": geometry.width,
        "height_px": geometry.height,
        "focal_px": geometry.focal_px,
        "cx_left_px": geometry.cx_left_px,
        "cx_right_px": geometry.cx_right_px,
        "cy_px": geometry.cy_px,
        "baseline_m": geometry.baseline_m,
        "rect_from_left": rows,
    })
}

/// Steps as a JSON list with their totals: `stages`, `total_wall_ms`, `total_cpu_ms`.
pub fn times_json(steps: &[Step]) -> Value {
    let cpu: Option<f64> = steps.iter().map(|s| s.cpu_ms).sum();
    json!({
        "total_wall_ms": steps.iter().map(|s| s.wall_ms).sum::<f64>(),
        "total_cpu_ms": cpu,
        "stages": steps,
    })
}

/// Versions of the parts.
pub fn versions_json() -> Value {
    // All crates of the workspace have one version.
    json!({ "stspp": env!("CARGO_PKG_VERSION"), "report": 1 })
}

/// The report of a reconstruction; `source` says what was reconstructed.
pub fn of_reconstruction(source: &str, reconstruction: &Reconstruction) -> Value {
    let frame = &reconstruction.frame;
    let matching: Vec<Value> = frame
        .stages
        .iter()
        .map(|stage| json!({ "stage": stage.stage, "wall_ms": stage.wall_ms, "cpu_ms": stage.cpu_ms }))
        .collect();
    let mut report = json!({
        "versions": versions_json(),
        "source": source,
        "pairs": reconstruction.pairs,
        "labels": frame.labels,
        "time_device_s": frame.time_device_s,
        "bits": reconstruction.bits,
        "result": Summary::of(frame, reconstruction.seen_pixels),
        "parameters": params_json(&reconstruction.params),
        "geometry": geometry_json(&frame.geometry),
        "threads": reconstruction.threads,
        "simd": reconstruction.simd,
        "matching_stages": matching,
        "files": {
            "cloud.ply": "points in metres, left camera (cam0) optical frame",
            "disparity.tiff": "disparity in px, float, NaN invalid",
            "depth.png": format!(
                "z in the left camera's frame, {:.1} mm per grey level, 0 invalid",
                DEPTH_PNG_UNIT_M * 1e3
            ),
            "depth_color.png": "depth as colours, near is red, dark is invalid",
            "zncc.png": "similarity, 255 is 1, 0 is 0 or invalid",
        },
        "depth_png_unit_m": 1e-4,
    });
    if let (Value::Object(report), Value::Object(times)) =
        (&mut report, times_json(&reconstruction.steps))
    {
        report.extend(times);
    }
    report
}
