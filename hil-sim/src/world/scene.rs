//! Objects, where they are at a time, and which of them a ray meets.

use std::sync::Arc;

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};

use super::geometry::{Hit, Ray, Rigid, transform_point};
use super::material::Material;
use super::raster::{Seen, ShadowGrid};
use super::shapes::Shape;
use super::trimesh::TriangleMesh;

/// How an object moves. Times are virtual time.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Motion {
    Still,
    /// Constant velocity, in the left camera's frame.
    Linear {
        velocity_m_per_s: Vector3<f64>,
    },
    /// Constant turning about a fixed axis, in the left camera's frame.
    Turning {
        through: Vector3<f64>,
        axis: Unit<Vector3<f64>>,
        rad_per_s: f64,
    },
    /// Moved by these from its place at time 0, each for `dwell_s`, then from the first again: held
    /// still, as by a hand that brings it from view to view.
    Steps {
        displacements: Arc<[Isometry3<f64>]>,
        dwell_s: f64,
    },
}

impl Motion {
    /// What the motion does to a point in `seconds`.
    fn displacement(&self, seconds: f64) -> Isometry3<f64> {
        match self {
            Self::Still => Isometry3::identity(),
            Self::Linear { velocity_m_per_s } => Isometry3::from_parts(
                Translation3::from(velocity_m_per_s * seconds),
                UnitQuaternion::identity(),
            ),
            Self::Turning { through, axis, rad_per_s } => {
                let rotation = UnitQuaternion::from_axis_angle(axis, rad_per_s * seconds);
                Isometry3::from_parts((through - rotation * through).into(), rotation)
            }
            Self::Steps { displacements, dwell_s } => {
                // A hair is added so that a multiple of the dwell is in the step that it begins.
                let step = (seconds / dwell_s + 1e-9) as usize;
                displacements.get(step % displacements.len().max(1)).copied().unwrap_or_default()
            }
        }
    }

    /// Whether every time shows the same.
    pub fn is_still(&self) -> bool {
        matches!(self, Self::Still)
    }

    /// Speed of a point in metres per second.
    fn speed_m_per_s(&self, point: &Vector3<f64>) -> f64 {
        match self {
            Self::Still | Self::Steps { .. } => 0.0,
            Self::Linear { velocity_m_per_s } => velocity_m_per_s.norm(),
            Self::Turning { through, axis, rad_per_s } => {
                (point - through).cross(axis).norm() * rad_per_s.abs()
            }
        }
    }
}

/// A thing in the scene.
pub(crate) struct Object {
    pub name: &'static str,
    pub shape: Box<dyn Shape>,
    /// Pose at time 0.
    pub left_from_object: Isometry3<f64>,
    pub motion: Motion,
    pub material: Material,
    /// Radius about the object's origin within which its motion is judged.
    pub reach_m: f64,
}

impl Object {
    /// The fastest point's speed, about.
    fn speed_m_per_s(&self) -> f64 {
        let edge = self.left_from_object.translation.vector + Vector3::new(self.reach_m, 0.0, 0.0);
        self.motion.speed_m_per_s(&edge)
    }
}

/// Points of a mesh by which its motion in an image is judged.
const MOTION_POINTS: usize = 2000;

/// All objects.
pub(crate) struct Scene {
    pub objects: Vec<Object>,
}

impl Scene {
    pub fn is_still(&self) -> bool {
        self.objects.iter().all(|o| o.motion.is_still())
    }

    /// The fastest point's speed, about.
    pub fn speed_m_per_s(&self) -> f64 {
        self.objects.iter().map(Object::speed_m_per_s).fold(0.0, f64::max)
    }

