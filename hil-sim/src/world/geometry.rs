//! Rays, hits and rigid transforms in the form that the inner loops want.

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};

/// A half line. `direction` is of unit length, so the ray parameter is a distance in metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    pub origin: Vector3<f64>,
    pub direction: Vector3<f64>,
}

impl Ray {
    pub fn at(&self, distance_m: f64) -> Vector3<f64> {
        self.origin + self.direction * distance_m
    }
}

/// Where a ray meets a surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    /// Distance along the ray.
    pub distance_m: f64,
    /// Unit normal used for shading; its side is not specified.
    pub normal: Vector3<f64>,
}

/// A rotation and translation as a matrix: twice as fast to apply as the quaternion of
/// [`Isometry3`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rigid {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Rigid {
    pub fn vector(&self, v: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * v
    }

    pub fn inverse_point(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.rotation.tr_mul(&(p - self.translation))
    }

    pub fn inverse_vector(&self, v: &Vector3<f64>) -> Vector3<f64> {
        self.rotation.tr_mul(v)
    }
}

impl From<&Isometry3<f64>> for Rigid {
    fn from(iso: &Isometry3<f64>) -> Self {
        Self {
            rotation: iso.rotation.to_rotation_matrix().into_inner(),
            translation: iso.translation.vector,
        }
    }
}

/// `iso` applied to a point.
pub(crate) fn transform_point(iso: &Isometry3<f64>, p: &Vector3<f64>) -> Vector3<f64> {
    iso.rotation * p + iso.translation.vector
}

/// The isometry with these axes' rotations, applied x first, then y, then z.
pub(crate) fn isometry(translation: Vector3<f64>, roll_pitch_yaw_rad: [f64; 3]) -> Isometry3<f64> {
    let [roll, pitch, yaw] = roll_pitch_yaw_rad;
    Isometry3::from_parts(translation.into(), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
}

/// An axis-aligned box.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Aabb {
    pub min: Vector3<f64>,
    pub max: Vector3<f64>,
}

impl Aabb {
    pub const EMPTY: Self = Self {
        min: Vector3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY),
        max: Vector3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY),
    };

    pub fn include(&mut self, p: &Vector3<f64>) {
        self.min = self.min.inf(p);
        self.max = self.max.sup(p);
    }

    /// Whether the ray passes through the box before `max_m`.
    pub fn is_crossed_by(&self, ray: &Ray, max_m: f64) -> bool {
        let mut near = 0.0_f64;
        let mut far = max_m;
        for axis in 0..3 {
            let inverse = 1.0 / ray.direction[axis];
            let a = (self.min[axis] - ray.origin[axis]) * inverse;
            let b = (self.max[axis] - ray.origin[axis]) * inverse;
            // A ray inside a slab that it is parallel to gives NaN here, which min and max ignore.
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        near <= far
    }
}
