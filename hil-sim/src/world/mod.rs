//! Light: scene, projectors, cameras, noise, ground truth.
//!
//! A [`World`] is a scene before a sensor. [`World::expose`] says what a camera's pixels read after an
//! exposure during which lights were on; [`World::truth`] says what is really there.
//!
//! How an image is made, step by step:
//! - `gbuffer`: rays from the camera find the surface behind every half pixel (`raster`: those of
//!   meshes without a search for each);
//! - `illuminate`: each light's dots or beam fall on it, unless something is in the way;
//! - `psf`: lens and pixel blur the cells into pixels;
//! - `expose`: each light counts as long as it was on during the exposure, then the sensor adds
//!   noise and rounds.
//!
//! Light is traced from lights to surfaces to cameras; light that bounces between surfaces is not,
//! and the lights' coherence (laser speckle within a dot) is not either.

mod board;
mod build;
mod camera;
mod error;
mod expose;
mod gbuffer;
mod geometry;
mod illuminate;
mod isosurface;
mod material;
mod mesh_file;
mod model;
mod noise;
mod panel;
mod part;
mod pattern;
mod projector;
mod psf;
mod raster;
mod scene;
mod shapes;
mod spec;
mod statue;
mod trimesh;
mod truth;

pub use board::BoardTexture;
pub use camera::CameraModel;
pub use error::WorldError;
pub use expose::{Camera, LightInterval, LightSource, RawImage};
pub use model::SensorModel;
pub use projector::{FloodlightModel, ProjectorModel};
pub use spec::{MaterialKind, OptionInfo, SceneInfo, SceneSpec, list_scenes};
pub use truth::{Primitive, PrimitiveShape, SurfaceMesh, SurfacePoint, Truth};

use nalgebra::Isometry3;

use expose::{CameraUnit, Lights};
use noise::key;
use projector::Light;
use scene::Scene;

/// A scene before a sensor.
pub struct World {
    model: SensorModel,
    scene: Scene,
    lights: Lights,
    left: CameraUnit,
    right: CameraUnit,
}

impl std::fmt::Debug for World {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names: Vec<_> = self.scene.objects.iter().map(|o| o.name).collect();
        f.debug_struct("World").field("objects", &names).finish_non_exhaustive()
    }
}

impl World {
    /// Puts a scene before a sensor.
    ///
    /// # Errors
    /// A mesh file that cannot be used, or a sensor model that contradicts physics.
    pub fn new(scene: &SceneSpec, model: SensorModel) -> Result<Self, WorldError> {
        model.check()?;
        let scene = build::build(scene, &model.left_from_rig())?;
        let lights = Lights::new(
            model.projectors.iter().map(Light::speckle).collect(),
            Light::flood(&model.floodlight),
            model.ambient_e_per_s,
        );
        let left = CameraUnit::new(&model.left, &Isometry3::identity(), key(model.seed, 0));
        let left_from_right = model.right_from_left.inverse();
        let right = CameraUnit::new(&model.right, &left_from_right, key(model.seed, 1));
        Ok(Self { model, scene, lights, left, right })
    }

    /// The sensor.
    #[must_use]
    pub fn model(&self) -> &SensorModel {
        &self.model
    }

    /// What a camera reads after an exposure from `open_ns` to `close_ns` during which `lights` were
    /// on; each light counts for exactly as long as its time and the exposure overlap. Moving scenes
    /// blur. Times are virtual, the scene's motion starts at 0.
    ///
    /// Frames with different `frame_seed` have different noise; the same arguments give the same
    /// image, on any number of threads. The first exposure to a light takes longest: a still scene's
    /// image of each light is kept.
    #[must_use]
    pub fn expose(
        &self,
        camera: Camera,
        open_ns: u64,
        close_ns: u64,
        lights: &[LightInterval],
        frame_seed: u64,
    ) -> RawImage {
        self.expose_with_gain(camera, open_ns, close_ns, lights, 1.0, frame_seed)
    }

    /// [`World::expose`] with an analog gain before the converter: signal and noise grow alike, and the
    /// full well is reached at fewer numbers than there are.
    #[must_use]
    pub fn expose_with_gain(
        &self,
        camera: Camera,
        open_ns: u64,
        close_ns: u64,
        lights: &[LightInterval],
        gain: f64,
        frame_seed: u64,
    ) -> RawImage {
        let unit = self.unit(camera);
        let electrons = unit.collect(&self.scene, &self.lights, open_ns, close_ns, lights);
        unit.read_out(&electrons, frame_seed, gain)
    }

    /// Whether nothing in the scene moves.
    #[must_use]
    pub fn is_still(&self) -> bool {
        self.scene.is_still()
    }

    /// [`World::expose`] of both cameras, triggered together.
    #[must_use]
    pub fn expose_pair(
        &self,
        open_ns: u64,
        close_ns: u64,
        lights: &[LightInterval],
        frame_seed: u64,
    ) -> (RawImage, RawImage) {
        (
            self.expose(Camera::Left, open_ns, close_ns, lights, frame_seed),
            self.expose(Camera::Right, open_ns, close_ns, lights, frame_seed),
        )
    }

    /// What is really there.
    #[must_use]
    pub fn truth(&self) -> Truth<'_> {
        Truth::new(self)
    }

    /// Name of an object, such as "sphere".
    ///
    /// # Panics
    /// If there is no such object.
    #[must_use]
    pub fn object_name(&self, object: usize) -> &'static str {
        self.scene.objects[object].name
    }

    fn unit(&self, camera: Camera) -> &CameraUnit {
        match camera {
            Camera::Left => &self.left,
            Camera::Right => &self.right,
        }
    }
}
