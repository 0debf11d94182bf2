//! From a scene's description to its objects.

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::{Isometry3, Vector3};

use super::board::BoardTexture;
use super::error::WorldError;
use super::geometry::isometry;
use super::material::{Gloss, Material, Texture};
use super::part::Part;
use super::scene::{Motion, Object, Scene, still, turning};
use super::shapes::{Rectangle, Rod, Sphere};
use super::spec::{MaterialKind, SceneKind, SceneSpec};
use super::{mesh_file, panel, statue};

/// Planes reach beyond the field at any distance in range.
const PLANE: Rectangle = Rectangle { half_size_m: [4.0, 4.0] };
/// White paper around a printed target.
const BOARD_MARGIN_M: f64 = 0.015;

/// Places the scene before the sensor.
pub(crate) fn build(spec: &SceneSpec, left_from_rig: &Isometry3<f64>) -> Result<Scene, WorldError> {
    let [tilt, turn, roll] = [spec.tilt_deg, spec.turn_deg, spec.roll_deg].map(f64::to_radians);
    let rig_from_object = Isometry3::translation(spec.shift_m[0], spec.shift_m[1], spec.distance_m)
        * isometry(Vector3::zeros(), [0.0, turn, 0.0])
        * isometry(Vector3::zeros(), [-tilt, 0.0, 0.0])
        * isometry(Vector3::zeros(), [0.0, 0.0, roll]);
    let pose = left_from_rig * rig_from_object;
    // Objects that stand upright in their own frame (y up) with their front along z.
    let upright = pose * Isometry3::rotation(Vector3::x() * PI);
    let material = material(spec);
    let objects = match &spec.kind {
        SceneKind::Plane => vec![still("plane", PLANE, pose, material)],
        SceneKind::Sphere { plane_m, radius_m } => {
            let wall = left_from_rig * Isometry3::translation(0.0, 0.0, *plane_m);
            vec![
                still("plane", PLANE, wall, material.clone()),
                still("sphere", Sphere { radius_m: *radius_m }, pose, material),
            ]
        }
        SceneKind::MovingPlane { speed_m_per_s } => {
            let velocity_m_per_s = left_from_rig.rotation * Vector3::z() * *speed_m_per_s;
            vec![Object {
                motion: Motion::Linear { velocity_m_per_s },
                ..still("plane", PLANE, pose, material)
            }]
        }
        SceneKind::Statue { rpm } => {
            let stone = Material {
                texture: Texture::Mottled {
                    mean: spec.albedo * 0.94,
                    amplitude: spec.albedo * 0.06,
                    grain_m: 0.006,
                },
                ..material
            };
            let object = still("statue", statue::statue(), upright, stone);
            if *rpm == 0.0 {
                vec![object]
            } else {
                vec![turning(object, Vector3::y(), *rpm, statue::REACH_M)]
            }
        }
        SceneKind::Part => vec![still("part", Part::new(), pose, material)],
        SceneKind::Panel => vec![still("panel", panel::panel(), pose, material)],
        SceneKind::Wires => wires(left_from_rig, spec.distance_m, &material),
        SceneKind::Board { texture, rig_from_board } => {
            vec![board(texture, rig_from_board.map_or(pose, |board| left_from_rig * board))]
        }
        SceneKind::BoardTour { texture, rig_from_board, dwell_s } => {
            let poses: Vec<_> = rig_from_board.iter().map(|board| left_from_rig * board).collect();
            let first = poses.first().copied().unwrap_or(pose);
            let displacements = poses.iter().map(|pose| pose * first.inverse()).collect();
            let motion = Motion::Steps { displacements, dwell_s: *dwell_s };
            vec![Object { motion, ..board(texture, first) }]
        }
        SceneKind::Mesh { path, scale, is_z_up } => {
            let mesh = Arc::new(mesh_file::load(path, *scale)?);
            let quarter = if *is_z_up { -PI / 2.0 } else { 0.0 };
            let pose = upright * Isometry3::rotation(Vector3::x() * quarter);
            vec![still("mesh", mesh, pose, material)]
        }
    };
    Ok(Scene { objects })
}

/// A printed target with a white margin around the print, as on a real board.
fn board(texture: &BoardTexture, left_from_board: Isometry3<f64>) -> Object {
    let half_size_m = texture.size_m().map(|s| s / 2.0 + BOARD_MARGIN_M);
    let print = Material { texture: Texture::Board(Box::new(texture.clone())), gloss: None };
    still("board", Rectangle { half_size_m }, left_from_board, print)
}

/// Rods and strips around `distance_m`, in front of a plane 0.25 m behind.
fn wires(left_from_rig: &Isometry3<f64>, distance_m: f64, material: &Material) -> Vec<Object> {
    let at = |x: f64, y: f64, z: f64, roll_deg: f64| {
        left_from_rig
            * isometry(Vector3::new(x, y, z), [0.0, 0.0, 0.0])
            * isometry(Vector3::zeros(), [0.0, 0.0, roll_deg.to_radians()])
    };
    let mut objects =
        vec![still("plane", PLANE, at(0.0, 0.0, distance_m + 0.25, 0.0), material.clone())];
    let rod = Rod { radius_m: 0.0015, half_length_m: 0.20 };
    for (i, roll_deg) in [0.0, 3.0, -8.0, 20.0, -35.0, 60.0].into_iter().enumerate() {
        let x = -0.16 + 0.06 * i as f64;
        // Depths in an order that puts near beside far.
        let z = distance_m + 0.03 * ((i * 5) % 6) as f64 - 0.09;
        objects.push(still("rod", rod, at(x, -0.03, z, roll_deg), material.clone()));
    }
    for i in 0..6 {
        let z = distance_m + 0.18 - 0.06 * i as f64;
        let strip = Rectangle { half_size_m: [0.012, 0.03] };
        let pose = at(-0.15 + 0.055 * i as f64, 0.17, z, 0.0);
        objects.push(still("strip", strip, pose, material.clone()));
    }
    objects
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
