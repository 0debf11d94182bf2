//! The command line as its user sees it: transcripts of the verbs that talk to a sensor.
#![cfg(all(feature = "sim", feature = "cli"))]

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A folder of its own that goes away.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("stspp-cli-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn path(&self, name: &str) -> String {
        self.0.join(name).display().to_string()
    }

    fn names(&self, folder: &str) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(self.0.join(folder))
            .map(|entries| entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect())
            .unwrap_or_default();
        names.sort();
        names
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn stspp(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_stspp")).args(args).output().unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

#[track_caller]
fn succeeds(args: &[&str]) -> String {
    let output = stspp(args);
    assert!(output.status.success(), "{args:?}: {}", stderr(&output));
    stdout(&output)
}

#[track_caller]
fn json(args: &[&str]) -> serde_json::Value {
    serde_json::from_str(&succeeds(args)).unwrap()
}

/// One error line, the exit code, nothing on standard output.
#[track_caller]
fn fails(args: &[&str], code: i32) -> String {
    let output = stspp(args);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {}", stderr(&output));
    assert_eq!(stdout(&output), "");
    let text = stderr(&output);
    assert!(text.starts_with("error: ") && text.trim_end().lines().count() == 1, "{text}");
    text.trim_end().to_owned()
}

#[test]
fn help_lists_the_verbs_and_exit_codes() {
    let help = succeeds(&["--help"]);
    for verb in [
        "list",
        "info",
        "demo",
        "reconstruct",
        "timing",
        "stream",
        "capture",
        "record",
        "play",
        "bench",
        "completions",
    ] {
        assert!(help.lines().any(|l| l.trim_start().starts_with(verb)), "{verb} in\n{help}");
    }
    assert!(help.contains("Exit codes:") && help.contains("130  interrupted"));
}

#[test]
fn the_simulated_sensor_is_always_listed() {
    // Sensors plugged into the machine stand beside it.
    let list = succeeds(&["list"]);
    let line = list.lines().find(|line| line.starts_with("sim: ")).unwrap_or_default();
    let says = line.trim_start_matches("sim:").trim_start();
    assert_eq!(says, "simulated sensor, always there; `stspp list --scenes` shows its scenes");
    let sensors = json(&["list", "--json"]);
    let mut sensors = sensors["sensors"].as_array().expect("a list of sensors").iter();
    assert!(sensors.any(|sensor| sensor["source"] == "sim:"));
    let scenes = succeeds(&["list", "--scenes"]);
    assert!(scenes.contains("sim:plane") && scenes.contains("seed=1"), "{scenes}");
}

#[test]
fn info_shows_versions_state_and_timing() {
    let info = succeeds(&["info", "-s", "sim:plane?scale=8"]);
    for part in ["source    sim:plane?scale=8", "protocol 1.1", "160x128", "state     idle"] {
        assert!(info.contains(part), "{part} in\n{info}");
    }
    let info = json(&["info", "--json", "-s", "sim:plane?scale=8"]);
    assert_eq!(info["timing"]["frame_period_us"], 33_333);
    assert_eq!(info["status"]["state"], "Idle");
}

#[test]
fn timings_are_set_field_by_field() {
    let text = succeeds(&[
        "timing",
        "set",
        "-s",
        "sim:plane?scale=8",
        "--slots",
        "9,8,3+4,flood,dark",
        "--period-us",
        "40000",
    ]);
    assert_eq!(
        text,
        "slots     9,8,3+4,flood,dark\n\
         timing    period 40000 us (25.000 Hz), exposure 32000 us, delay 100 us, lead 50 us, lag 50 us\n\
         accepted; sim: forgets it now: keep the output of --json and use --timing\n"
    );
}

#[test]
fn an_impossible_timing_names_each_rule() {
    let error = fails(
        &[
            "timing",
            "set",
            "-s",
            "sim:plane?scale=8",
            "--exposure-us",
            "60000",
            "--slots",
            "12,3,4",
        ],
        3,
    );
    for part in [
        "slot 0: projector_mask is 0x1000; allowed bits are 0x03ff",
        "exposure_us is 60000; allowed is 10..=39900",
        "frame_period_us is 33333",
        "nothing has changed",
    ] {
        assert!(error.contains(part), "{part} in\n{error}");
    }
}

#[test]
fn a_timing_file_goes_from_verb_to_verb() {
    let folder = Folder::new("timing");
    let set = json(&["timing", "set", "--json", "-s", "sim:plane?scale=16", "--slots", "7,1,4"]);
    let file = folder.path("timing.json");
    std::fs::write(&file, set.to_string()).unwrap();
    let recording = folder.path("recording");
    succeeds(&[
        "record",
        &recording,
        "-q",
        "-s",
        "sim:plane?scale=16",
        "--timing",
        &file,
        "-n",
        "4",
    ]);
    let frames: serde_json::Value = serde_json::from_str(
        &std::fs::read_to_string(Path::new(&recording).join("frames.json")).unwrap(),
    )
    .unwrap();
    let text = frames.to_string();
    for mask in [128, 2, 16] {
        assert!(text.contains(&format!("\"projector_mask\":{mask}")), "{text}");
    }
    std::fs::write(&file, "{\"slots\": []}").unwrap();
    let error = fails(&["record", &folder.path("x"), "--timing", &file], 3);
    assert!(error.contains("timing.json") && error.contains("frame_period_us"), "{error}");
    assert!(!Path::new(&folder.path("x")).exists());
}

#[test]
fn sources_that_are_not_there_say_so() {
    let error = fails(&["info", "-s", "http://sensor"], 3);
    assert!(error.contains("names no source") && error.contains("stspp list"), "{error}");
    let error = fails(&["stream", "-s", "sim:nowhere"], 3);
    assert!(error.contains("nowhere"), "{error}");
    let error = fails(&["capture", "-s", "replay:/nonexistent", "--out", "/tmp/never"], 3);
    assert!(error.contains("/nonexistent"), "{error}");
    for uri in ["usb:", "serial:/dev/ttyUSB7"] {
        fails(&["info", "-s", uri], 5);
    }
}

#[test]
fn outputs_that_cannot_be_written_are_found_out_first() {
    let folder = Folder::new("unwritable");
    let file = folder.path("file");
    std::fs::write(&file, "").unwrap();
    let below = format!("{file}/out");
    for args in [
        &["demo", "--scene", "plane?scale=16", "--out", &below][..],
        &["capture", "-s", "sim:plane?scale=16", "--out", &below],
        &["record", &below, "-s", "sim:plane?scale=16"],
    ] {
        let error = fails(args, 4);
        assert!(error.contains("file"), "{error}");
    }
    assert_eq!(folder.names("."), ["file"]);
}

#[test]
fn demo_writes_its_outputs_and_compares_with_the_truth() {
    let folder = Folder::new("demo");
    let out = folder.path("out");
    let text = succeeds(&["demo", "-q", "--scene", "sphere?scale=4", "--out", &out]);
    assert!(text.contains("sphere fit RMS") && text.contains("plane fit RMS"), "{text}");
    assert!(text.contains("look at ") && text.contains("depth_color.png"), "{text}");
    let files =
        ["cloud.ply", "depth.png", "depth_color.png", "disparity.tiff", "report.json", "zncc.png"];
    assert_eq!(folder.names("out"), files);
    let report = std::fs::read_to_string(Path::new(&out).join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    // A quarter of the resolution: coarse bounds that a wrong reconstruction cannot keep.
    assert!(report["truth"]["score"]["completeness"].as_f64().unwrap() > 0.97, "{report:#}");
    for fit in report["truth"]["fits"].as_array().unwrap() {
        assert!(fit["truth_rms_mm"].as_f64().unwrap() < 1.0, "{fit:#}");
    }
    // Again into the same folder: replaced.
    succeeds(&["demo", "-q", "--scene", "plane?scale=8", "--out", &out]);
}

#[test]
fn a_recording_is_reconstructed_and_played() {
    let folder = Folder::new("record");
    let recording = folder.path("recording");
    let source = "sim:plane?scale=8&distance_m=1.3";
    let text = succeeds(&["record", &recording, "-q", "-s", source, "-n", "11", "--truth"]);
    assert!(text.starts_with("11 pairs in "), "{text}");
    assert_eq!(
        folder.names("recording"),
        ["camchain.yaml", "frames.json", "left", "right", "truth"]
    );
    assert_eq!(folder.names("recording/left").len(), 11);
    assert_eq!(
        folder.names("recording/truth"),
        ["depth.tiff", "primitives.json", "visible_to_both.png"]
    );
    succeeds(&["reconstruct", &recording, "-q", "--out", &folder.path("depth")]);
    let played = succeeds(&["play", &recording, "-q", "--json"]);
    let lines: Vec<serde_json::Value> =
        played.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 3, "two windows and the counters: {played}");
    let depth_m = lines[0]["result"]["depth_median_m"].as_f64().unwrap();
    assert!((depth_m - 1.3).abs() < 0.1, "{depth_m}");
    assert_eq!(lines[2]["stats"]["pairs"], 11);
    // It is not overwritten unasked.
    let error = fails(&["record", &recording, "-q", "-s", source, "-n", "1"], 4);
    assert!(error.contains("exists already"), "{error}");
}

#[test]
fn stream_and_capture_deliver_what_is_asked_for() {
    let folder = Folder::new("capture");
    let source = "sim:plane?scale=8";
    let text = succeeds(&["stream", "-q", "-s", source, "-n", "2"]);
    assert!(text.starts_with("2 depth frames in ") && text.contains("0 mislabelled"), "{text}");
    let out = folder.path("out");
    succeeds(&["capture", "-q", "-s", source, "-n", "2", "--out", &out, "--method", "parabola"]);
    assert_eq!(folder.names("out"), ["0000", "0001"]);
    assert_eq!(folder.names("out/0001").len(), 6);
    let error = fails(&["capture", "-q", "-s", source, "--out", &out, "-n", "2"], 4);
    assert!(error.contains("--force"), "{error}");
}

#[test]
fn completions_are_printed() {
    for shell in ["bash", "zsh", "fish"] {
        assert!(succeeds(&["completions", shell]).contains("reconstruct"));
    }
}

#[cfg(unix)]
#[test]
fn ctrl_c_during_a_reconstruction_removes_what_was_begun() {
    let folder = Folder::new("interrupt-reconstruct");
    let recording = folder.path("recording");
    succeeds(&["record", &recording, "-q", "-s", "sim:plane?scale=2"]);
    let child = Command::new(env!("CARGO_BIN_EXE_stspp"))
        .args(["reconstruct", &recording, "-q", "--out", &folder.path("new/out")])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let begun = Instant::now();
    while folder.names("new").is_empty() {
        assert!(begun.elapsed() < Duration::from_secs(60), "not begun");
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(
        Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success()
    );
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
    assert_eq!(folder.names("."), ["recording"], "nothing but the input");
}

#[cfg(unix)]
#[test]
fn ctrl_c_ends_cleanly_and_leaves_nothing_behind() {
    let folder = Folder::new("interrupt");
    let out = folder.path("out");
    let mut child = Command::new(env!("CARGO_BIN_EXE_stspp"))
        .args(["capture", "-q", "-s", "sim:plane?scale=8&pace=real", "-n", "500", "--out", &out])
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    // The first frame is there: it streams.
    let begun = Instant::now();
    while !Path::new(&out).join("0000/report.json").exists() {
        assert!(begun.elapsed() < Duration::from_secs(120), "no frame");
        assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(
        Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success()
    );
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
    // Whole frames only, and nothing half-written.
    for name in folder.names("out") {
        assert!(!name.starts_with('.'), "{name}");
        assert_eq!(folder.names(&format!("out/{name}")).len(), 6);
    }
    assert!(folder.names(".").iter().all(|name| name == "out"));
}