    /// How far the fastest point moves between two times in a camera's image, about, in pixels.
    /// `project` takes points of the left camera's frame to pixels, `focal_px` is the camera's.
    pub fn image_motion_px(
        &self,
        [from_ns, to_ns]: [u64; 2],
        project: impl Fn(&Vector3<f64>) -> Option<[f64; 2]>,
        focal_px: f64,
    ) -> f64 {
        let seconds = to_ns.saturating_sub(from_ns) as f64 * 1e-9;
        let of_object = |(index, object): (usize, &Object)| {
            if object.speed_m_per_s() == 0.0 {
                return 0.0;
            }
            let poses = [from_ns, to_ns].map(|t| Rigid::from(&self.left_from_object(index, t)));
            let vertices = object.shape.mesh().map_or(&[][..], TriangleMesh::vertices);
            let moved = vertices
                .iter()
                .step_by((vertices.len() / MOTION_POINTS).max(1))
                .filter_map(|vertex| {
                    let [from, to] = poses.map(|p| project(&(p.rotation * vertex + p.translation)));
                    let ([x0, y0], [x1, y1]) = (from?, to?);
                    Some((x1 - x0).hypot(y1 - y0))
                })
                .reduce(f64::max);
            // Without points to follow: a point at 1 m that moves across the line of sight.
            moved.unwrap_or(object.speed_m_per_s() * seconds * focal_px)
        };
        self.objects.iter().enumerate().map(of_object).fold(0.0, f64::max)
    }

    /// Pose of an object at a time.
    pub fn left_from_object(&self, object: usize, time_ns: u64) -> Isometry3<f64> {
        let o = &self.objects[object];
        o.motion.displacement(time_ns as f64 * 1e-9) * o.left_from_object
    }

    /// The scene frozen at a time.
    pub fn at(&self, time_ns: u64) -> PosedScene<'_> {
        let poses = (0..self.objects.len())
            .map(|i| Rigid::from(&self.left_from_object(i, time_ns)))
            .collect();
        PosedScene { scene: self, poses }
    }
}

/// The scene at one time.
pub(crate) struct PosedScene<'a> {
    pub scene: &'a Scene,
    poses: Vec<Rigid>,
}

impl PosedScene<'_> {
    /// The nearest surface on a ray of the left camera's frame; the normal is turned to the ray's
    /// origin.
    pub fn nearest(&self, ray: &Ray, max_m: f64) -> Option<(usize, Hit)> {
        self.nearest_with(ray, max_m, |_| None)
    }

    /// [`Self::nearest`] where it is known already what the ray meets of some objects' meshes; `None`
    /// for those that have to be asked.
    pub fn nearest_with(
        &self,
        ray: &Ray,
        max_m: f64,
        known: impl Fn(usize) -> Option<Seen>,
    ) -> Option<(usize, Hit)> {
        let mut best: Option<(usize, Hit)> = None;
        let mut max_m = max_m;
        for (i, (object, pose)) in self.scene.objects.iter().zip(&self.poses).enumerate() {
            let hit = match (known(i), object.shape.mesh()) {
                (Some(seen), Some(mesh)) => seen
                    .filter(|(_, crossing)| crossing.distance_m < max_m)
                    .map(|(facet, crossing)| mesh.hit(facet as usize, &crossing)),
                _ => object.shape.intersect(&pose.inverse_ray(ray), max_m),
            };
            if let Some(hit) = hit {
                max_m = hit.distance_m;
                best = Some((i, Hit { normal: pose.vector(&hit.normal), ..hit }));
            }
        }
        best.map(|(i, mut hit)| {
            if hit.normal.dot(&ray.direction) > 0.0 {
                hit.normal = -hit.normal;
            }
            (i, hit)
        })
    }

    /// Whether anything is on the ray before `max_m`.
    pub fn is_occluded(&self, ray: &Ray, max_m: f64) -> bool {
        self.scene
            .objects
            .iter()
            .zip(&self.poses)
            .any(|(object, pose)| object.shape.occludes(&pose.inverse_ray(ray), max_m))
    }

    /// What each object's mesh may put in the shadow of a light, for [`Self::is_shadowed`].
    pub fn shadows(&self, light_left_m: &Vector3<f64>) -> Vec<Option<ShadowGrid>> {
        self.parts()
            .map(|(shape, pose)| ShadowGrid::new(shape.mesh()?, &pose.inverse_point(light_left_m)))
            .collect()
    }

    /// [`Self::is_occluded`] for a ray to the light that `shadows` were made for.
    pub fn is_shadowed(&self, shadows: &[Option<ShadowGrid>], ray: &Ray, distance_m: f64) -> bool {
        self.parts().zip(shadows).any(|((shape, pose), grid)| {
            let ray = pose.inverse_ray(ray);
            match (grid, shape.mesh()) {
                (Some(grid), Some(mesh)) => grid.is_shadowed(mesh, &ray, distance_m),
                _ => shape.occludes(&ray, distance_m),
            }
        })
    }

    /// Each object's shape and pose.
    pub fn parts(&self) -> impl Iterator<Item = (&dyn Shape, &Rigid)> {
        self.scene.objects.iter().map(|o| &*o.shape).zip(&self.poses)
    }

    /// Diffuse albedo of an object at a point of the left camera's frame.
    pub fn albedo(&self, object: usize, point_left_m: &Vector3<f64>) -> f64 {
        let local = self.poses[object].inverse_point(point_left_m);
        self.scene.objects[object].material.albedo(&local)
    }
}

