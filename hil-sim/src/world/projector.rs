//! The lights: speckle projectors (VCSEL tile copied by a diffractive element) and the floodlight.

use nalgebra::{Isometry3, Vector3};

use super::geometry::Rigid;
use super::noise::{KeyedRng, key};
use super::pattern::{Dot, DotGrid, emitter_tile};

/// A VCSEL + DOE speckle projector.
///
/// A collimating lens images the emitters of the VCSEL die into directions, and the diffractive
/// optical element (DOE) copies this tile of directions. In direction cosines a copy is a plain shift
/// by the order times wavelength over grating period, for any incidence (grating equation in conical
/// mounting), so copies are laid out in direction cosines here, and the pincushion shape on a flat
/// wall follows. A dot's beam has a fixed width in direction cosines for the same reason.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectorModel {
    /// Pose: z along the zero order, origin in the exit pupil.
    pub left_from_projector: Isometry3<f64>,
    /// Emitters on the die.
    pub emitters: usize,
    /// Smallest distance of two emitters, relative to the side of the square that each has on
    /// average. Irregular layouts exist up to about 0.8.
    pub emitter_min_distance: f64,
    /// Distance of neighbouring copies in direction cosines x, y: wavelength over grating period.
    pub tile_pitch: [f64; 2],
    /// Copies run over the orders -n..=n in x, y.
    pub doe_orders: [i32; 2],
    /// Standard deviation of a dot's beam in direction cosines, far away.
    pub dot_divergence_rad: f64,
    /// Standard deviation of a dot's beam in the exit pupil: near surfaces are hit by larger dots.
    pub aperture_sigma_m: f64,
    /// Electrons per second in the peak of a typical dot on a white surface at 1 m that faces the
    /// projector, in the centre of the image, before the camera's blur.
    pub peak_e_per_s: f64,
    /// Brightness of the undiffracted copy relative to its neighbours.
    pub zero_order_gain: f64,
    /// Relative standard deviation of the copies' brightness (the DOE's uniformity error).
    pub copy_variation: f64,
    /// Relative standard deviation of the emitters' brightness.
    pub emitter_variation: f64,
    /// Brightness of the outermost orders relative to the centre.
    pub outer_order_gain: f64,
    /// Seed of this module's emitter layout and variations.
    pub seed: u64,
}

impl Default for ProjectorModel {
    fn default() -> Self {
        Self {
            left_from_projector: Isometry3::identity(),
            emitters: 720,
            emitter_min_distance: 0.62,
            tile_pitch: [0.077, 0.077],
            doe_orders: [6, 5],
            dot_divergence_rad: 4.75e-4,
            aperture_sigma_m: 2.5e-4,
            peak_e_per_s: 4.1e5,
            zero_order_gain: 1.2,
            copy_variation: 0.06,
            emitter_variation: 0.06,
            outer_order_gain: 0.85,
            seed: 0,
        }
    }
}

impl ProjectorModel {
    /// The dots' directions in direction cosines x, y of the projector's frame.
    #[must_use]
    pub fn dot_directions(&self) -> Vec<[f64; 2]> {
        dots(self).iter().map(|dot| [dot.x, dot.y]).collect()
    }

    /// Makes dots and tile larger over the same field, for cameras with fewer pixels.
    pub(crate) fn enlarge_dots(&mut self, factor: usize) {
        let f = factor as f64;
        self.dot_divergence_rad *= f;
        self.aperture_sigma_m *= f;
        self.emitters = (self.emitters as f64 / (f * f)).ceil().max(1.0) as usize;
    }
}

/// The floodlight: an even wide beam.
#[derive(Debug, Clone, PartialEq)]
pub struct FloodlightModel {
    /// Pose: z along the beam's axis.
    pub left_from_floodlight: Isometry3<f64>,
    /// Electrons per second in the centre of the image of a white surface at 1 m that faces it.
    pub peak_e_per_s: f64,
    /// Exponent n of its beam cos^n(angle to the axis).
    pub beam_exponent: f64,
}

impl Default for FloodlightModel {
    fn default() -> Self {
        Self {
            left_from_floodlight: Isometry3::identity(),
            peak_e_per_s: 1.9e5,
            beam_exponent: 2.0,
        }
    }
}

/// A light ready to illuminate points: where it is and what it sends in which direction.
pub(crate) enum Light {
    /// A speckle projector with its dots.
    Speckle { pose: Rigid, dots: DotGrid, divergence: f64, aperture_m: f64 },
    /// The floodlight.
    Flood { pose: Rigid, peak: f64, exponent: f64 },
}

impl Light {
    pub fn speckle(model: &ProjectorModel) -> Self {
        Self::Speckle {
            pose: Rigid::from(&model.left_from_projector),
            dots: DotGrid::new(dots(model)),
            divergence: model.dot_divergence_rad,
            aperture_m: model.aperture_sigma_m,
        }
    }

    pub fn flood(model: &FloodlightModel) -> Self {
        Self::Flood {
            pose: Rigid::from(&model.left_from_floodlight),
            peak: model.peak_e_per_s,
            exponent: model.beam_exponent,
        }
    }

    /// Where the light comes from, in the left camera's frame.
    pub fn origin(&self) -> Vector3<f64> {
        match self {
            Self::Speckle { pose, .. } | Self::Flood { pose, .. } => pose.translation,
        }
    }
}

/// All dots of a projector in direction cosines, with their brightness at 1 m.
pub(crate) fn dots(model: &ProjectorModel) -> Vec<Dot> {
    let tile = emitter_tile(model.emitters, model.emitter_min_distance, key(model.seed, 1));
    let mut rng = KeyedRng::new(key(model.seed, 2));
    let emitter_gains: Vec<f64> =
        tile.iter().map(|_| (1.0 + model.emitter_variation * rng.normal()).max(0.2)).collect();
    let [nx, ny] = model.doe_orders;
    let mut dots = Vec::with_capacity(tile.len() * ((2 * nx + 1) * (2 * ny + 1)) as usize);
    for order_y in -ny..=ny {
        for order_x in -nx..=nx {
            let radius2 = (f64::from(order_x) / f64::from(nx.max(1))).powi(2)
                + (f64::from(order_y) / f64::from(ny.max(1))).powi(2);
            let mut gain = 1.0 - (1.0 - model.outer_order_gain) * radius2 / 2.0;
            gain *= (1.0 + model.copy_variation * rng.normal()).max(0.2);
            if order_x == 0 && order_y == 0 {
                gain = model.zero_order_gain;
            }
            for ([tx, ty], emitter) in tile.iter().zip(&emitter_gains) {
                let x = (f64::from(order_x) + tx - 0.5) * model.tile_pitch[0];
                let y = (f64::from(order_y) + ty - 0.5) * model.tile_pitch[1];
                // Directions beyond grazing are evanescent: the order does not exist.
                if x * x + y * y < 0.98 {
                    dots.push(Dot { x, y, peak: model.peak_e_per_s * gain * emitter });
                }
            }
        }
    }
    dots
}
