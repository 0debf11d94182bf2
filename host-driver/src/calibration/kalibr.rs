//! Kalibr's `camchain.yaml`.
//!
//! `cam0` and `cam1` with `camera_model: pinhole`, `intrinsics [fu, fv, pu, pv]`,
//! `distortion_model: radtan` (or `none`), `distortion_coeffs [k1, k2, p1, p2]`,
//! `resolution [w, h]`; `cam1.T_cn_cnm1` maps cam0's coordinates to cam1's, in metres. Fields that
//! Kalibr adds for other purposes are ignored. Our own optional fields, `temperature_c` and
//! `calibration_date`, are in `cam0`, because Kalibr counts the document's keys as cameras.

use std::fmt::Write as _;
use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::text::{list, number};
use super::yaml::{self, Field, Node};
use super::{CalibrationError, CameraIntrinsics, FieldError, StereoCalibration, isometry};
use crate::export::atomic;

/// Reads and checks a camchain.yaml.
///
/// # Errors
/// Names file, line, field and expectation.
pub fn read(path: &Path) -> Result<StereoCalibration, CalibrationError> {
    from_node(path, &yaml::read(path)?)
}

/// Parses the text of a camchain.yaml; `path` is for error messages.
///
/// # Errors
/// As [`read`].
pub fn parse(path: &Path, text: &str) -> Result<StereoCalibration, CalibrationError> {
    from_node(path, &yaml::parse(path, text)?)
}

fn from_node(path: &Path, node: &Node) -> Result<StereoCalibration, CalibrationError> {
    let root = Field::root(path, node);
    let cam0 = root.get("cam0", "the left camera")?;
    let cam1 = root.get("cam1", "the right camera")?;
    if let Some(cam2) = root.find("cam2") {
        return Err(cam2.error("two cameras, cam0 and cam1", "a third one"));
    }
    let left = camera(&cam0)?;
    let right = camera(&cam1)?;
    let pose = cam1.get("T_cn_cnm1", "a 4x4 matrix that maps cam0's coordinates to cam1's")?;
    let right_from_left = transform(&pose)?;
    let temperature_c = match cam0.find("temperature_c") {
        Some(field) => Some(field.number("a temperature in degrees Celsius")?),
        None => None,
    };
    let date = match cam0.find("calibration_date") {
        Some(field) => Some(field.text("a date")?.to_owned()),
        None => None,
    };
    let calibration = StereoCalibration { left, right, right_from_left, temperature_c, date };
    calibration.validate().map_err(|error| {
        // Shows the line of the field that the error is about.
        let (camera, key) = error.field.split_once('.').unwrap_or((&error.field, ""));
        let camera = root.find(camera).unwrap_or_else(|| root.clone());
        camera.find(key).unwrap_or(camera).wrap(error)
    })?;
    Ok(calibration)
}

fn camera(field: &Field<'_>) -> Result<CameraIntrinsics, CalibrationError> {
    let model = field.get("camera_model", "`pinhole`")?;
    match model.text("`pinhole`")? {
        "pinhole" => {}
        other => return Err(model.error("`pinhole`", format!("`{other}`"))),
    }
    let expected = "[fu, fv, pu, pv] in pixels";
    let [fu, fv, pu, pv] = field.get("intrinsics", expected)?.array(expected)?;
    let expected = "`radtan` or `none`";
    let model = field.get("distortion_model", expected)?;
    let radtan = match model.text(expected)? {
        "radtan" => {
            let expected = "four numbers [k1, k2, p1, p2]";
            field.get("distortion_coeffs", expected)?.array(expected)?
        }
        "none" => [0.0; 4],
        other => return Err(model.error(expected, format!("`{other}`"))),
    };
    let expected = "[width, height] in whole pixels";
    let resolution = field.get("resolution", expected)?;
    let sizes = resolution.items(expected)?;
    let [w, h] = &sizes[..] else {
        return Err(resolution.error(expected, format!("a list of {}", sizes.len())));
    };
    let resolution_px = [w.size("whole pixels")?, h.size("whole pixels")?];
    Ok(CameraIntrinsics { focal_px: [fu, fv], principal_px: [pu, pv], radtan, resolution_px })
}

fn transform(field: &Field<'_>) -> Result<nalgebra::Isometry3<f64>, CalibrationError> {
    let expected = "four rows of four numbers";
    let rows = field.items(expected)?;
    if rows.len() != 4 {
        return Err(field.error(expected, format!("{} rows", rows.len())));
    }
    let mut m = [[0.0; 4]; 4];
    for (row, values) in rows.iter().zip(&mut m) {
        *values = row.array("four numbers")?;
    }
    if m[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| (a - b).abs() > 1e-9) {
        return Err(rows[3].error("[0, 0, 0, 1]", format!("{:?}", m[3])));
    }
    let rotation = Matrix3::from_fn(|row, column| m[row][column]);
    isometry("cam1.T_cn_cnm1", rotation, Vector3::new(m[0][3], m[1][3], m[2][3]))
        .map_err(|error| field.wrap(error))
}

/// Text of a camchain.yaml; reading it back gives the same calibration.
pub fn to_text(calibration: &StereoCalibration) -> String {
    let mut text = String::from("# Stereo calibration in Kalibr's format; lengths in metres.\n");
    let mut camera = |name: &str, camera: &CameraIntrinsics, extra: &str| {
        let ([fu, fv], [pu, pv]) = (camera.focal_px, camera.principal_px);
        let ([k1, k2, p1, p2], [w, h]) = (camera.radtan, camera.resolution_px);
        let intrinsics = list([fu, fv, pu, pv]);
        let coefficients = list([k1, k2, p1, p2]);
        let _ = write!(
            text,
            "{name}:\n  camera_model: pinhole\n  intrinsics: {intrinsics}\n  \
             distortion_model: radtan\n  distortion_coeffs: {coefficients}\n  \
             resolution: [{w}, {h}]\n{extra}"
        );
    };
    let mut extra = String::new();
    if let Some(temperature_c) = calibration.temperature_c {
        let _ = writeln!(extra, "  temperature_c: {}", number(temperature_c));
    }
    if let Some(date) = &calibration.date {
        let _ = writeln!(extra, "  calibration_date: '{}'", date.replace('\'', "''"));
    }
    camera("cam0", &calibration.left, &extra);
    let m = calibration.right_from_left.to_homogeneous();
    let mut extra = String::from("  T_cn_cnm1:\n");
    for row in m.row_iter() {
        let _ = writeln!(extra, "  - {}", list(row.iter().copied()));
    }
    camera("cam1", &calibration.right, &extra);
    text
}

/// Writes a camchain.yaml; the file appears whole or not at all.
///
/// # Errors
/// [`CalibrationError::Write`]; [`CalibrationError::Field`] for a calibration that could not be read
/// back.
pub fn write(calibration: &StereoCalibration, path: &Path) -> Result<(), CalibrationError> {
    let placed =
        |error: FieldError| CalibrationError::Field { path: path.to_owned(), line: 0, error };
    calibration.validate().map_err(placed)?;
    atomic::write_file(path, |out| out.write_all(to_text(calibration).as_bytes()))
        .map_err(|source| CalibrationError::Write { path: path.to_owned(), source })
}
