//! OpenCV's stereo YAML, as its stereo calibration sample and many tools after it write it.
//!
//! Matrices `M1`, `D1`, `M2`, `D2`, `R`, `T` (also under the names `K1`, `cameraMatrix1`,
//! `distCoeffs1` ...), in one file or in two (intrinsics and extrinsics).

use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::yaml::{self, Field, Node};
use super::{CalibrationError, CameraIntrinsics, FieldError, StereoCalibration, isometry};

/// What such files leave out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OpenCvImport {
    /// Metres per unit of the file's `T`: the unit of the board's square size, often 0.001.
    pub unit_m: f64,
    /// Image size, for files that do not state it.
    pub resolution_px: Option<[usize; 2]>,
}

impl Default for OpenCvImport {
    fn default() -> Self {
        Self { unit_m: 1.0, resolution_px: None }
    }
}

/// Imports one file, or intrinsics and extrinsics from two.
///
/// # Errors
/// Names file, line, field and expectation.
pub fn import(
    paths: &[&Path],
    options: &OpenCvImport,
) -> Result<StereoCalibration, CalibrationError> {
    let nodes = paths.iter().map(|path| yaml::read(path)).collect::<Result<Vec<_>, _>>()?;
    let files: Vec<(&Path, &Node)> = paths.iter().copied().zip(&nodes).collect();
    let size = resolution(&files, options)?;
    let left = camera(&files, "1", size)?;
    let right = camera(&files, "2", size)?;
    let (r_field, r) = matrix(&files, &["R"], &[9])?;
    let (t_field, t) = matrix(&files, &["T"], &[3])?;
    let translation_m = Vector3::new(t[0], t[1], t[2]) * options.unit_m;
    let right_from_left = isometry("R", Matrix3::from_row_slice(&r), translation_m)
        .map_err(|error| r_field.wrap(error))?;
    let calibration =
        StereoCalibration { left, right, right_from_left, temperature_c: None, date: None };
    calibration.validate().map_err(|error| t_field.wrap(error))?;
    Ok(calibration)
}

fn missing(files: &[(&Path, &Node)], names: &[&str], expected: &str) -> CalibrationError {
    let paths: Vec<_> = files.iter().map(|(path, _)| path.display().to_string()).collect();
    let error = FieldError::new(names.join(" or "), expected, "nothing (missing)");
    CalibrationError::Field { path: paths.join(" and ").into(), line: 1, error }
}

fn find<'a>(files: &[(&'a Path, &'a Node)], names: &[&str]) -> Option<Field<'a>> {
    files.iter().find_map(|(path, node)| {
        let root = Field::root(path, node);
        names.iter().find_map(|name| root.find(name))
    })
}

/// The numbers of a matrix with one of the allowed element counts.
fn matrix<'a>(
    files: &[(&'a Path, &'a Node)],
    names: &[&str],
    counts: &[usize],
) -> Result<(Field<'a>, Vec<f64>), CalibrationError> {
    let expected = format!("a matrix of {counts:?} numbers");
    let field = find(files, names).ok_or_else(|| missing(files, names, &expected))?;
    let data = field.get("data", &expected)?;
    let numbers = data.numbers(&expected)?;
    if !counts.contains(&numbers.len()) {
        return Err(data.error(expected, format!("{} numbers", numbers.len())));
    }
    Ok((field, numbers))
}

fn resolution(
    files: &[(&Path, &Node)],
    options: &OpenCvImport,
) -> Result<[usize; 2], CalibrationError> {
    let expected = "[width, height] in whole pixels";
    if let Some(field) = find(files, &["imageSize", "image_size", "size", "resolution"]) {
        let items = field.items(expected)?;
        let [w, h] = &items[..] else {
            return Err(field.error(expected, format!("a list of {}", items.len())));
        };
        return Ok([w.size(expected)?, h.size(expected)?]);
    }
    let width = find(files, &["image_width", "imageWidth", "width"]);
    let height = find(files, &["image_height", "imageHeight", "height"]);
    if let (Some(w), Some(h)) = (width, height) {
        return Ok([w.size("whole pixels")?, h.size("whole pixels")?]);
    }
    let expected = "the image size, in the file or as an option";
    options.resolution_px.ok_or_else(|| missing(files, &["imageSize"], expected))
}

fn camera(
    files: &[(&Path, &Node)],
    suffix: &str,
    resolution_px: [usize; 2],
) -> Result<CameraIntrinsics, CalibrationError> {
    let name_all = |stems: [&str; 4]| stems.map(|stem| format!("{stem}{suffix}"));
    let k_names = name_all(["M", "K", "cameraMatrix", "camera_matrix_"]);
    let d_names = name_all(["D", "distCoeffs", "dist_coeffs_", "distortion_coefficients_"]);
    let k_names = k_names.each_ref().map(String::as_str);
    let d_names = d_names.each_ref().map(String::as_str);
    let (k_field, k) = matrix(files, &k_names, &[9])?;
    let (d_field, d) = matrix(files, &d_names, &[4, 5, 8, 12, 14])?;
    let radtan = radtan(&d).map_err(|got| d_field.error(RADTAN_ONLY, got))?;
    let camera = CameraIntrinsics {
        focal_px: [k[0], k[4]],
        principal_px: [k[2], k[5]],
        radtan,
        resolution_px,
    };
    if k[1].abs() > 1e-9 {
        return Err(k_field.error("a camera matrix without skew", format!("skew {}", k[1])));
    }
    camera.validate(k_names[0]).map_err(|error| k_field.wrap(error))?;
    Ok(camera)
}

/// What is asked of distortion coefficients in OpenCV's order.
pub(super) const RADTAN_ONLY: &str =
    "k1, k2, p1, p2 and zeros (calibrate with k3 fixed at 0 and without the rational model)";

/// The first four coefficients, when the others are zero.
pub(super) fn radtan(coefficients: &[f64]) -> Result<[f64; 4], String> {
    match coefficients {
        [k1, k2, p1, p2, rest @ ..] if rest.iter().all(|k| *k == 0.0) => Ok([*k1, *k2, *p1, *p2]),
        _ => Err(format!("{coefficients:?}")),
    }
}
