//! Calibration of the stereo rig: two distorted pinhole cameras and their relative pose.

use nalgebra::Isometry3;

/// A pinhole camera with radial-tangential distortion.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraIntrinsics {
    /// Focal lengths [x, y] in pixels.
    pub focal_px: [f64; 2],
    /// Principal point [x, y] in pixels; the centre of the first pixel is (0, 0).
    pub principal_px: [f64; 2],
    /// Distortion coefficients [k1, k2, p1, p2] of the Brown model.
    pub radtan: [f64; 4],
    /// Image size [width, height] in pixels.
    pub resolution_px: [usize; 2],
}

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
    /// Distance of the camera centres in metres.
    pub fn baseline_m(&self) -> f64 {
        self.right_from_left.translation.vector.norm()
    }
}
