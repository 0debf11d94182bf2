//! What a calibration says of a pair of pixels: whether they can show one point, and which.

use nalgebra::{Isometry3, Matrix3, Point3, Vector2, Vector3};

use super::StereoCalibration;

/// The essential matrix of a rig: x_right^T E x_left = 0 for rays that meet.
pub fn essential(right_from_left: &Isometry3<f64>) -> Matrix3<f64> {
    right_from_left.translation.vector.cross_matrix()
        * right_from_left.rotation.to_rotation_matrix().matrix()
}

impl StereoCalibration {
    /// How far the right pixel is from the epipolar line of the left one, in pixels: the vertical
    /// disparity that is left after rectification. Positive when the right pixel is below the line.
    /// `None` where a lens model has no inverse.
    pub fn epipolar_px(&self, left_px: Vector2<f64>, right_px: Vector2<f64>) -> Option<f64> {
        let left = self.left.normalised_of_pixel(left_px)?;
        let right = self.right.normalised_of_pixel(right_px)?;
        let line = essential(&self.right_from_left) * left.push(1.0);
        let distance = right.push(1.0).dot(&line) / line.xy().norm();
        // The line's normal points up or down with the sign of its y.
        Some(distance.copysign(distance * line.y) * self.right.focal_px[1])
    }

    /// The point, in the left camera's frame, in the middle between the rays of two pixels where they
    /// are closest. `None` for rays that do not meet in front of the cameras.
    pub fn triangulate(
        &self,
        left_px: Vector2<f64>,
        right_px: Vector2<f64>,
    ) -> Option<Point3<f64>> {
        let left_from_right = self.right_from_left.inverse();
        let a: Vector3<f64> = self.left.normalised_of_pixel(left_px)?.push(1.0);
        let b = left_from_right.rotation * self.right.normalised_of_pixel(right_px)?.push(1.0);
        let base = left_from_right.translation.vector;
        // Closest points s a and base + t b: their difference is perpendicular to both rays.
        let (aa, ab, bb) = (a.dot(&a), a.dot(&b), b.dot(&b));
        let (ac, bc) = (a.dot(&base), b.dot(&base));
        let determinant = aa * bb - ab * ab;
        if determinant <= 1e-12 * aa * bb {
            return None;
        }
        let s = (ac * bb - bc * ab) / determinant;
        let t = (ac * ab - bc * aa) / determinant;
        (s > 0.0 && t > 0.0).then(|| Point3::from((a * s + base + b * t) / 2.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CameraIntrinsics;

    #[test]
    fn true_pixels_meet_and_a_shifted_one_is_off_by_its_shift() {
        let camera = CameraIntrinsics {
            focal_px: [1860.0, 1855.0],
            principal_px: [640.0, 512.0],
            radtan: [-0.1, 0.08, 2e-4, -3e-4],
            resolution_px: [1280, 1024],
        };
        let calibration = StereoCalibration {
            left: camera.clone(),
            right: camera,
            right_from_left: Isometry3::new(
                Vector3::new(-0.39, 0.001, 0.07),
                Vector3::new(0.002, 0.34, -0.003),
            ),
            temperature_c: None,
            date: None,
        };
        let point = Point3::new(0.25, 0.05, 1.3);
        let left = calibration.left.project(&point).unwrap();
        let right = calibration.right.project(&(calibration.right_from_left * point)).unwrap();
        assert!(calibration.epipolar_px(left, right).unwrap().abs() < 1e-9);
        assert!((calibration.triangulate(left, right).unwrap() - point).norm() < 1e-9);
        for shift in [0.5, -0.5] {
            let moved = right + Vector2::new(0.0, shift);
            let found = calibration.epipolar_px(left, moved).unwrap();
            assert!((found - shift).abs() < 0.02, "{found}");
        }
    }
}
