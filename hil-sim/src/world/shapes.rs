//! Surfaces with a formula: planes and spheres. Each lives in its object's own frame.

use nalgebra::Vector3;

use super::geometry::{Hit, Ray};
use super::trimesh::{TriangleMesh, Triangles};

/// A surface that rays can meet.
pub(crate) trait Shape: Send + Sync {
    /// The nearest meeting before `max_m`.
    fn intersect(&self, ray: &Ray, max_m: f64) -> Option<Hit>;

    /// Whether anything lies on the ray before `max_m`.
    fn occludes(&self, ray: &Ray, max_m: f64) -> bool {
        self.intersect(ray, max_m).is_some()
    }

    /// What is known about the surface by formula.
    fn features(&self) -> Vec<Feature> {
        Vec::new()
    }

    /// The mesh, if the surface is one.
    fn mesh(&self) -> Option<&TriangleMesh> {
        None
    }

    /// The surface's triangles, if it is made of them.
    fn triangles(&self) -> Option<&Triangles> {
        self.mesh().map(TriangleMesh::triangles)
    }
}

/// A measurable feature of a shape, in the object's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Feature {
    Plane { point: Vector3<f64>, normal: Vector3<f64> },
    Sphere { centre: Vector3<f64>, radius_m: f64 },
    Circle { centre: Vector3<f64>, normal: Vector3<f64>, radius_m: f64 },
}

/// A rectangle in the plane z = 0, around the origin.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rectangle {
    pub half_size_m: [f64; 2],
}

impl Shape for Rectangle {
    fn intersect(&self, ray: &Ray, max_m: f64) -> Option<Hit> {
        let distance_m = -ray.origin.z / ray.direction.z;
        // Written so that NaN (a ray within the plane) is a miss.
        if !(distance_m > 0.0 && distance_m < max_m) {
            return None;
        }
        let p = ray.at(distance_m);
        let is_inside = p.x.abs() <= self.half_size_m[0] && p.y.abs() <= self.half_size_m[1];
        is_inside.then(|| Hit { distance_m, normal: -Vector3::z() })
    }

    fn features(&self) -> Vec<Feature> {
        vec![Feature::Plane { point: Vector3::zeros(), normal: -Vector3::z() }]
    }
}

/// A sphere around the origin, seen from outside.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sphere {
    pub radius_m: f64,
}

impl Shape for Sphere {
    fn intersect(&self, ray: &Ray, max_m: f64) -> Option<Hit> {
        let along = ray.origin.dot(&ray.direction);
        // The distance of the ray from the centre, by a difference of vectors: the usual
        // discriminant loses half of the digits when the centre is far away.
        let closest = ray.origin - ray.direction * along;
        let half_chord2 = self.radius_m * self.radius_m - closest.norm_squared();
        if half_chord2 < 0.0 {
            return None;
        }
        let distance_m = -along - half_chord2.sqrt();
        (distance_m > 0.0 && distance_m < max_m)
            .then(|| Hit { distance_m, normal: ray.at(distance_m) / self.radius_m })
    }

    fn features(&self) -> Vec<Feature> {
        vec![Feature::Sphere { centre: Vector3::zeros(), radius_m: self.radius_m }]
    }
}

/// A round rod along y, closed by nothing: for wires and posts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rod {
    pub radius_m: f64,
    pub half_length_m: f64,
}

impl Shape for Rod {
    fn intersect(&self, ray: &Ray, max_m: f64) -> Option<Hit> {
        let (o, d) = (&ray.origin, &ray.direction);
        let a = d.x * d.x + d.z * d.z;
        let along = (o.x * d.x + o.z * d.z) / a;
        let (cx, cz) = (o.x - d.x * along, o.z - d.z * along);
        let half_chord2 = (self.radius_m * self.radius_m - cx * cx - cz * cz) / a;
        if half_chord2.is_nan() || half_chord2 < 0.0 {
            return None;
        }
        let distance_m = -along - half_chord2.sqrt();
        if !(distance_m > 0.0 && distance_m < max_m) {
            return None;
        }
        let p = ray.at(distance_m);
        (p.y.abs() <= self.half_length_m)
            .then(|| Hit { distance_m, normal: Vector3::new(p.x, 0.0, p.z) / self.radius_m })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: [f64; 3], towards: [f64; 3]) -> Ray {
        let origin = Vector3::from(origin);
        Ray { origin, direction: (Vector3::from(towards) - origin).normalize() }
    }

    #[test]
    fn hits_lie_on_the_surfaces() {
        for i in 0..100 {
            let t = f64::from(i) * 0.37;
            let target = [0.05 * t.sin(), 0.05 * (1.7 * t).cos(), 0.0];
            let r = ray([0.3 * t.cos(), 0.2, -1.5], target);
            let sphere = Sphere { radius_m: 0.075 };
            let hit = sphere.intersect(&r, 10.0).expect("aimed at the sphere");
            assert!((r.at(hit.distance_m).norm() - 0.075).abs() < 1e-14);
            assert!(hit.normal.dot(&r.direction) < 0.0);
            let rod = Rod { radius_m: 0.06, half_length_m: 0.5 };
            let p = r.at(rod.intersect(&r, 10.0).expect("aimed at the rod").distance_m);
            assert!((p.x.hypot(p.z) - 0.06).abs() < 1e-14);
        }
    }

    #[test]
    fn limits_are_kept() {
        let plate = Rectangle { half_size_m: [0.1, 0.2] };
        let straight = ray([0.0, 0.0, -1.0], [0.0, 0.0, 0.0]);
        assert!(plate.intersect(&straight, 2.0).is_some());
        assert!(plate.intersect(&straight, 0.99).is_none());
        assert!(plate.intersect(&ray([0.0, 0.0, -1.0], [0.11, 0.0, 0.0]), 2.0).is_none());
        assert!(plate.intersect(&ray([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), 2.0).is_none());
        let rod = Rod { radius_m: 0.01, half_length_m: 0.1 };
        assert!(rod.intersect(&ray([0.0, 0.11, -1.0], [0.0, 0.11, 0.0]), 2.0).is_none());
    }
}
