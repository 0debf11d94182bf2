//! From a scene's description to its objects.

use nalgebra::{Isometry3, Vector3};

use super::error::WorldError;
use super::geometry::isometry;
use super::material::{Gloss, Material, Texture};
use super::scene::{Motion, Object, Scene, still};
use super::shapes::{Rectangle, Sphere};
use super::spec::{MaterialKind, SceneKind, SceneSpec};

/// Half the size of planes: they reach beyond the field at any distance in range.
const PLANE_HALF_SIZE_M: [f64; 2] = [4.0, 4.0];

/// Places the scene before the sensor.
pub(crate) fn build(spec: &SceneSpec, left_from_rig: &Isometry3<f64>) -> Result<Scene, WorldError> {
    let pose = left_from_rig
        * isometry(
            Vector3::new(0.0, 0.0, spec.distance_m),
            [spec.tilt_deg.to_radians(), spec.turn_deg.to_radians(), 0.0],
        );
    let material = material(spec);
    let plane = Rectangle { half_size_m: PLANE_HALF_SIZE_M };
    let objects = match &spec.kind {
        SceneKind::Plane => vec![still("plane", plane, pose, material)],
        SceneKind::Sphere { plane_m, radius_m } => {
            let wall = left_from_rig * Isometry3::translation(0.0, 0.0, *plane_m);
            vec![
                still("plane", plane, wall, material.clone()),
                still("sphere", Sphere { radius_m: *radius_m }, pose, material),
            ]
        }
        SceneKind::MovingPlane { speed_m_per_s } => {
            let velocity_m_per_s = left_from_rig.rotation * Vector3::z() * *speed_m_per_s;
            vec![Object {
                motion: Motion::Linear { velocity_m_per_s },
                ..still("plane", plane, pose, material)
            }]
        }
    };
    Ok(Scene { objects })
}

fn material(spec: &SceneSpec) -> Material {
    match spec.material {
        MaterialKind::Lambertian => Material::matt(spec.albedo),
        MaterialKind::Glossy => Material {
            texture: Texture::Plain(spec.albedo),
            gloss: Some(Gloss { normal_reflectance: 0.04, roughness: 0.25 }),
        },
        MaterialKind::Metal => Material {
            texture: Texture::Plain(spec.albedo * 0.4),
            gloss: Some(Gloss { normal_reflectance: 0.55, roughness: 0.4 }),
        },
    }
}
