//! Calibration of the stereo rig: two distorted pinhole cameras and their relative pose.
//!
//! The product's format is Kalibr's `camchain.yaml` ([`kalibr`]); OpenCV's stereo YAML ([`opencv`])
//! and pairs of ROS camera_info files ([`ros`]) are imported and [exported](export).

mod camera;
mod epipolar;
mod error;
pub mod export;
pub mod kalibr;
pub mod opencv;
pub mod ros;
mod text;
mod yaml;

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

pub use camera::{CameraIntrinsics, Projection};
pub use epipolar::essential;
pub use error::{CalibrationError, FieldError};

/// Largest entry of R^T R - 1 that still counts as rounding of a printed rotation.
const ROTATION_TOLERANCE: f64 = 2e-3;

/// Calibration of the sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct StereoCalibration {
    /// Camera 0.
    pub left: CameraIntrinsics,
    /// Camera 1.
    pub right: CameraIntrinsics,
    /// Maps points of the left camera's frame to the right camera's (metres).
    pub right_from_left: Isometry3<f64>,
    /// Sensor temperature at calibration, where known.
    pub temperature_c: Option<f64>,
    /// Date of the calibration (ISO 8601), where known.
    pub date: Option<String>,
}

impl StereoCalibration {
    /// Reads a Kalibr `camchain.yaml` and checks that it is physically possible.
    ///
    /// # Errors
    /// Names file, line, field and expectation.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, CalibrationError> {
        kalibr::read(path.as_ref())
    }

    /// Writes a Kalibr `camchain.yaml`; the file appears whole or not at all.
    ///
    /// # Errors
    /// [`CalibrationError::Write`].
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), CalibrationError> {
        kalibr::write(self, path.as_ref())
    }

    /// Distance of the camera centres in metres.
    pub fn baseline_m(&self) -> f64 {
        self.right_from_left.translation.vector.norm()
    }

    /// Checks that a stereo rig can have these values, whatever file they came from.
    ///
    /// # Errors
    /// The first field that is wrong, by its name in camchain.yaml.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.left.validate("cam0")?;
        self.right.validate("cam1")?;
        if self.left.resolution_px != self.right.resolution_px {
            return Err(FieldError::new(
                "cam1.resolution",
                format!("cam0's, {:?}", self.left.resolution_px),
                format!("{:?}", self.right.resolution_px),
            ));
        }
        let translation_m = self.right_from_left.translation.vector;
        let rotation = self.right_from_left.rotation.coords;
        if translation_m.iter().chain(rotation.iter()).any(|v| !v.is_finite()) {
            return Err(FieldError::new("cam1.T_cn_cnm1", "finite numbers", "NaN or infinity"));
        }
        let baseline_m = self.baseline_m();
        if baseline_m < 1e-3 {
            return Err(FieldError::new(
                "cam1.T_cn_cnm1",
                "a baseline of at least 0.001 m",
                format!("{baseline_m} m"),
            ));
        }
        if baseline_m > 10.0 {
            return Err(FieldError::new(
                "cam1.T_cn_cnm1",
                "a translation in metres, at most 10 m",
                format!("a baseline of {baseline_m} (millimetres?)"),
            ));
        }
        let right_in_left_m = self.right_from_left.inverse().translation.vector;
        if right_in_left_m.x < 0.5 * baseline_m {
            return Err(FieldError::new(
                "cam1.T_cn_cnm1",
                "cam1 to the right of cam0 (a negative x translation; swap the cameras otherwise)",
                format!("cam1 at {:?} m in cam0's frame", right_in_left_m.as_slice()),
            ));
        }
        let axis_right = self.right_from_left.inverse_transform_vector(&Vector3::z());
        if axis_right.z < 0.5 {
            return Err(FieldError::new(
                "cam1.T_cn_cnm1",
                "optical axes within 60 degrees of each other",
                format!("{:.1} degrees", axis_right.z.clamp(-1.0, 1.0).acos().to_degrees()),
            ));
        }
        Ok(())
    }
}

/// The pose with the rotation nearest to `rotation`, which files print with few digits.
fn isometry(
    field: &str,
    rotation: Matrix3<f64>,
    translation_m: Vector3<f64>,
) -> Result<Isometry3<f64>, FieldError> {
    let deviation = (rotation.transpose() * rotation - Matrix3::identity()).abs().max();
    let determinant = rotation.determinant();
    if deviation.is_nan() || deviation > ROTATION_TOLERANCE || determinant <= 0.0 {
        return Err(FieldError::new(
            field,
            "a rotation (orthonormal, determinant +1)",
            format!("determinant {determinant:.4}, R^T R off the identity by {deviation:.2e}"),
        ));
    }
    let svd = rotation.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Err(FieldError::new(field, "a rotation", "a matrix without decomposition"));
    };
    let rotation = Rotation3::from_matrix_unchecked(u * v_t);
    Ok(Isometry3::from_parts(
        Translation3::from(translation_m),
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}