/// A still object.
pub(crate) fn still(
    name: &'static str,
    shape: impl Shape + 'static,
    left_from_object: Isometry3<f64>,
    material: Material,
) -> Object {
    Object {
        name,
        shape: Box::new(shape),
        left_from_object,
        motion: Motion::Still,
        material,
        reach_m: 0.0,
    }
}

/// An object that turns about an axis of its own frame.
pub(crate) fn turning(mut object: Object, axis: Vector3<f64>, rpm: f64, reach_m: f64) -> Object {
    let pose = object.left_from_object;
    object.motion = Motion::Turning {
        through: transform_point(&pose, &Vector3::zeros()),
        axis: Unit::new_normalize(pose.rotation * axis),
        rad_per_s: rpm * std::f64::consts::TAU / 60.0,
    };
    object.reach_m = reach_m;
    object
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::shapes::{Rectangle, Sphere};

    #[test]
    fn a_turning_object_keeps_its_axis_and_comes_back() {
        let pose = Isometry3::new(Vector3::new(0.1, 0.2, 1.0), Vector3::new(0.2, 0.1, -0.3));
        let object = still("ball", Sphere { radius_m: 0.1 }, pose, Material::matt(0.5));
        let scene = Scene { objects: vec![turning(object, Vector3::y(), 1.2, 0.1)] };
        let on_axis = Vector3::new(0.0, 0.07, 0.0);
        let off_axis = Vector3::new(0.05, 0.07, 0.0);
        let at = |p: &Vector3<f64>, t_s: f64| {
            transform_point(&scene.left_from_object(0, (t_s * 1e9) as u64), p)
        };
        assert!((at(&on_axis, 0.0) - at(&on_axis, 17.0)).norm() < 1e-12);
        assert!((at(&off_axis, 0.0) - at(&off_axis, 50.0)).norm() < 1e-9);
        // A quarter turn of 12.5 s moves a point by sqrt(2) radii.
        let moved = (at(&off_axis, 0.0) - at(&off_axis, 12.5)).norm();
        assert!((moved - 0.05 * 2.0_f64.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn the_nearest_object_wins_and_the_normal_faces_the_viewer() {
        let far = Isometry3::translation(0.0, 0.0, 2.0);
        let near = Isometry3::translation(0.0, 0.0, 1.0);
        let scene = Scene {
            objects: vec![
                still("wall", Rectangle { half_size_m: [1.0, 1.0] }, far, Material::matt(0.5)),
                still("ball", Sphere { radius_m: 0.1 }, near, Material::matt(0.5)),
            ],
        };
        let posed = scene.at(0);
        let ray = Ray { origin: Vector3::zeros(), direction: Vector3::z() };
        let (object, hit) = posed.nearest(&ray, 10.0).expect("something is ahead");
        assert_eq!((object, hit.distance_m), (1, 0.9));
        assert!(hit.normal.z < -0.99);
        assert!(posed.is_occluded(&ray, 1.0) && !posed.is_occluded(&ray, 0.8));
    }
}
