//! Calibration files: round trips, imports, and every way in which they can be wrong.

mod common;

use std::path::Path;

use common::{Random, distorted, rig};
use nalgebra::{Point3, Vector2};
use proptest::prelude::*;
use stspp::StereoCalibration;
use stspp::calibration::opencv::{self, OpenCvImport};
use stspp::calibration::{CalibrationError, kalibr, ros};

/// A camchain.yaml as Kalibr writes it, with the fields that it adds.
const KALIBR: &str = "\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.09, 0.07, 0.0004, -0.0003]
  distortion_model: radtan
  intrinsics: [1861.25, 1859.5, 641.75, 509.25]
  resolution: [1280, 1024]
  rostopic: /left
cam1:
  T_cn_cnm1:
  - [0.93969262, 0.0, 0.34202014, -0.37587705]
  - [0.0, 1.0, 0.0, 0.0]
  - [-0.34202014, 0.0, 0.93969262, 0.13680806]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.085, 6.0e-2, -2e-4, 0.0005]
  distortion_model: radtan
  intrinsics: [1856.75, 1857.5, 636.25, 516.25]
  resolution: [1280, 1024]
  rostopic: /right
";

fn parse(text: &str) -> Result<StereoCalibration, CalibrationError> {
    kalibr::parse(Path::new("camchain.yaml"), text)
}

#[test]
fn kalibr_fields_mean_what_they_say() {
    let calibration = parse(KALIBR).unwrap();
    assert_eq!(calibration.left.focal_px, [1861.25, 1859.5]);
    assert_eq!(calibration.left.principal_px, [641.75, 509.25]);
    assert_eq!(calibration.right.radtan, [-0.085, 0.06, -0.0002, 0.0005]);
    assert_eq!(calibration.right.resolution_px, [1280, 1024]);
    // The camera centre of cam1 is 0.4 m to the right of cam0's.
    let right_in_left = calibration.right_from_left.inverse() * Point3::origin();
    assert!((right_in_left - Point3::new(0.4, 0.0, 0.0)).norm() < 1e-7);
    // T maps cam0's coordinates to cam1's, row by row as printed.
    let q = calibration.right_from_left * Point3::new(0.1, 0.2, 1.0);
    let x = 0.93969262 * 0.1 + 0.34202014 - 0.37587705;
    assert!((q.x - x).abs() < 1e-7 && (q.y - 0.2).abs() < 1e-7);
}

#[test]
fn a_written_file_reads_back_the_same() {
    let folder = common::Folder::new("calibration");
    let mut calibration = rig();
    calibration.temperature_c = Some(31.25);
    calibration.date = Some("2026-03-01T12:00:00Z, o'clock".into());
    calibration.write(folder.path("camchain.yaml")).unwrap();
    let back = StereoCalibration::read(folder.path("camchain.yaml")).unwrap();
    assert_eq!(back.left, calibration.left);
    assert_eq!(back.right, calibration.right);
    assert_eq!((back.temperature_c, &back.date), (Some(31.25), &calibration.date));
    let difference =
        back.right_from_left.to_homogeneous() - calibration.right_from_left.to_homogeneous();
    assert!(difference.abs().max() < 1e-15);
}

