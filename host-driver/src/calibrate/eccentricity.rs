//! Where a disc is seen: the middle of a circle's image is not the image of its middle.
//!
//! A camera sees the near half of a tilted disc larger than the far half, and the lens bends both. The
//! centroid of the image is therefore off the image of the centre, by 0.1 px for a disc of 10 mm
//! radius at 1 m. The offset is computed from the outline's image and added to the prediction.

use nalgebra::{Isometry3, Point2, Point3, Vector2};

use super::bundle::State;
use super::observations::Observations;
use crate::CameraIntrinsics;

/// Corners of the polygon that stands for a circle.
const CORNERS: usize = 48;

/// Offsets of all sightings of the views that have a pose, view by view, left before right; empty for
/// boards whose points are points.
pub fn offsets(observations: &Observations, state: &State) -> Vec<Vector2<f64>> {
    let Some(radius_m) = observations.board.disc_radius_m() else { return Vec::new() };
    let mut offsets = Vec::new();
    for (view, seen) in observations.views.iter().enumerate() {
        for side in 0..2 {
            let Some(pose) = state.camera_from_board(view, side) else { continue };
            for sighting in seen.side(side) {
                let centre = observations.board.point_m(sighting.point);
                let offset = of_disc(&state.cameras[side], &pose, centre, radius_m);
                offsets.push(offset.unwrap_or_default());
            }
        }
    }
    offsets
}

/// Centroid of a disc's image minus the image of its centre; `None` when part of it is behind the
/// camera.
pub fn of_disc(
    camera: &CameraIntrinsics,
    camera_from_board: &Isometry3<f64>,
    centre_m: Point2<f64>,
    radius_m: f64,
) -> Option<Vector2<f64>> {
    let seen = |x: f64, y: f64| camera.project(&(camera_from_board * Point3::new(x, y, 0.0)));
    let centre = seen(centre_m.x, centre_m.y)?;
    let mut outline = [Vector2::zeros(); CORNERS];
    for (k, corner) in outline.iter_mut().enumerate() {
        let (sin, cos) = (k as f64 / CORNERS as f64 * std::f64::consts::TAU).sin_cos();
        *corner = seen(centre_m.x + radius_m * cos, centre_m.y + radius_m * sin)? - centre;
    }
    // Centroid of a polygon: its triangles from the centre, weighted by their areas.
    let (mut area, mut sum) = (0.0, Vector2::zeros());
    for k in 0..CORNERS {
        let (a, b) = (outline[k], outline[(k + 1) % CORNERS]);
        let twice = a.x * b.y - a.y * b.x;
        area += twice;
        sum += (a + b) * (twice / 3.0);
    }
    (area.abs() > 1e-9).then(|| sum / area)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// The centroid by brute force: the disc's points, weighted by the area that they image to.
    #[test]
    fn the_offset_is_that_of_the_area() {
        let camera = CameraIntrinsics {
            focal_px: [1860.0, 1855.0],
            principal_px: [640.0, 512.0],
            radtan: [-0.1, 0.08, 2e-4, -3e-4],
            resolution_px: [1280, 1024],
        };
        let pose = Isometry3::new(Vector3::new(0.1, -0.1, 0.9), Vector3::new(0.5, 0.4, 0.1));
        let (centre, radius) = (Point2::new(0.05, 0.02), 0.012);
        let offset = of_disc(&camera, &pose, centre, radius).unwrap();
        let seen = |x: f64, y: f64| camera.project(&(pose * Point3::new(x, y, 0.0))).unwrap();
        let (mut area, mut sum) = (0.0, Vector2::zeros());
        let n = 300;
        for i in 0..n {
            for j in 0..n {
                let x = (f64::from(i) + 0.5) / f64::from(n) * 2.0 - 1.0;
                let y = (f64::from(j) + 0.5) / f64::from(n) * 2.0 - 1.0;
                if x * x + y * y > 1.0 {
                    continue;
                }
                let (x, y) = (centre.x + radius * x, centre.y + radius * y);
                let h = 1e-6;
                let (dx, dy) = (seen(x + h, y) - seen(x, y), seen(x, y + h) - seen(x, y));
                let weight = dx.x * dy.y - dx.y * dy.x;
                area += weight;
                sum += weight * seen(x, y);
            }
        }
        let brute = sum / area - seen(centre.x, centre.y);
        assert!(offset.norm() > 0.05, "{offset}");
        assert!((offset - brute).norm() < 2e-3, "{offset} {brute}");
    }
}
