//! Depth in the guest, held against the truth; and the cameras at their full size.

use std::time::Instant;

use serde_json::Value;

use super::bench::Bench;
use super::scenario::{self, number};
use super::score::METHOD;

/// Depth frames that are captured and held against the truth.
const FRAMES: usize = 10;

/// Pairs that are streamed at full size: more than a slot cycle.
const FULL_PAIRS: u64 = 12;

/// What is waited for at full size: a picture may take a second, and a trigger waits for its frames in
/// proportion to this.
const FULL_TIMEOUT_S: &str = "120";

/// Where the guest's captures go.
const OUT: &str = "/tmp/depth";

/// Captures `count` depth frames in the guest; what `stspp` said.
fn capture(bench: &mut Bench, count: usize, seconds: u32) -> Result<Value, String> {
    let source = bench.source();
    let count = count.to_string();
    let arguments = ["capture", "--force", "--json", "--timeout", "60", "--method", METHOD];
    let what = ["-n", &count, "--source", &source, "--out", OUT];
    let json = bench.stspp_json(seconds, &[&arguments[..], &what].concat())?;
    bench.dark()?;
    Ok(json)
}

/// Ten depth frames, and the RMS of their errors beside that of the in-process sensor.
pub fn depth(bench: &mut Bench) -> Result<String, String> {
    capture(bench, FRAMES, 150)?;
    let clouds: Vec<String> = (0..FRAMES).map(|k| format!("{OUT}/{k:04}/cloud.ply")).collect();
    bench.compare(&clouds)
}

/// Rate and latency of a live stream as `stspp stream` tells them.
pub fn stream(bench: &mut Bench) -> Result<String, String> {
    let source = bench.source();
    let arguments = ["stream", "--json", "--timeout", "60", "--method", METHOD, "-n", "10"];
    let text = bench.stspp_ok(100, &[&arguments[..], &["--source", &source]].concat())?;
    bench.dark()?;
    let lines: Vec<Value> =
        text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let stats = lines.iter().find_map(|line| line.get("stats")).cloned().unwrap_or_default();
    scenario::add_up(&stats)?;
    let latencies: Vec<f64> =
        lines.iter().filter_map(|line| line.get("latency_ms")?.as_f64()).collect();
    let fps = stats["fps"].as_f64().unwrap_or(0.0);
    if latencies.len() != 10 || latencies.iter().any(|ms| *ms <= 0.0) || fps <= 0.0 {
        return Err(format!("latencies {latencies:?} ms, {fps} frames/s"));
    }
    let mean = latencies.iter().sum::<f64>() / latencies.len() as f64;
    let match_ms = stats["match_ms"].as_f64().unwrap_or(0.0);
    Ok(format!(
        "{fps:.2} depth frames/s, {mean:.0} ms from the last exposure's end, {match_ms:.0} of them the match"
    ))
}

/// Cameras of 1280x1024: pairs, and every frame of them accounted for.
pub fn full_pairs(bench: &mut Bench) -> Result<String, String> {
    if bench.scale != 1 {
        bench.exchange(1)?;
    }
    scenario::set_timing(bench)?;
    let source = bench.source();
    let count = FULL_PAIRS.to_string();
    let arguments =
        ["stream", "--pairs", "--json", "--timeout", FULL_TIMEOUT_S, "--source", &source];
    let begun = Instant::now();
    let text = bench.stspp_ok(100, &[&arguments[..], &["-n", &count]].concat())?;
    let took_s = begun.elapsed().as_secs_f64();
    bench.dark()?;
    let last = text.lines().rfind(|line| line.contains("\"stats\"")).unwrap_or_default();
    let json: Value = serde_json::from_str(last).map_err(|e| format!("{e}: {text}"))?;
    let stats = &json["stats"];
    scenario::add_up(stats)?;
    let damaged = number(stats, "/damaged_left") + number(stats, "/damaged_right");
    let wall_s = json["wall_s"].as_f64().unwrap_or(took_s);
    let megabytes = FULL_PAIRS as f64 * 2.0 * 1280.0 * 1024.0 * 1e-6;
    let told = format!(
        "{FULL_PAIRS} pairs of 1280x1024 in {wall_s:.1} s: {:.1} pairs/s, {:.0} MB/s; {damaged} damaged",
        FULL_PAIRS as f64 / wall_s,
        megabytes / wall_s
    );
    if number(stats, "/pairs") >= FULL_PAIRS && damaged == 0 { Ok(told) } else { Err(told) }
}

/// A depth frame of them, held against the truth.
pub fn full_depth(bench: &mut Bench) -> Result<String, String> {
    if bench.scale != 1 {
        return Err("the full-size cameras are not plugged in".into());
    }
    let begun = Instant::now();
    capture(bench, 1, 150)?;
    let seconds = begun.elapsed().as_secs_f64();
    let told = bench.compare(&[format!("{OUT}/cloud.ply")])?;
    Ok(format!("after {seconds:.0} s; {told}"))
}
