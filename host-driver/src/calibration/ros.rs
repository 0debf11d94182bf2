//! Pairs of ROS camera_info YAML files, as `camera_calibration` writes them.
//!
//! The pose is recovered from the rectification: a point of the left camera is seen by the right one
//! at R_right^T (R_left X + [P_right(0,3) / P_right(0,0), 0, 0]).

use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::opencv::{RADTAN_ONLY, radtan};
use super::yaml::{self, Field};
use super::{CalibrationError, CameraIntrinsics, StereoCalibration, isometry};

/// Imports the left and the right camera_info file.
///
/// # Errors
/// Names file, line, field and expectation.
pub fn import(left: &Path, right: &Path) -> Result<StereoCalibration, CalibrationError> {
    let (left_node, right_node) = (yaml::read(left)?, yaml::read(right)?);
    let (left, right) = (Field::root(left, &left_node), Field::root(right, &right_node));
    let (rect_left, rect_right) = (rectification(&left)?, rectification(&right)?);
    let p_field = right.get("projection_matrix", "a 3x4 matrix")?;
    let p: [f64; 12] = p_field.get("data", "12 numbers")?.array("12 numbers")?;
    if p[0] <= 0.0 {
        return Err(p_field.error("a positive focal length", p[0]));
    }
    let rotation = rect_right.transpose() * rect_left;
    let translation_m = rect_right.transpose() * Vector3::new(p[3] / p[0], 0.0, 0.0);
    let right_from_left = isometry("rectification_matrix", rotation, translation_m)
        .map_err(|error| right.wrap(error))?;
    let calibration = StereoCalibration {
        left: camera(&left)?,
        right: camera(&right)?,
        right_from_left,
        temperature_c: None,
        date: None,
    };
    calibration.validate().map_err(|error| p_field.wrap(error))?;
    Ok(calibration)
}

fn rectification(root: &Field<'_>) -> Result<Matrix3<f64>, CalibrationError> {
    let field = root.get("rectification_matrix", "a 3x3 rotation")?;
    let data: [f64; 9] = field.get("data", "9 numbers")?.array("9 numbers")?;
    let matrix = Matrix3::from_row_slice(&data);
    isometry("rectification_matrix", matrix, Vector3::zeros())
        .map(|pose| pose.rotation.to_rotation_matrix().into_inner())
        .map_err(|error| field.wrap(error))
}

fn camera(root: &Field<'_>) -> Result<CameraIntrinsics, CalibrationError> {
    let expected = "whole pixels";
    let resolution_px = [
        root.get("image_width", expected)?.size(expected)?,
        root.get("image_height", expected)?.size(expected)?,
    ];
    let field = root.get("camera_matrix", "a 3x3 matrix")?;
    let k: [f64; 9] = field.get("data", "9 numbers")?.array("9 numbers")?;
    let model = root.get("distortion_model", "`plumb_bob`")?;
    match model.text("`plumb_bob`")? {
        "plumb_bob" => {}
        other => return Err(model.error("`plumb_bob`", format!("`{other}`"))),
    }
    let d_field = root.get("distortion_coefficients", "a matrix")?;
    let d = d_field.get("data", "5 numbers")?.numbers("5 numbers")?;
    let camera = CameraIntrinsics {
        focal_px: [k[0], k[4]],
        principal_px: [k[2], k[5]],
        radtan: radtan(&d).map_err(|got| d_field.error(RADTAN_ONLY, got))?,
        resolution_px,
    };
    camera.validate("camera_matrix").map_err(|error| field.wrap(error))?;
    Ok(camera)
}