/// Each wrong file: what is replaced, by what, and what the error must name.
#[test]
fn wrong_files_are_named_with_field_and_expectation() {
    let cases: &[(&str, &str, &[&str])] = &[
        ("camera_model: pinhole", "camera_model: omni", &["cam0.camera_model", "pinhole", "omni"]),
        (
            "distortion_model: radtan",
            "distortion_model: equi",
            &["cam0.distortion_model", "radtan"],
        ),
        ("  intrinsics: [1861.25, 1859.5, 641.75, 509.25]\n", "", &["cam0.intrinsics", "missing"]),
        (
            "[1861.25, 1859.5, 641.75, 509.25]",
            "[1861.25, 1859.5, 641.75]",
            &["cam0.intrinsics", "3"],
        ),
        ("[1861.25,", "[.nan,", &["cam0.intrinsics", "finite", "nan"]),
        ("[1861.25,", "[focal,", &["cam0.intrinsics", "number"]),
        ("[1861.25,", "[1.8,", &["cam0.intrinsics", "focal"]),
        ("[1861.25, 1859.5", "[-1861.25, 1859.5", &["cam0.intrinsics", "focal"]),
        ("[1861.25,", "[9000.0,", &["cam0.intrinsics", "factor of 2"]),
        ("641.75, 509.25", "641.75, 5092.5", &["cam0.intrinsics", "principal point"]),
        ("[-0.09, 0.07,", "[-9.0, 0.07,", &["cam0.distortion_coeffs", "invertible"]),
        (
            "[-0.09, 0.07, 0.0004, -0.0003]",
            "[-0.09]",
            &["cam0.distortion_coeffs", "k1, k2, p1, p2"],
        ),
        ("resolution: [1280, 1024]", "resolution: [640, 512]", &["cam1.resolution", "640"]),
        ("resolution: [1280, 1024]", "resolution: [1280.5, 1024]", &["cam0.resolution", "whole"]),
        ("resolution: [1280, 1024]", "resolution: [0, 1024]", &["cam0.resolution"]),
        ("resolution: [1280, 1024]", "resolution: [1280]", &["cam0.resolution", "list of 1"]),
        ("[0.93969262, 0.0, 0.34202014,", "[0.9, 0.0, 0.34202014,", &["T_cn_cnm1", "rotation"]),
        ("[0.0, 1.0, 0.0, 0.0]", "[0.0, -1.0, 0.0, 0.0]", &["T_cn_cnm1", "rotation", "-1"]),
        ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.0, 2.0]", &["T_cn_cnm1[3]", "[0, 0, 0, 1]"]),
        ("  - [0.0, 0.0, 0.0, 1.0]\n", "", &["cam1.T_cn_cnm1", "four rows"]),
        ("-0.37587705", "0.37587705", &["cam1.T_cn_cnm1", "right of cam0"]),
        ("-0.37587705", "-375.87705", &["cam1.T_cn_cnm1", "metres"]),
        ("cam1:", "camera1:", &["cam1", "missing"]),
        ("cam0:\n", "cam0: 3\nother:\n", &["cam0", "mapping"]),
        ("cam_overlaps: [1]\n", "cam_overlaps: [1\n", &["camchain.yaml:", "not valid YAML"]),
        ("rostopic: /left", "resolution: [1, 1]", &["`resolution` is given twice"]),
    ];
    for (from, to, expected) in cases {
        assert!(KALIBR.contains(from), "{from}");
        let error = parse(&KALIBR.replacen(from, to, 1)).expect_err(to).to_string();
        assert!(error.starts_with("camchain.yaml:"), "{error}");
        for part in *expected {
            assert!(error.contains(part), "`{to}`: `{error}` does not say `{part}`");
        }
    }
    let zero = KALIBR.replace("-0.37587705", "0.0").replace("0.13680806", "0.0");
    let error = parse(&zero).unwrap_err().to_string();
    assert!(error.contains("T_cn_cnm1: expected a baseline of at least"), "{error}");
    let third = format!("{KALIBR}cam2:\n  camera_model: pinhole\n");
    assert!(parse(&third).unwrap_err().to_string().contains("cam2"));
    assert!(parse("").unwrap_err().to_string().contains("empty"));
    // The line is that of the field.
    let error = parse(&KALIBR.replacen("pinhole", "omni", 1)).unwrap_err().to_string();
    assert!(error.starts_with("camchain.yaml:3: "), "{error}");
}

#[test]
fn a_missing_file_is_named() {
    let error = StereoCalibration::read("/nowhere/camchain.yaml").unwrap_err();
    assert!(matches!(&error, CalibrationError::Read { .. }));
    assert!(error.to_string().starts_with("/nowhere/camchain.yaml: "));
}

