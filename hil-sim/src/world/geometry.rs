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

    pub fn inverse_ray(&self, ray: &Ray) -> Ray {
        Ray {
            origin: self.inverse_point(&ray.origin),
            direction: self.inverse_vector(&ray.direction),
        }
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
            let (origin, direction) = (ray.origin[axis], ray.direction[axis]);
            if direction == 0.0 {
                // Parallel to the slab: 0 times infinity below would be NaN.
                if origin < self.min[axis] || origin > self.max[axis] {
                    return false;
                }
                continue;
            }
            let inverse = 1.0 / direction;
            let a = (self.min[axis] - origin) * inverse;
            let b = (self.max[axis] - origin) * inverse;
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        near <= far
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_are_crossed_also_along_their_faces() {
        let mut unit = Aabb::EMPTY;
        unit.include(&Vector3::zeros());
        unit.include(&Vector3::repeat(1.0));
        let crossed = |origin: [f64; 3], direction: [f64; 3], max_m| {
            let ray = Ray {
                origin: Vector3::from(origin),
                direction: Vector3::from(direction).normalize(),
            };
            unit.is_crossed_by(&ray, max_m)
        };
        assert!(crossed([0.5, 0.5, -1.0], [0.0, 0.0, 1.0], 2.0));
        assert!(!crossed([0.5, 0.5, -1.0], [0.0, 0.0, 1.0], 0.9));
        assert!(!crossed([0.5, 0.5, -1.0], [0.0, 0.0, -1.0], 9.0));
        assert!(crossed([0.0, 1.0, -1.0], [0.0, 0.0, 1.0], 2.0));
        assert!(!crossed([1.1, 0.5, -1.0], [0.0, 0.0, 1.0], 9.0));
        assert!(crossed([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], 9.0));
        assert!(crossed([0.5, 0.5, 0.5], [0.3, -0.2, 0.9], 9.0));
    }
}
