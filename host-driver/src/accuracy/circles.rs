//! Circles of a known scene, as a depth frame shows them.

use nalgebra::{Point3, Vector3};
use stspp_hil_sim::world::{Camera, PrimitiveShape, World};

use crate::DepthFrame;
use crate::measure::FitError;
use crate::measure::circle::{self, Rim, RimSearch};

/// A circle of the scene whose whole rim both cameras see.
#[derive(Debug)]
pub struct FoundCircle {
    /// True centre in the left camera's frame, metres.
    pub centre_m: Point3<f64>,
    /// True radius in metres.
    pub radius_m: f64,
    /// The rim in the frame's cloud.
    pub rim: Result<Rim, FitError>,
}

impl FoundCircle {
    /// Error of the fitted radius in metres, where there is one.
    pub fn radius_error_m(&self) -> Option<f64> {
        self.rim.as_ref().ok().map(|rim| rim.circle.radius_m - self.radius_m)
    }

    /// Distance of the fitted centre from the true one in metres, where there is one.
    pub fn centre_error_m(&self) -> Option<f64> {
        self.rim.as_ref().ok().map(|rim| (rim.circle.centre_m - self.centre_m).norm())
    }
}

/// Looks for the circles of `world` at `time_ns` in `frame`.
pub fn find(frame: &DepthFrame, world: &World, time_ns: u64) -> Vec<FoundCircle> {
    let cloud: Vec<Point3<f64>> =
        frame.point_cloud().points_left_m.iter().map(|p| p.cast()).collect();
    let truth = world.truth();
    let mut found = Vec::new();
    for primitive in truth.primitives(time_ns) {
        let PrimitiveShape::Circle { centre_left_m, normal_left, radius_m } = primitive.shape
        else {
            continue;
        };
        let (u, v) = across(&normal_left);
        let rim_is_seen = (0..16).all(|k| {
            let (s, c) = (f64::from(k) * std::f64::consts::TAU / 16.0).sin_cos();
            let p = centre_left_m + (u * c + v * s) * radius_m + normal_left * 1e-4;
            [Camera::Left, Camera::Right]
                .into_iter()
                .all(|camera| truth.visible_from(camera, &p, time_ns))
        });
        if !rim_is_seen {
            continue;
        }
        let centre_m = Point3::from(centre_left_m);
        let search = RimSearch::around(centre_m, radius_m);
        let reach_m = search.reach_m + 0.5 * radius_m + 4e-3;
        let around: Vec<_> =
            cloud.iter().copied().filter(|p| (p - centre_m).norm() < reach_m).collect();
        found.push(FoundCircle { centre_m, radius_m, rim: circle::rim(&around, &search) });
    }
    found
}

fn across(axis: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if axis.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let u = axis.cross(&helper).normalize();
    (u, axis.cross(&u))
}
