//! The truth behind every pixel of a rectified canvas.

use nalgebra::Vector3;
use rayon::prelude::*;
use stspp_hil_sim::world::{Camera, World};
use stspp_matcher::Image;

use crate::RectifiedGeometry;

/// What the left canvas's pixels see.
#[derive(Debug, Clone)]
pub struct CanvasTruth {
    /// z in the left camera's frame in metres, NaN where there is nothing.
    pub depth_m: Image<f32>,
    /// Distance from the left camera's centre along the pixel's ray, NaN where there is nothing.
    pub distance_m: Image<f32>,
    /// Index of the object plus one, 0 where there is none.
    pub object: Image<u8>,
    /// Angle between the surface's normal and the direction to the camera that sees it at the more
    /// grazing angle, in degrees; NaN where there is nothing.
    pub incidence_deg: Image<f32>,
    /// Cosine of the angle between the normal and the ray of the left camera, which is what an error along
    /// the ray shrinks by to a distance from the surface; NaN where there is nothing.
    pub cosine_left: Image<f32>,
    /// Non-zero where the right camera sees the same surface.
    pub visible_to_both: Image<u8>,
}

/// Depth, distance, incidence, its cosine on the left, object and visibility of a pixel.
type Pixel = (f32, f32, f32, f32, u8, u8);

impl CanvasTruth {
    /// Traces the rays of all pixels that the left camera saw (`left_mask`).
    pub fn trace(
        world: &World,
        geometry: &RectifiedGeometry,
        left_mask: &Image<u8>,
        time_ns: u64,
    ) -> Self {
        let truth = world.truth();
        let (width, height) = (geometry.width, geometry.height);
        let right_centre_left_m = world.model().right_from_left.inverse().translation.vector;
        let rows: Vec<Vec<Pixel>> = (0..height)
            .into_par_iter()
            .map(|y| {
                let nothing = (f32::NAN, f32::NAN, f32::NAN, f32::NAN, 0, 0);
                let pixel = |x: usize| {
                    if left_mask.get(x, y) == Some(0) {
                        return nothing;
                    }
                    let ray = geometry.rect_from_left.inverse_transform_vector(&Vector3::new(
                        (x as f64 - geometry.cx_left_px) / geometry.focal_px,
                        (y as f64 - geometry.cy_px) / geometry.focal_px,
                        1.0,
                    ));
                    let Some(surface) = truth.surface_along_ray(&Vector3::zeros(), &ray, time_ns)
                    else {
                        return nothing;
                    };
                    let both = truth.visible_from(Camera::Right, &surface.point_left_m, time_ns);
                    let towards = |centre_left_m: Vector3<f64>| {
                        let direction = (centre_left_m - surface.point_left_m).normalize();
                        direction.dot(&surface.normal_left).clamp(-1.0, 1.0)
                    };
                    let cosine_left = towards(Vector3::zeros());
                    let cosine = cosine_left.min(towards(right_centre_left_m));
                    (
                        surface.point_left_m.z as f32,
                        surface.distance_m as f32,
                        cosine.acos().to_degrees() as f32,
                        cosine_left as f32,
                        u8::try_from(surface.object + 1).unwrap_or(u8::MAX),
                        u8::from(both),
                    )
                };
                (0..width).map(pixel).collect()
            })
            .collect();
        let flat = || rows.iter().flatten();
        // Each row has `width` pixels, so that the sizes fit.
        let image = |values: Vec<f32>| {
            Image::from_vec(width, height, values).unwrap_or_else(|| Image::new(0, 0, 0.0))
        };
        let bytes = |values: Vec<u8>| {
            Image::from_vec(width, height, values).unwrap_or_else(|| Image::new(0, 0, 0))
        };
        Self {
            depth_m: image(flat().map(|p| p.0).collect()),
            distance_m: image(flat().map(|p| p.1).collect()),
            incidence_deg: image(flat().map(|p| p.2).collect()),
            cosine_left: image(flat().map(|p| p.3).collect()),
            object: bytes(flat().map(|p| p.4).collect()),
            visible_to_both: bytes(flat().map(|p| p.5).collect()),
        }
    }

    /// How much farther away than the truth, along the pixel's ray, a point of depth `depth_m` is, metres.
    pub fn error_along_ray_m(&self, x: usize, y: usize, depth_m: f32) -> f64 {
        let true_m = self.depth_m.row(y)[x];
        f64::from(depth_m - true_m) * f64::from(self.distance_m.row(y)[x] / true_m)
    }

    /// The same point's distance from the true surface, taken as a plane behind the pixel, in metres; positive
    /// behind it.
    pub fn error_normal_m(&self, x: usize, y: usize, depth_m: f32) -> f64 {
        self.error_along_ray_m(x, y, depth_m) * f64::from(self.cosine_left.row(y)[x])
    }
}
