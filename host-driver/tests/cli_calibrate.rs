//! `stspp calibrate` and `stspp check` from outside: what they write, and what they refuse.
#![cfg(all(feature = "cli", feature = "sim"))]

mod common;

use std::path::Path;
use std::process::{Command, Output};

use common::{Folder, rig};
use stspp::StereoCalibration;

fn stspp(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_stspp")).args(arguments).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn boards_are_written_as_pdf_and_svg() {
    let folder = Folder::new("cli-board");
    let pdf = folder.path("board.pdf");
    let svg = folder.path("board.svg");
    assert!(stspp(&["calibrate", "board", text(&pdf)]).status.success());
    assert!(std::fs::read(&pdf).unwrap().starts_with(b"%PDF-1.4"));
    let again = stspp(&["calibrate", "board", text(&pdf)]);
    assert_eq!(again.status.code(), Some(4), "{}", stderr(&again));
    let board = ["--board", "circles:9x6:28", "--paper", "a4"];
    let mut arguments = vec!["calibrate", "board", text(&svg)];
    arguments.extend(board);
    assert!(stspp(&arguments).status.success());
    assert!(std::fs::read_to_string(&svg).unwrap().contains("297mm"));
    let bad = stspp(&["calibrate", "board", "board.doc"]);
    assert_eq!(bad.status.code(), Some(2), "{}", stderr(&bad));
    let large = stspp(&["calibrate", "board", "x.pdf", "--board", "charuco:11x8:200"]);
    assert_eq!(large.status.code(), Some(3));
    assert!(stderr(&large).contains("does not fit"), "{}", stderr(&large));
    assert_eq!(
        stspp(&["calibrate", "board", "x.pdf", "--board", "chess:3"]).status.code(),
        Some(2)
    );
    assert!(!Path::new("x.pdf").exists());
}

#[test]
fn files_of_other_programs_go_there_and_back() {
    let folder = Folder::new("cli-convert");
    let [ours, opencv, ros, back] =
        ["camchain.yaml", "stereo.yaml", "info", "back.yaml"].map(|name| folder.path(name));
    rig().write(&ours).unwrap();
    for (to, out) in [("opencv", &opencv), ("ros", &ros)] {
        let done = stspp(&["calibrate", "export", text(&ours), "--to", to, "--out", text(out)]);
        assert!(done.status.success(), "{}", stderr(&done));
    }
    let done =
        stspp(&["calibrate", "import", text(&opencv), "--from", "opencv", "-o", text(&back)]);
    assert!(done.status.success(), "{}", stderr(&done));
    assert_eq!(StereoCalibration::read(&back).unwrap().left, rig().left);
    let refused =
        stspp(&["calibrate", "import", text(&opencv), "--from", "opencv", "-o", text(&back)]);
    assert_eq!(refused.status.code(), Some(4));
    let (left, right) = (ros.join("left.yaml"), ros.join("right.yaml"));
    let done = stspp(&[
        "calibrate",
        "import",
        text(&left),
        text(&right),
        "--from",
        "ros",
        "-o",
        text(&back),
        "--force",
    ]);
    assert!(done.status.success(), "{}", stderr(&done));
    assert_eq!(StereoCalibration::read(&back).unwrap().right, rig().right);
}

#[test]
fn images_without_a_board_write_nothing_and_say_so() {
    let folder = Folder::new("cli-no-board");
    let images = folder.path("images");
    let out = folder.path("camchain.yaml");
    let missing = stspp(&["calibrate", text(&images), "--out", text(&out)]);
    assert_eq!(missing.status.code(), Some(3));
    assert!(stderr(&missing).contains("left"), "{}", stderr(&missing));
    for side in ["left", "right"] {
        std::fs::create_dir_all(images.join(side)).unwrap();
        for k in 0..3 {
            let grey = stspp_matcher::Image::new(64, 48, 90_u8);
            let mut file =
                std::fs::File::create(images.join(side).join(format!("{k:02}.png"))).unwrap();
            stspp::image_io::write_gray8(&mut file, &grey, &[]).unwrap();
        }
    }
    let none = stspp(&["calibrate", text(&images), "--out", text(&out)]);
    let message = stderr(&none);
    assert_eq!(none.status.code(), Some(3), "{message}");
    assert!(message.contains("0 of 3 image pairs") && message.contains("no readable board"));
    assert_eq!(message.trim_end().lines().count(), 1);
    assert_eq!(folder.names(), ["images"]);
}

/// A board shown to the simulated sensor is found and kept, in two places; for a calibration that is
/// too few, which is said, and no calibration is written.
#[test]
fn a_live_sensor_takes_boards_and_two_are_too_few() {
    let folder = Folder::new("cli-live");
    let out = folder.path("camchain.yaml");
    let images = folder.path("images");
    let source = "sim:calibration?scale=4&places=5&board=charuco:6x5:80&dwell_ms=140";
    let arguments = ["calibrate", "--source", source, "--board", "charuco:6x5:80", "-n", "2"];
    let files = ["--out", text(&out), "--save", text(&images)];
    let done = stspp(&[&arguments[..], &files[..]].concat());
    let message = stderr(&done);
    assert_eq!(done.status.code(), Some(3), "{message}");
    assert!(message.contains("2 of 2 image pairs") && message.contains("at least 4"), "{message}");
    assert_eq!(folder.names(), ["images"]);
    assert!(images.join("left/01.png").exists() && images.join("right/01.png").exists());
}

#[test]
fn check_corrects_a_turned_camera_and_leaves_a_good_one() {
    let folder = Folder::new("cli-check");
    let recording = folder.path("rec");
    let rec = text(&recording);
    let source = "sim:plane?scale=2&distance_m=1.1&tilt_deg=20";
    let done = stspp(&["record", rec, "--source", source, "-n", "4"]);
    assert!(done.status.success(), "{}", stderr(&done));
    let good = folder.path("good.yaml");
    let refused = stspp(&["check", rec, "--correct", text(&good)]);
    assert_eq!(refused.status.code(), Some(3), "{}", stderr(&refused));
    assert!(stderr(&refused).contains("nothing to correct") && !good.exists());
    // A calibration whose right camera is 0.06 degrees off in roll.
    let mut wrong = StereoCalibration::read(recording.join("camchain.yaml")).unwrap();
    let truth = wrong.right_from_left;
    let turn = nalgebra::UnitQuaternion::from_scaled_axis(nalgebra::Vector3::new(
        0.0,
        0.0,
        0.06_f64.to_radians(),
    ));
    wrong.right_from_left = turn * truth;
    let (drifted, fixed) = (folder.path("drifted.yaml"), folder.path("fixed.yaml"));
    wrong.write(&drifted).unwrap();
    let done = stspp(&[
        "--json",
        "check",
        rec,
        "--calibration",
        text(&drifted),
        "--correct",
        text(&fixed),
    ]);
    assert!(done.status.success(), "{}", stderr(&done));
    let report: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert!(report["corrected"]["change"]["text"].to_string().contains("turned by"));
    let fixed = StereoCalibration::read(&fixed).unwrap();
    let left = (fixed.right_from_left.rotation * truth.rotation.inverse()).angle().to_degrees();
    assert!(left < 0.005, "{left}");
    let again = stspp(&["check", rec, "--calibration", text(&folder.path("fixed.yaml"))]);
    assert!(String::from_utf8_lossy(&again.stdout).starts_with("good"));
}
