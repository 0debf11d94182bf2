//! Exposures: light over the gates' waveform, and the sensor's way from electrons to numbers.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex};

use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;

use super::camera::{CameraModel, full_scale};
use super::gbuffer::{GBuffer, Refinement, View};
use super::geometry::Rigid;
use super::illuminate::{ambient, illuminate};
use super::noise::{KeyedRng, key, read_pixel_e};
use super::projector::Light;
use super::psf::Response;
use super::raster::ShadowGrid;
use super::scene::{PosedScene, Scene};

/// One of the two cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Camera {
    /// Camera 0.
    Left,
    /// Camera 1.
    Right,
}

/// One of the sensor's lights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum LightSource {
    /// A speckle projector, by its slot in [`SensorModel::projectors`](super::SensorModel).
    Projector(u8),
    /// The floodlight.
    Floodlight,
}

/// A time during which a light is on. A light that the sensor does not have stays dark.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LightInterval {
    /// Which light.
    pub source: LightSource,
    /// Gate on.
    pub on_ns: u64,
    /// Gate off.
    pub off_ns: u64,
}

/// An image as the camera's sensor gives it: unrectified, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Bits per pixel; numbers are below `1 << bits`.
    pub bits: u8,
    /// Pixels, row by row.
    pub data: Vec<u16>,
}

impl RawImage {
    /// The pixels as bytes, if the image has 8 bits.
    #[must_use]
    pub fn to_gray8(&self) -> Option<Vec<u8>> {
        (self.bits <= 8).then(|| self.data.iter().map(|&v| v as u8).collect())
    }
}

/// Image of light per second at each pixel, vignetting included.
type RateImage = Arc<Vec<f32>>;

/// What makes an image: a light or the surroundings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Origin {
    Light(LightSource),
    Ambient,
}

/// A camera in the world, with the images of a still scene that were needed so far.
pub(crate) struct CameraUnit {
    pub model: CameraModel,
    pub left_from_camera: Rigid,
    response: Response,
    /// Vignetting times pixel sensitivity.
    sensitivity: Vec<f32>,
    noise_seed: u64,
    kept: Mutex<Kept>,
}

/// What later exposures use again.
#[derive(Default)]
struct Kept {
    /// Of a moving scene's view.
    directions: Option<Arc<Vec<[f32; 2]>>>,
    /// Of a still scene.
    gbuffer: Option<Arc<GBuffer>>,
    images: BTreeMap<Origin, RateImage>,
}

/// The scene's lights and surroundings.
pub(crate) struct Lights {
    pub projectors: Vec<Light>,
    pub floodlight: Light,
    pub ambient_e_per_s: f64,
    /// The last ones used, newest last: both cameras need them, one after the other.
    shadows: Mutex<VecDeque<(LightSource, u64, Shadows)>>,
}

/// What each object may put in the shadow of a light.
type Shadows = Arc<Vec<Option<ShadowGrid>>>;

/// Shadows that are kept: those of one exposure of a camera, unless it moves very fast.
const KEPT_SHADOWS: usize = 4;

impl Lights {
    pub fn new(projectors: Vec<Light>, floodlight: Light, ambient_e_per_s: f64) -> Self {
        Self { projectors, floodlight, ambient_e_per_s, shadows: Mutex::default() }
    }

    /// The shadows of a light in the scene at a time; `light` is what `source` names.
    fn shadows(
        &self,
        source: LightSource,
        light: &Light,
        posed: &PosedScene<'_>,
        time_ns: u64,
    ) -> Shadows {
        // As with the cameras' caches: entries are added whole.
        let lock = || self.shadows.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let is_it = |(s, t, _): &&(LightSource, u64, Shadows)| (*s, *t) == (source, time_ns);
        if let Some((_, _, shadows)) = lock().iter().find(is_it) {
            return Arc::clone(shadows);
        }
        let shadows = Arc::new(posed.shadows(&light.origin()));
        let mut kept = lock();
        if kept.len() >= KEPT_SHADOWS {
            kept.pop_front();
        }
        kept.push_back((source, time_ns, Arc::clone(&shadows)));
        shadows
    }

