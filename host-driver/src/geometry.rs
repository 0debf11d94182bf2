//! The geometry of a rectified stereo pair: pixels and disparities to points and back.

use nalgebra::{Point3, Rotation3};
use stspp_matcher::DisparityRange;

/// Two virtual pinhole cameras with parallel axes, equal focal lengths and corresponding rows, on
/// canvases of one size. The principal points differ in x, so that toed-in cameras lose no pixel.
///
/// The rectified frame has its origin at the left camera's centre, like the left camera's own frame,
/// and differs from it by a rotation only.
#[derive(Debug, Clone, PartialEq)]
pub struct RectifiedGeometry {
    /// Rotation from the left camera's (cam0, unrectified) frame to the rectified frame.
    pub rect_from_left: Rotation3<f64>,
    /// Focal length of both virtual cameras in pixels.
    pub focal_px: f64,
    /// Principal point of the left canvas, x.
    pub cx_left_px: f64,
    /// Principal point of the right canvas, x.
    pub cx_right_px: f64,
    /// Principal point of both canvases, y.
    pub cy_px: f64,
    /// Distance of the camera centres in metres.
    pub baseline_m: f64,
    /// Width of both canvases in pixels.
    pub width: usize,
    /// Height of both canvases in pixels.
    pub height: usize,
}

impl RectifiedGeometry {
    /// Disparity of a point at infinity: the difference of the principal points.
    pub fn disparity_at_infinity_px(&self) -> f64 {
        self.cx_left_px - self.cx_right_px
    }

    /// The point, in the left camera's frame, that is seen at (`x_px`, `y_px`) of the left canvas with
    /// `disparity_px`. `None` when the disparity is not that of a point in front of the cameras.
    pub fn point_left_m(&self, x_px: f64, y_px: f64, disparity_px: f64) -> Option<Point3<f64>> {
        let parallax_px = disparity_px - self.disparity_at_infinity_px();
        if parallax_px.is_nan() || parallax_px <= 0.0 {
            return None;
        }
        let scale = self.baseline_m / parallax_px;
        let point_rect = Point3::new(
            (x_px - self.cx_left_px) * scale,
            (y_px - self.cy_px) * scale,
            self.focal_px * scale,
        );
        Some(self.rect_from_left.inverse_transform_point(&point_rect))
    }

    /// Depth of that point: its z in the left camera's (unrectified) frame, in metres.
    pub fn depth_left_m(&self, x_px: f64, y_px: f64, disparity_px: f64) -> Option<f64> {
        self.point_left_m(x_px, y_px, disparity_px).map(|point| point.z)
    }

    /// Where a point of the left camera's frame appears: (x on the left canvas, row, disparity).
    /// `None` behind the cameras.
    pub fn project_left_m(&self, point_left_m: &Point3<f64>) -> Option<(f64, f64, f64)> {
        let p = self.rect_from_left * point_left_m;
        if p.z.is_nan() || p.z <= 0.0 {
            return None;
        }
        Some((
            self.cx_left_px + self.focal_px * p.x / p.z,
            self.cy_px + self.focal_px * p.y / p.z,
            self.disparity_at_infinity_px() + self.focal_px * self.baseline_m / p.z,
        ))
    }

    /// All disparities of points whose depth in the left camera's frame is in the given range,
    /// anywhere on the left canvas, rounded outwards.
    ///
    /// # Errors
    /// `None` unless 0 < `depth_min_m` < `depth_max_m`, both finite.
    pub fn disparity_range(&self, depth_min_m: f64, depth_max_m: f64) -> Option<DisparityRange> {
        if !(0.0 < depth_min_m && depth_min_m < depth_max_m && depth_max_m.is_finite()) {
            return None;
        }
        let (w, h) = ((self.width.max(1) - 1) as f64, (self.height.max(1) - 1) as f64);
        let mut range = (f64::INFINITY, f64::NEG_INFINITY);
        for (x_px, y_px) in [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)] {
            // A ray has z_left = slope * z_rect; the slope is affine in the pixel, so that its
            // extremes are at the corners.
            let ray_left = self.rect_from_left.inverse_transform_vector(&nalgebra::Vector3::new(
                (x_px - self.cx_left_px) / self.focal_px,
                (y_px - self.cy_px) / self.focal_px,
                1.0,
            ));
            if ray_left.z <= 0.0 {
                return None;
            }
            for depth_m in [depth_min_m, depth_max_m] {
                let parallax_px = self.focal_px * self.baseline_m * ray_left.z / depth_m;
                let disparity_px = self.disparity_at_infinity_px() + parallax_px;
                range = (range.0.min(disparity_px), range.1.max(disparity_px));
            }
        }
        Some(DisparityRange { min_px: range.0.floor() as i32, max_px: range.1.ceil() as i32 })
    }
}