#[test]
fn aliases_are_expanded_within_bounds() {
    // As PyYAML writes two references to one list.
    let text = KALIBR
        .replacen("resolution: [1280, 1024]", "resolution: &id001 [1280, 1024]", 1)
        .replacen("resolution: [1280, 1024]", "resolution: *id001", 1);
    assert_eq!(parse(&text).unwrap().right.resolution_px, [1280, 1024]);
    let mut bomb = String::from("a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n");
    for k in 1..12 {
        let list = vec![format!("*a{}", k - 1); 10].join(", ");
        bomb += &format!("a{k}: &a{k} [{list}]\n");
    }
    let error = parse(&bomb).unwrap_err().to_string();
    assert!(error.contains("too many or too deep"), "{error}");
    let deep = format!("a: {}{}", "[".repeat(5000), "]".repeat(5000));
    assert!(parse(&deep).is_err());
}

#[test]
fn undistortion_inverts_distortion() {
    let calibration = rig();
    let mut random = Random(1);
    for _ in 0..2000 {
        let (x, y) = (random.range(-0.36, 0.36), random.range(-0.29, 0.29));
        let [dx, dy] = distorted(calibration.left.radtan, x, y);
        let d = calibration.left.distort(Vector2::new(x, y));
        assert!((d - Vector2::new(dx, dy)).norm() < 1e-15);
        let back = calibration.left.undistort(d).unwrap();
        assert!((back - Vector2::new(x, y)).norm() < 1e-13, "{back}");
    }
    // Beyond the fold there is no inverse, and none is made up.
    let mut folded = calibration.left;
    folded.radtan = [-0.5, 0.0, 0.0, 0.0];
    assert_eq!(folded.undistort(Vector2::new(3.0, 0.0)), None);
}

/// Text of an OpenCV file, as `cv::FileStorage` writes it.
fn opencv_matrix(name: &str, rows: usize, columns: usize, data: &[f64]) -> String {
    let data: Vec<String> = data.iter().map(|v| format!("{v:e}")).collect();
    format!(
        "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {} ]\n",
        data.join(", ")
    )
}

#[test]
fn opencv_files_import() {
    let folder = common::Folder::new("opencv");
    let wanted = rig();
    let mut intrinsics = String::from("%YAML:1.0\n---\n");
    for (k, camera) in [(1, &wanted.left), (2, &wanted.right)] {
        let ([fx, fy], [cx, cy]) = (camera.focal_px, camera.principal_px);
        let m = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
        intrinsics += &opencv_matrix(&format!("M{k}"), 3, 3, &m);
        let mut d = camera.radtan.to_vec();
        d.push(0.0);
        intrinsics += &opencv_matrix(&format!("D{k}"), 1, 5, &d);
    }
    let t = wanted.right_from_left.to_homogeneous();
    let r: Vec<f64> = (0..9).map(|k| t[(k / 3, k % 3)]).collect();
    let mm: Vec<f64> = (0..3).map(|k| t[(k, 3)] * 1000.0).collect();
    let extrinsics = String::from("%YAML:1.0\n---\n")
        + &opencv_matrix("R", 3, 3, &r)
        + &opencv_matrix("T", 3, 1, &mm);
    let (a, b) = (folder.path("intrinsics.yml"), folder.path("extrinsics.yml"));
    std::fs::write(&a, &intrinsics).unwrap();
    std::fs::write(&b, extrinsics).unwrap();
    let options = OpenCvImport { unit_m: 1e-3, resolution_px: Some([1280, 1024]) };
    let got = opencv::import(&[&a, &b], &options).unwrap();
    assert_eq!((&got.left, &got.right), (&wanted.left, &wanted.right));
    let difference = got.right_from_left.to_homogeneous() - t;
    assert!(difference.abs().max() < 1e-12);

    let error = opencv::import(&[&a, &b], &OpenCvImport::default()).unwrap_err().to_string();
    assert!(error.contains("imageSize"), "{error}");
    let error = opencv::import(&[&a], &options).unwrap_err().to_string();
    assert!(error.contains("R: expected"), "{error}");
    let k3 = intrinsics.replacen(", 0e0 ]\nM2", ", 1e-2 ]\nM2", 1);
    assert_ne!(k3, intrinsics);
    std::fs::write(&a, k3).unwrap();
    let error = opencv::import(&[&a, &b], &options).unwrap_err().to_string();
    assert!(error.contains("D1") && error.contains("k3"), "{error}");
}