    fn get(&self, source: LightSource) -> Option<&Light> {
        match source {
            LightSource::Projector(i) => self.projectors.get(usize::from(i)),
            LightSource::Floodlight => Some(&self.floodlight),
        }
    }
}

/// Movement in the image within one sub-exposure, in pixels, below which it is not divided. What is
/// left out is a blur of the same length, 0.08 px^2 of variance at its most, where lens and pixel have
/// 0.44; and it is only edges that it blurs: dots stay where their projector sends them.
const SHARP_PX: f64 = 1.0;
/// Most sub-exposures of one light.
const MOST_SUB_EXPOSURES: u64 = 16;

impl CameraUnit {
    pub fn new(model: &CameraModel, left_from_camera: &Isometry3<f64>, seed: u64) -> Self {
        let mut sensitivity = vec![0.0_f32; model.width * model.height];
        sensitivity.par_chunks_mut(model.width).enumerate().for_each(|(v, line)| {
            for (u, out) in line.iter_mut().enumerate() {
                let cosine = model.ray_direction([u as f64, v as f64]).z;
                let pixel = key(seed, (v * model.width + u) as u64);
                let gain = 1.0 + model.prnu * KeyedRng::new(pixel).normal();
                *out = (cosine.powf(model.vignetting_exponent) * gain.max(0.0)) as f32;
            }
        });
        Self {
            model: model.clone(),
            left_from_camera: Rigid::from(left_from_camera),
            response: Response::new(model.blur_sigma_px),
            sensitivity,
            noise_seed: key(seed, 0xf4a),
            kept: Mutex::default(),
        }
    }

    /// Electrons of each pixel after an exposure, before any noise.
    pub fn collect(
        &self,
        scene: &Scene,
        lights: &Lights,
        open_ns: u64,
        close_ns: u64,
        intervals: &[LightInterval],
    ) -> Vec<f32> {
        let mut electrons = vec![0.0_f32; self.model.width * self.model.height];
        let mut add = |image: &[f32], seconds: f64| {
            electrons
                .par_iter_mut()
                .zip(image)
                .for_each(|(sum, rate)| *sum += rate * seconds as f32);
        };
        let overlaps = intervals.iter().filter_map(|light| {
            let (on, off) = (light.on_ns.max(open_ns), light.off_ns.min(close_ns));
            (on < off).then_some((light.source, on, off))
        });
        let open_s = close_ns.saturating_sub(open_ns) as f64 * 1e-9;
        let surroundings_s = if lights.ambient_e_per_s > 0.0 { open_s } else { 0.0 };
        if scene.is_still() {
            for (source, on, off) in overlaps {
                if lights.get(source).is_some() {
                    let image = self.still_image(scene, lights, Origin::Light(source));
                    add(&image, (off - on) as f64 * 1e-9);
                }
            }
            if surroundings_s > 0.0 {
                add(&self.still_image(scene, lights, Origin::Ambient), surroundings_s);
            }
        } else {
            let mut views = BTreeMap::new();
            for (source, on, off) in overlaps {
                if lights.get(source).is_none() {
                    continue;
                }
                let parts = self.sub_exposures(scene, [on, off]);
                for part in 0..parts {
                    let time_ns = on + (off - on) * (2 * part + 1) / (2 * parts);
                    let gbuffer = views.entry(time_ns).or_insert_with(|| self.look(scene, time_ns));
                    let image = self.image(scene, lights, gbuffer, time_ns, Origin::Light(source));
                    add(&image, (off - on) as f64 * 1e-9 / parts as f64);
                }
            }
            if surroundings_s > 0.0 {
                // Ambient light is weak: one look is enough, the one in the middle if there is any.
                let middle = views.keys().nth(views.len() / 2).copied();
                let time_ns = middle.unwrap_or(open_ns / 2 + close_ns / 2);
                let gbuffer = views.entry(time_ns).or_insert_with(|| self.look(scene, time_ns));
                let image = self.image(scene, lights, gbuffer, time_ns, Origin::Ambient);
                add(&image, surroundings_s);
            }
        }
        electrons
    }

