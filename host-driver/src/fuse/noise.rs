//! The noise model: how exact a point is along its surface's normal.
//!
//! A stereo sensor's disparity noise is about the same everywhere; depth follows by
//! dz = z^2 / (f b) dd. Across a surface that is seen at an angle, the subset is foreshortened: its
//! noise and its bias at curvature grow with 1 / cos.

use nalgebra::{Point3, Vector3};

/// Focal length times baseline of the sensor as it is built, px m: relative weights need no better.
const FOCAL_BASELINE_PX_M: f64 = 1860.0 * 0.4;
/// Disparity noise of a good point, px.
const DISPARITY_PX: f64 = 0.008;

/// One standard deviation along the normal, metres, of a point seen from the origin. `incidence_cos` is
/// the cosine of the angle between the normal and the line of sight, `zncc` its similarity.
pub fn sigma_m(point_m: &Point3<f64>, incidence_cos: f64, zncc: f32) -> f64 {
    let depth = dz_m(point_m.z);
    // A ZNCC of 1 - e has noise in proportion to sqrt(e) (paper eq 10: ZNSSD is twice that); 0.98 is
    // common on a matt surface.
    let similarity = (f64::from(1.0 - zncc).clamp(0.005, 0.5) / 0.02).sqrt();
    depth * similarity.max(0.5) / incidence_cos.clamp(0.05, 1.0)
}

/// Depth noise at a depth, metres.
pub fn dz_m(depth_m: f64) -> f64 {
    depth_m * depth_m / FOCAL_BASELINE_PX_M * DISPARITY_PX
}

/// Cosine of the angle between a surface's normal and the line of sight from the origin.
pub fn incidence_cos(point_m: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
    let length = point_m.coords.norm();
    if length > 0.0 { (point_m.coords.dot(normal) / length).abs() } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_grows_with_the_square_of_the_distance_and_with_the_angle() {
        let at = |z: f64, cos: f64, zncc: f32| sigma_m(&Point3::new(0.0, 0.0, z), cos, zncc);
        assert!((at(2.0, 1.0, 0.98) / at(1.0, 1.0, 0.98) - 4.0).abs() < 1e-9);
        assert!((at(1.0, 0.5, 0.98) / at(1.0, 1.0, 0.98) - 2.0).abs() < 1e-9);
        assert!(at(1.0, 1.0, 0.9) > at(1.0, 1.0, 0.98));
        // What the simulated sensor's planes show at 1 m is of this order (docs/error-model.md).
        assert!((5e-6..2e-5).contains(&at(1.0, 1.0, 0.98)));
    }
}