#[test]
fn ros_camera_info_pairs_import() {
    let folder = common::Folder::new("ros");
    let wanted = rig();
    // A rectification as ROS's calibrator makes one: x along the baseline.
    let geometry = stspp::Rectifier::new(&wanted, stspp::DepthRange::default()).unwrap();
    let rect_left = *geometry.geometry().rect_from_left.matrix();
    let right_from_left = *wanted.right_from_left.rotation.to_rotation_matrix().matrix();
    let rect_right = rect_left * right_from_left.transpose();
    let mut paths = Vec::new();
    let sides = [("left", &wanted.left, rect_left, 0.0), ("right", &wanted.right, rect_right, 1.0)];
    for (name, camera, rect, side) in sides {
        let ([fx, fy], [cx, cy]) = (camera.focal_px, camera.principal_px);
        let [k1, k2, p1, p2] = camera.radtan;
        let rect: Vec<f64> = (0..9).map(|k| rect[(k / 3, k % 3)]).collect();
        let tx = -1800.0 * wanted.baseline_m() * side;
        let text = format!(
            "image_width: 1280\nimage_height: 1024\ncamera_name: {name}\n\
             camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]\n\
             distortion_model: plumb_bob\n\
             distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{k1}, {k2}, {p1}, {p2}, 0]\n\
             rectification_matrix:\n  rows: 3\n  cols: 3\n  data: {rect:?}\n\
             projection_matrix:\n  rows: 3\n  cols: 4\n  \
             data: [1800, 0, 640, {tx}, 0, 1800, 512, 0, 0, 0, 1, 0]\n"
        );
        let path = folder.path(&format!("{name}.yaml"));
        std::fs::write(&path, text).unwrap();
        paths.push(path);
    }
    let got = ros::import(&paths[0], &paths[1]).unwrap();
    assert_eq!((&got.left, &got.right), (&wanted.left, &wanted.right));
    let difference = got.right_from_left.to_homogeneous() - wanted.right_from_left.to_homogeneous();
    assert!(difference.abs().max() < 1e-9, "{difference}");
    let error = ros::import(&paths[1], &paths[0]).unwrap_err().to_string();
    assert!(error.contains("projection_matrix") || error.contains("baseline"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// Mutated files never panic; what they accept is a possible calibration.
    #[test]
    fn mutated_files_never_panic(
        edits in prop::collection::vec((0..KALIBR.len(), any::<u8>(), 0_u8..4), 1..6)
    ) {
        let mut bytes = KALIBR.as_bytes().to_vec();
        for (at, value, kind) in edits {
            let at = at.min(bytes.len().saturating_sub(1));
            match kind {
                0 => bytes[at] = value & 0x7f,
                1 => { bytes.remove(at); }
                2 => bytes.insert(at, b" -:[]{}&*!|>'\"#%@`,.0\n"[usize::from(value) % 22]),
                _ => bytes.truncate(at + 1),
            }
            if bytes.is_empty() { break; }
        }
        let text = String::from_utf8_lossy(&bytes);
        if let Ok(calibration) = parse(&text) {
            prop_assert!(calibration.validate().is_ok());
        }
    }

    /// Any bytes at all.
    #[test]
    fn arbitrary_text_never_panics(text in "\\PC{0,200}") {
        let _ = parse(&text);
    }
}
