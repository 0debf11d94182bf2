//! Depth in the guest, held against the truth; and the cameras at their full size.

use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Instant;

use serde_json::Value;

use super::bench::{Bench, built};
use super::scenario::{self, number};
use super::score::METHOD;

/// Depth frames that are captured and held against the truth, at first and after all faults.
const FRAMES: usize = 10;
const FRAMES_AGAIN: usize = 3;

/// Depth frames that are streamed for rate and latency.
const FRAMES_LIVE: usize = 4;

/// Pairs that are streamed at full size: more than a slot cycle.
const FULL_PAIRS: u64 = 12;

/// What is waited for at full size: a picture may take a second, and a trigger waits for its frames in
/// proportion to this.
const FULL_TIMEOUT_S: &str = "60";

/// Where the guest's captures go.
const OUT: &str = "/tmp/depth";

/// Where the guest's recording goes.
const RECORDING: &str = "/tmp/full-size";

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
    frames(bench, FRAMES)
}

/// The same once more.
pub fn again(bench: &mut Bench) -> Result<String, String> {
    frames(bench, FRAMES_AGAIN)
}

fn frames(bench: &mut Bench, count: usize) -> Result<String, String> {
    capture(bench, count, 170)?;
    let clouds: Result<Vec<PathBuf>, String> = (0..count)
        .map(|k| {
            let cloud = bench.file(&format!("{OUT}/{k:04}/cloud.ply"))?;
            let path = bench.folder.join(format!("guest-{k}.ply"));
            std::fs::write(&path, cloud).map_err(|e| format!("{}: {e}", path.display()))?;
            Ok(path)
        })
        .collect();
    bench.compare(&clouds?)
}

/// Rate and latency of a live stream as `stspp stream` tells them.
pub fn stream(bench: &mut Bench) -> Result<String, String> {
    let source = bench.source();
    let count = FRAMES_LIVE.to_string();
    let arguments = ["stream", "--json", "--timeout", "60", "--method", METHOD, "-n", &count];
    let text = bench.stspp_ok(100, &[&arguments[..], &["--source", &source]].concat())?;
    bench.dark()?;
    let lines: Vec<Value> =
        text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let stats = lines.iter().find_map(|line| line.get("stats")).cloned().unwrap_or_default();
    scenario::add_up(&stats)?;
    let latencies: Vec<f64> =
        lines.iter().filter_map(|line| line.get("latency_ms")?.as_f64()).collect();
    let fps = stats["fps"].as_f64().unwrap_or(0.0);
    if latencies.len() != FRAMES_LIVE || latencies.iter().any(|ms| *ms <= 0.0) || fps <= 0.0 {
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
        bench.exchange(1, &[])?;
    }
    scenario::set_timing(bench)?;
    let source = bench.source();
    let count = FULL_PAIRS.to_string();
    let arguments =
        ["stream", "--pairs", "--json", "--timeout", FULL_TIMEOUT_S, "--source", &source];
    let begun = Instant::now();
    let text = bench.stspp_ok(150, &[&arguments[..], &["-n", &count]].concat())?;
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

/// A slot cycle of them, recorded in the guest. It is matched on this machine: what takes a tenth of a
/// second there takes minutes on an emulated processor.
pub fn full_depth(bench: &mut Bench) -> Result<String, String> {
    if bench.scale != 1 {
        return Err("the full-size cameras are not plugged in".into());
    }
    let (source, begun) = (bench.source(), Instant::now());
    let arguments = ["record", RECORDING, "--force", "--json", "--timeout", FULL_TIMEOUT_S];
    let json = bench.stspp_json(150, &[&arguments[..], &["--source", &source]].concat())?;
    let seconds = begun.elapsed().as_secs_f64();
    bench.dark()?;
    let pairs = json["pairs"].as_u64().unwrap_or(0);
    let folder = bench.folder.join("full-size");
    for side in ["left", "right"] {
        let path = folder.join(side);
        std::fs::create_dir_all(&path).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    let images =
        (0..pairs).flat_map(|k| ["left", "right"].map(|side| format!("{side}/{k:02}.png")));
    for name in images.chain(["camchain.yaml".into(), "frames.json".into()]) {
        let bytes = bench.file(&format!("{RECORDING}/{name}"))?;
        let path = folder.join(&name);
        std::fs::write(&path, bytes).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    let out = folder.join("depth");
    let status = Command::new(built("stspp"))
        .arg("reconstruct")
        .arg(&folder)
        .args(["--quiet", "--force", "--method", METHOD, "--out"])
        .arg(&out)
        .stdout(Stdio::null())
        .status();
    if !status.is_ok_and(|s| s.success()) {
        return Err("the guest's recording cannot be reconstructed".into());
    }
    let told = bench.compare(&[out.join("cloud.ply")])?;
    Ok(format!("{pairs} pairs recorded in {seconds:.1} s; {told}"))
}