    fn sub_exposures(&self, scene: &Scene, times_ns: [u64; 2]) -> u64 {
        let project =
            |p: &Vector3<f64>| self.model.project(&self.left_from_camera.inverse_point(p));
        let moved_px = scene.image_motion_px(times_ns, project, self.model.focal_px[0]);
        ((moved_px / SHARP_PX).ceil() as u64).clamp(1, MOST_SUB_EXPOSURES)
    }

    fn view(&self) -> View<'_> {
        View {
            camera: &self.model,
            left_from_camera: self.left_from_camera,
            margin: self.response.margin(),
        }
    }

    fn look(&self, scene: &Scene, time_ns: u64) -> GBuffer {
        let view = self.view();
        let known = self.lock().directions.clone();
        let directions = known.unwrap_or_else(|| Arc::new(view.directions()));
        let mut refinement = Refinement::Sharp;
        if !scene.is_still() {
            if scene.speed_m_per_s() > 0.0 {
                refinement = Refinement::Coarse;
            }
            // Every frame needs them again.
            self.lock().directions.get_or_insert_with(|| Arc::clone(&directions));
        }
        GBuffer::new(&view, &directions, &scene.at(time_ns), refinement)
    }

    /// The image of a still scene, made when first asked for. Nothing is computed under the lock: a
    /// worker that waits for its share could be handed another exposure of this camera meanwhile.
    fn still_image(&self, scene: &Scene, lights: &Lights, origin: Origin) -> RateImage {
        let known = |kept: &Kept| kept.images.get(&origin).cloned();
        let gbuffer = {
            let kept = self.lock();
            if let Some(image) = known(&kept) {
                return image;
            }
            kept.gbuffer.clone()
        };
        let gbuffer = gbuffer.unwrap_or_else(|| {
            let gbuffer = Arc::new(self.look(scene, 0));
            self.lock().gbuffer.get_or_insert(gbuffer).clone()
        });
        let image = Arc::new(self.image(scene, lights, &gbuffer, 0, origin));
        self.lock().images.entry(origin).or_insert(image).clone()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Kept> {
        // A panic elsewhere cannot leave the cache half-written: entries are added whole.
        self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn image(
        &self,
        scene: &Scene,
        lights: &Lights,
        gbuffer: &GBuffer,
        time_ns: u64,
        origin: Origin,
    ) -> Vec<f32> {
        let cells = match origin {
            Origin::Ambient => ambient(gbuffer, lights.ambient_e_per_s),
            Origin::Light(source) => match lights.get(source) {
                Some(light) => {
                    let centre = &self.left_from_camera.translation;
                    let posed = scene.at(time_ns);
                    let shadows = lights.shadows(source, light, &posed, time_ns);
                    illuminate(light, gbuffer, &posed, &shadows, centre)
                }
                None => vec![0.0; gbuffer.cells.len()],
            },
        };
        let (width, height) = (self.model.width, self.model.height);
        let mut image = self.response.apply(&cells, gbuffer.columns, width, height);
        image.iter_mut().zip(&self.sensitivity).for_each(|(rate, s)| *rate *= s);
        image
    }

    /// Electrons to numbers: shot noise, read noise, full well, gain, black level, quantisation.
    pub fn read_out(&self, electrons: &[f32], frame_seed: u64, gain: f64) -> RawImage {
        let m = &self.model;
        let frame_key = key(self.noise_seed, frame_seed);
        let (gain, black) = ((m.gain_dn_per_e * gain) as f32, m.black_level_dn as f32);
        let (full_well, top) = (m.full_well_e as f32, full_scale(m.bits) as f32);
        let mut data = vec![0_u16; electrons.len()];
        data.par_chunks_mut(m.width).enumerate().for_each(|(v, line)| {
            for (u, out) in line.iter_mut().enumerate() {
                let index = v * m.width + u;
                let e = read_pixel_e(
                    key(frame_key, index as u64),
                    electrons[index],
                    m.read_noise_e as f32,
                );
                let dn = e.min(full_well) * gain + black;
                *out = (dn + 0.5).clamp(0.0, top) as u16;
            }
        });
        RawImage { width: m.width, height: m.height, bits: m.bits, data }
    }
}
