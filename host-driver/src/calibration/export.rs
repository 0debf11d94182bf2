//! Calibrations for other programs: OpenCV's stereo YAML and pairs of ROS camera_info files.

use std::fmt::Write as _;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::text::list;
use super::{CameraIntrinsics, StereoCalibration};
use crate::rectify::{RectifyError, rect_from_left};

/// OpenCV's stereo YAML: `M1 D1 M2 D2 R T` and the image size; lengths in metres.
pub fn opencv_text(calibration: &StereoCalibration) -> String {
    let mut text = String::from("%YAML:1.0\n---\n");
    let mut matrix = |name: &str, rows: usize, columns: usize, values: Vec<f64>| {
        let _ = writeln!(
            text,
            "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {}",
            list(values)
        );
    };
    for (suffix, camera) in [("1", &calibration.left), ("2", &calibration.right)] {
        matrix(&format!("M{suffix}"), 3, 3, row_major(&camera_matrix(camera)));
        let mut coefficients = camera.radtan.to_vec();
        // Five, with k3: older readers expect them.
        coefficients.push(0.0);
        matrix(&format!("D{suffix}"), 1, 5, coefficients);
    }
    let rotation = calibration.right_from_left.rotation.to_rotation_matrix();
    matrix("R", 3, 3, row_major(rotation.matrix()));
    matrix("T", 3, 1, calibration.right_from_left.translation.vector.iter().copied().collect());
    let [width, height] = calibration.left.resolution_px;
    let _ = writeln!(text, "imageSize: [{width}, {height}]");
    text
}

/// ROS camera_info files of the left and the right camera, as `camera_calibration` writes them.
///
/// The rectified cameras have the raw images' size, the mean focal length, and the raw image's middle
/// in their middle; their principal points differ when the cameras are toed in.
///
/// # Errors
/// For cameras that cannot be rectified.
pub fn ros_texts(calibration: &StereoCalibration) -> Result<[String; 2], RectifyError> {
    let rect_from_left = rect_from_left(calibration)?;
    let left_from_right = calibration.right_from_left.rotation.inverse().to_rotation_matrix();
    let cameras = [
        (&calibration.left, rect_from_left, 0.0),
        (&calibration.right, rect_from_left * left_from_right, calibration.baseline_m()),
    ];
    let focal = cameras.iter().flat_map(|(camera, ..)| camera.focal_px).sum::<f64>() / 4.0;
    let middle_y =
        |camera: &CameraIntrinsics, rotation: &Rotation3<f64>| middle(camera, rotation, focal)[1];
    // Rows correspond: one principal point in y.
    let cy = cameras.iter().map(|(camera, r, _)| middle_y(camera, r)).sum::<f64>() / 2.0;
    Ok(["left", "right"].map(|name| {
        let (camera, rotation, x_m) = &cameras[usize::from(name == "right")];
        let cx = middle(camera, rotation, focal)[0];
        let [width, height] = camera.resolution_px;
        let projection = [focal, 0.0, cx, -focal * x_m, 0.0, focal, cy, 0.0, 0.0, 0.0, 1.0, 0.0];
        let mut text =
            format!("image_width: {width}\nimage_height: {height}\ncamera_name: {name}\n");
        let mut matrix = |name: &str, rows: usize, columns: usize, values: Vec<f64>| {
            let _ = writeln!(
                text,
                "{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {}",
                list(values)
            );
        };
        matrix("camera_matrix", 3, 3, row_major(&camera_matrix(camera)));
        let mut coefficients = camera.radtan.to_vec();
        coefficients.push(0.0);
        matrix("distortion_coefficients", 1, 5, coefficients);
        matrix("rectification_matrix", 3, 3, row_major(rotation.matrix()));
        matrix("projection_matrix", 3, 4, projection.to_vec());
        let _ = writeln!(text, "distortion_model: plumb_bob");
        text
    }))
}

/// Principal point that puts the raw image's middle into the rectified image's middle.
fn middle(camera: &CameraIntrinsics, rotation: &Rotation3<f64>, focal: f64) -> [f64; 2] {
    let half = camera.resolution_px.map(|size| (size as f64 - 1.0) / 2.0);
    let ray = camera.normalised_of_pixel(half.into()).unwrap_or_default();
    let ray = rotation * Vector3::new(ray.x, ray.y, 1.0);
    [half[0] - focal * ray.x / ray.z, half[1] - focal * ray.y / ray.z]
}

fn camera_matrix(camera: &CameraIntrinsics) -> Matrix3<f64> {
    let ([fu, fv], [pu, pv]) = (camera.focal_px, camera.principal_px);
    Matrix3::new(fu, 0.0, pu, 0.0, fv, pv, 0.0, 0.0, 1.0)
}

fn row_major(matrix: &Matrix3<f64>) -> Vec<f64> {
    matrix.transpose().iter().copied().collect()
}
