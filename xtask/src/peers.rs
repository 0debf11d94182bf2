//! `cargo xtask peers`: other matchers on the same recordings, side by side with ours.
//!
//! Python and OpenCV are needed for this alone: a virtual environment in `target/peers` gets OpenCV by
//! one pip command. Nothing of it is built into or shipped with the sensor's software.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Distances of the planes in metres.
const DISTANCES_M: [&str; 3] = ["1", "1.5", "2"];

/// Our matches: name, method, order, pairs.
const OURS: [(&str, &str, &str, &str); 4] = [
    ("stspp dense", "dense", "auto", "10"),
    ("stspp icgn", "icgn", "2", "10"),
    ("stspp dense", "dense", "auto", "3"),
    ("stspp dense", "dense", "auto", "1"),
];

fn run(program: impl AsRef<OsStr>, arguments: &[&str]) -> Result<String, String> {
    let program = program.as_ref();
    let shown = format!("{} {}", program.display(), arguments.join(" "));
    let output = Command::new(program)
        .args(arguments)
        .output()
        .map_err(|e| format!("{shown}: cannot be run: {e}"))?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(format!("{shown}: {}\n{said}", output.status))
}

/// Python with OpenCV: installed once.
fn python(folder: &Path) -> Result<PathBuf, String> {
    let environment = folder.join("venv");
    let python = environment.join("bin/python");
    let shown = environment.display().to_string();
    if !python.exists() {
        run("python3", &["-m", "venv", &shown]).map_err(|e| {
            format!("{e}\nPython 3 with its venv module is needed (Debian: python3-venv)")
        })?;
    }
    if run(&python, &["-c", "import cv2, numpy"]).is_err() {
        run(&python, &["-m", "pip", "install", "--quiet", "opencv-python-headless", "numpy"])?;
    }
    Ok(python)
}

/// Makes recordings, matches them and prints the table.
pub fn table(root: &Path) -> Result<String, String> {
    let folder = root.join("target/peers");
    fs::create_dir_all(&folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    let python = python(&folder)?;
    run("cargo", &["build", "--release", "-p", "stspp"])?;
    let stspp = root.join("target/release/stspp");
    let mut arguments = vec![root.join("xtask/peers.py").display().to_string()];
    for distance_m in DISTANCES_M {
        let recording = folder.join(format!("plane-{distance_m}m"));
        let recording = recording.display().to_string();
        if !Path::new(&recording).exists() {
            eprintln!("recording a plane at {distance_m} m");
            let source = format!("sim:plane?distance_m={distance_m}");
            run(&stspp, &["record", &recording, "--source", &source])?;
        }
        let mut argument = format!("{recording}:plane {distance_m} m:{distance_m}");
        for (name, method, order, frames) in OURS {
            eprintln!("matching {frames} pairs at {distance_m} m: {name}");
            let out = format!("{recording}-{method}-{frames}");
            let options = ["--method", method, "--order", order, "--frames", frames, "--force"];
            let mut reconstruct = vec!["reconstruct", &recording, "--out", &out];
            reconstruct.extend(options);
            run(&stspp, &reconstruct)?;
            argument += &format!(":{name} {frames}={out}");
        }
        arguments.push(argument);
    }
    eprintln!("matching the first pairs by OpenCV");
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    run(&python, &arguments)
}
