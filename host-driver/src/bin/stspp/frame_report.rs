//! `report.json` of a depth frame that came by a stream.

use serde_json::{Value, json};
use stspp::pipeline::MatchInfo;
use stspp::report::{self, Summary};
use stspp::{DepthFrame, StreamStats};

/// The report of `frame`.
pub fn of(source: &str, frame: &DepthFrame, matching: &MatchInfo, stats: &StreamStats) -> Value {
    let stages: Vec<Value> = frame
        .stages
        .iter()
        .map(|stage| json!({ "stage": stage.stage, "wall_ms": stage.wall_ms, "cpu_ms": stage.cpu_ms }))
        .collect();
    json!({
        "versions": report::versions_json(),
        "source": source,
        "frame": frame.sequence,
        "labels": frame.labels,
        "time_device_s": frame.time_device_s,
        "result": Summary::of(frame, matching.seen_pixels),
        "parameters": report::params_json(&matching.params),
        "geometry": report::geometry_json(&frame.geometry),
        "threads": matching.threads,
        "simd": matching.simd,
        "stages": stages,
        "total_wall_ms": frame.stages.iter().map(|stage| stage.wall_ms).sum::<f64>(),
        "stream": stats,
        "depth_png_unit_m": stspp::export::images::DEPTH_PNG_UNIT_M,
    })
}
