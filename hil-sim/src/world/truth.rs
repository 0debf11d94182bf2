//! Ground truth: what is really there, by the same rays that made the images.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::World;
use super::expose::{Camera, CameraUnit};
use super::geometry::{Ray, transform_point};
use super::scene::PosedScene;
use super::shapes::Feature;

/// A point on a surface, in the left camera's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Where it is.
    pub point_left_m: Vector3<f64>,
    /// Unit normal, turned to where the ray came from.
    pub normal_left: Vector3<f64>,
    /// Index of its object, for [`World::object_name`].
    pub object: usize,
    /// Distance from the ray's origin.
    pub distance_m: f64,
}

/// A feature of known size and place, in the left camera's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Primitive {
    /// Index of its object, for [`World::object_name`].
    pub object: usize,
    /// What it is.
    pub shape: PrimitiveShape,
}

/// The shape of a [`Primitive`]. Normals are of unit length.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum PrimitiveShape {
    /// A plane, by a point on it and its normal towards the free side.
    Plane {
        /// A point on it.
        point_left_m: Vector3<f64>,
        /// Its normal.
        normal_left: Vector3<f64>,
    },
    /// A sphere.
    Sphere {
        /// Its centre.
        centre_left_m: Vector3<f64>,
        /// Its radius.
        radius_m: f64,
    },
    /// A circular edge: of a hole, a disc or a boss.
    Circle {
        /// Its centre.
        centre_left_m: Vector3<f64>,
        /// Normal of its plane towards the free side.
        normal_left: Vector3<f64>,
        /// Its radius.
        radius_m: f64,
    },
}

/// The surface of an object as triangles, in the left camera's frame.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceMesh {
    /// Vertices.
    pub vertices_left_m: Vec<Vector3<f64>>,
    /// Triples of indices into the vertices.
    pub triangles: Vec<[u32; 3]>,
}

/// Surfaces this much before a point still count as the point itself.
const SAME_SURFACE_M: f64 = 2e-5;

/// Ground truth of a [`World`]; see [`World::truth`].
#[derive(Clone, Copy)]
pub struct Truth<'a> {
    world: &'a World,
}

impl<'a> Truth<'a> {
    pub(crate) fn new(world: &'a World) -> Self {
        Self { world }
    }

    /// The first surface on the ray from `origin_left_m` along `direction` (of any length), both in
    /// the left camera's frame.
    #[must_use]
    pub fn surface_along_ray(
        &self,
        origin_left_m: &Vector3<f64>,
        direction: &Vector3<f64>,
        time_ns: u64,
    ) -> Option<SurfacePoint> {
        surface(&self.world.scene.at(time_ns), origin_left_m, direction)
    }

    /// Whether a camera sees a point of the left camera's frame: it projects into the image and
    /// nothing is before it.
    #[must_use]
    pub fn visible_from(&self, camera: Camera, point_left_m: &Vector3<f64>, time_ns: u64) -> bool {
        is_visible(&self.world.scene.at(time_ns), self.world.unit(camera), point_left_m)
    }

    /// z of the surface in the left camera's frame along each pixel centre's ray of its raw image,
    /// row by row in metres; NaN where there is none.
    #[must_use]
    pub fn depth_m(&self, time_ns: u64) -> Vec<f32> {
        self.per_left_pixel(time_ns, f32::NAN, |_, surface| surface.point_left_m.z as f32)
    }

    /// Which pixels of the left camera's raw image show a surface that the right camera sees too.
    #[must_use]
    pub fn visible_to_both(&self, time_ns: u64) -> Vec<bool> {
        let right = self.world.unit(Camera::Right);
        self.per_left_pixel(time_ns, false, |scene, surface| {
            is_visible(scene, right, &surface.point_left_m)
        })
    }

    /// Features of known size and place at a time.
    #[must_use]
    pub fn primitives(&self, time_ns: u64) -> Vec<Primitive> {
        let scene = &self.world.scene;
        let mut primitives = Vec::new();
        for (object, o) in scene.objects.iter().enumerate() {
            let pose = scene.left_from_object(object, time_ns);
            primitives.extend(o.shape.features().into_iter().map(|feature| {
                let shape = match feature {
                    Feature::Plane { point, normal } => PrimitiveShape::Plane {
                        point_left_m: transform_point(&pose, &point),
                        normal_left: pose.rotation * normal,
                    },
                    Feature::Sphere { centre, radius_m } => PrimitiveShape::Sphere {
                        centre_left_m: transform_point(&pose, &centre),
                        radius_m,
                    },
                    Feature::Circle { centre, normal, radius_m } => PrimitiveShape::Circle {
                        centre_left_m: transform_point(&pose, &centre),
                        normal_left: pose.rotation * normal,
                        radius_m,
                    },
                };
                Primitive { object, shape }
            }));
        }
        primitives
    }

    /// The surface of an object at a time, for comparing clouds with it. `None` for objects that are
    /// not made of triangles (planes, spheres, the industrial part).
    #[must_use]
    pub fn mesh(&self, object: usize, time_ns: u64) -> Option<SurfaceMesh> {
        let scene = &self.world.scene;
        let triangles = scene.objects.get(object)?.shape.triangles()?;
        let pose = scene.left_from_object(object, time_ns);
        Some(SurfaceMesh {
            vertices_left_m: triangles.vertices.iter().map(|v| transform_point(&pose, v)).collect(),
            triangles: triangles.indices.clone(),
        })
    }

    fn per_left_pixel<T: Copy + Send + Sync>(
        &self,
        time_ns: u64,
        nothing: T,
        value: impl Fn(&PosedScene<'_>, &SurfacePoint) -> T + Sync,
    ) -> Vec<T> {
        let camera = &self.world.unit(Camera::Left).model;
        let scene = self.world.scene.at(time_ns);
        let mut out = vec![nothing; camera.width * camera.height];
        out.par_chunks_mut(camera.width).enumerate().for_each(|(v, line)| {
            for (u, out) in line.iter_mut().enumerate() {
                let direction = camera.ray_direction([u as f64, v as f64]);
                if let Some(surface) = surface(&scene, &Vector3::zeros(), &direction) {
                    *out = value(&scene, &surface);
                }
            }
        });
        out
    }
}

fn surface(
    scene: &PosedScene<'_>,
    origin: &Vector3<f64>,
    direction: &Vector3<f64>,
) -> Option<SurfacePoint> {
    let direction = direction.try_normalize(f64::MIN_POSITIVE)?;
    let ray = Ray { origin: *origin, direction };
    let (object, hit) = scene.nearest(&ray, f64::INFINITY)?;
    Some(SurfacePoint {
        point_left_m: ray.at(hit.distance_m),
        normal_left: hit.normal,
        object,
        distance_m: hit.distance_m,
    })
}

fn is_visible(scene: &PosedScene<'_>, unit: &CameraUnit, point_left_m: &Vector3<f64>) -> bool {
    let in_camera = unit.left_from_camera.inverse_point(point_left_m);
    if !unit.model.project(&in_camera).is_some_and(|pixel| unit.model.contains(pixel)) {
        return false;
    }
    let origin = unit.left_from_camera.translation;
    let to_point = point_left_m - origin;
    let distance = to_point.norm();
    let ray = Ray { origin, direction: to_point / distance };
    !scene.is_occluded(&ray, distance - SAME_SURFACE_M)
}
