//! The sensor's parameters: what is bolted together, before any light is on.

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::camera::CameraModel;
use super::error::WorldError;
use super::geometry::isometry;
use super::noise::{KeyedRng, key};
use super::projector::{FloodlightModel, ProjectorModel};

/// Distance between the cameras of the default sensor (paper, Method).
const BASELINE_M: f64 = 0.4;
/// Angle between each camera and the sensor's z axis ("about 10°", paper, Method).
const TOE_IN_DEG: f64 = 10.0;
/// Projectors in a row between the cameras (paper, Figure 1).
const PROJECTORS: usize = 10;
/// Distance between neighbouring projectors.
const PROJECTOR_PITCH_M: f64 = 0.03;
/// Where the projectors' axes meet.
const PROJECTORS_AIM_M: f64 = 1.2;

/// Everything about the sensor that does not change while it runs.
///
/// Positions are in the frame of the left camera (cam0): x right, y down, z forward, metres.
/// [`Default`] is the sensor of the paper, as good as such hardware is and no better.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorModel {
    /// Camera 0, the frame's origin.
    pub left: CameraModel,
    /// Camera 1.
    pub right: CameraModel,
    /// Maps points of the left camera's frame to the right camera's (`T_cn_cnm1` of cam1 in a Kalibr
    /// file).
    pub right_from_left: Isometry3<f64>,
    /// The speckle projectors, in slot order.
    pub projectors: Vec<ProjectorModel>,
    /// The infrared floodlight.
    pub floodlight: FloodlightModel,
    /// Daylight and room light through the cameras' filter: electrons per second in the centre of
    /// the image of a white surface.
    pub ambient_e_per_s: f64,
    /// Seed of everything random: emitter layouts, module tolerances, noise.
    pub seed: u64,
}

impl Default for SensorModel {
    fn default() -> Self {
        Self::with_seed(1)
    }
}

impl SensorModel {
    /// The default sensor with other dot layouts, module tolerances and noise.
    #[must_use]
    pub fn with_seed(seed: u64) -> Self {
        let left = CameraModel {
            width: 1280,
            height: 1024,
            focal_px: [1861.4, 1860.7],
            principal_px: [643.6, 508.9],
            radtan: [-0.1042, 0.0873, 2.9e-4, -2.1e-4],
            vignetting_exponent: 4.0,
            blur_sigma_px: 0.6,
            full_well_e: 10_000.0,
            read_noise_e: 3.0,
            gain_dn_per_e: 0.0255,
            black_level_dn: 2.0,
            prnu: 0.003,
            bits: 8,
        };
        let right = CameraModel {
            focal_px: [1858.2, 1857.9],
            principal_px: [637.1, 514.3],
            radtan: [-0.1079, 0.0921, -1.8e-4, 3.3e-4],
            gain_dn_per_e: 0.0243,
            black_level_dn: 3.4,
            ..left.clone()
        };
        let rig_from_left = rig_from_camera(-BASELINE_M / 2.0, TOE_IN_DEG, [0.0, 0.0], [0.0, 0.0]);
        let rig_from_right =
            rig_from_camera(BASELINE_M / 2.0, -TOE_IN_DEG + 0.13, [7e-4, -9e-4], [0.16, -0.21]);
        Self::assemble(left, right, rig_from_right.inverse() * rig_from_left, seed)
    }

    /// Puts projectors and floodlight between two cameras.
    fn assemble(
        left: CameraModel,
        right: CameraModel,
        right_from_left: Isometry3<f64>,
        seed: u64,
    ) -> Self {
        let left_from_rig = left_from_rig(&right_from_left);
        let projectors = (0..PROJECTORS)
            .map(|i| module(i, &left_from_rig, key(seed, 0x9a0 + i as u64)))
            .collect();
        let floodlight = FloodlightModel {
            left_from_floodlight: left_from_rig * Isometry3::translation(0.0, 0.035, 0.0),
            ..FloodlightModel::default()
        };
        Self {
            left,
            right,
            right_from_left,
            projectors,
            floodlight,
            ambient_e_per_s: 4_000.0,
            seed,
        }
    }

    /// A sensor that differs from its own calibration: the right camera turned by these angles about
    /// its x (pitch), y (yaw) and z (roll) axes, as after a knock or a change of temperature.
    #[must_use]
    pub fn with_right_camera_turned(mut self, pitch_yaw_roll_deg: [f64; 3]) -> Self {
        let [pitch, yaw, roll] = pitch_yaw_roll_deg.map(f64::to_radians);
        let turned_from_right = isometry(Vector3::zeros(), [pitch, yaw, roll]);
        self.right_from_left = turned_from_right * self.right_from_left;
        self
    }

    /// A sensor of the same build within manufacturing tolerances: another rig, other lenses, other
    /// projectors. For tests that must not depend on the default's numbers.
    #[must_use]
    pub fn perturbed(seed: u64) -> Self {
        let mut rng = KeyedRng::new(key(seed, 0x7e57));
        let mut draw = |size: f64| size * rng.symmetric();
        let base = Self::with_seed(seed);
        let mut vary = |camera: &CameraModel| {
            let focal = draw(15.0);
            CameraModel {
                focal_px: [camera.focal_px[0] + focal, camera.focal_px[1] + focal + draw(1.0)],
                principal_px: camera.principal_px.map(|c| c + draw(12.0)),
                radtan: [
                    camera.radtan[0] + draw(0.03),
                    camera.radtan[1] + draw(0.03),
                    draw(5e-4),
                    draw(5e-4),
                ],
                gain_dn_per_e: camera.gain_dn_per_e * (1.0 + draw(0.06)),
                black_level_dn: camera.black_level_dn + draw(1.5),
                ..camera.clone()
            }
        };
        let (left, right) = (vary(&base.left), vary(&base.right));
        let rig_from_left =
            rig_from_camera(-BASELINE_M / 2.0, TOE_IN_DEG + draw(0.6), [0.0; 2], [0.0; 2]);
        let rig_from_right = rig_from_camera(
            BASELINE_M / 2.0 + draw(0.003),
            -TOE_IN_DEG + draw(0.6),
            [draw(0.002), draw(0.002)],
            [draw(0.4), draw(0.4)],
        );
        Self::assemble(left, right, rig_from_right.inverse() * rig_from_left, seed)
    }

    /// A sensor of another make: other optics, noise and mounting, and projectors with clumpier,
    /// unequal dots on smaller, more numerous tiles. Nothing may be tuned to one sensor's details;
    /// this one shows whether something was.
    #[must_use]
    pub fn alternate(seed: u64) -> Self {
        let left = CameraModel {
            focal_px: [1795.3, 1797.1],
            principal_px: [622.8, 531.2],
            radtan: [0.0487, -0.1216, -4.1e-4, 6.2e-4],
            vignetting_exponent: 5.5,
            blur_sigma_px: 0.72,
            full_well_e: 8_000.0,
            read_noise_e: 5.0,
            gain_dn_per_e: 0.0322,
            black_level_dn: 6.0,
            prnu: 0.006,
            ..Self::with_seed(seed).left
        };
        let right = CameraModel {
            focal_px: [1803.9, 1802.2],
            principal_px: [655.1, 498.6],
            radtan: [0.0532, -0.1301, 2.7e-4, -3.5e-4],
            gain_dn_per_e: 0.0298,
            black_level_dn: 3.5,
            ..left.clone()
        };
        let rig_from_left = rig_from_camera(-0.1925, 8.8, [0.0, 0.0], [0.0, 0.0]);
        let rig_from_right = rig_from_camera(0.1925, -9.3, [-1.8e-3, 2.3e-3], [-0.33, 0.41]);
        let right_from_left = rig_from_right.inverse() * rig_from_left;
        let mut model = Self::assemble(left, right, right_from_left, key(seed, 0xa17));
        for projector in &mut model.projectors {
            projector.emitters = 330;
            projector.emitter_min_distance = 0.35;
            projector.tile_pitch = projector.tile_pitch.map(|p| p * 0.675);
            projector.doe_orders = [9, 8];
            projector.dot_divergence_rad *= 1.08;
            projector.aperture_sigma_m = 1.5e-4;
            projector.peak_e_per_s *= 0.8;
            projector.zero_order_gain = 1.35;
            projector.copy_variation = 0.12;
            projector.emitter_variation = 0.15;
        }
        model
    }

    /// The same sensor with `1/factor` of the pixels in each direction and dots that many times
    /// larger, for fast tests: images look alike pixel for pixel, over the same field.
    ///
    /// # Panics
    /// If `factor` is 0.
    #[must_use]
    pub fn scaled_down(mut self, factor: usize) -> Self {
        assert!(factor > 0, "factor must be at least 1");
        self.left = self.left.scaled_down(factor);
        self.right = self.right.scaled_down(factor);
        for projector in &mut self.projectors {
            projector.enlarge_dots(factor);
        }
        self
    }

    /// Both cameras read out with another bit depth (8, 10 or 12).
    #[must_use]
    pub fn with_bits(mut self, bits: u8) -> Self {
        self.left = self.left.with_bits(bits);
        self.right = self.right.with_bits(bits);
        self
    }

    /// Whether the numbers make a sensor.
    pub(crate) fn check(&self) -> Result<(), WorldError> {
        let ensure = |holds: bool, what: &str| {
            if holds { Ok(()) } else { Err(WorldError::Model(what.into())) }
        };
        for (name, camera) in [("left", &self.left), ("right", &self.right)] {
            let c = camera;
            let positive = [c.focal_px[0], c.focal_px[1], c.full_well_e, c.gain_dn_per_e];
            let not_negative =
                [c.blur_sigma_px, c.read_noise_e, c.prnu, c.vignetting_exponent, c.black_level_dn];
            ensure(c.width > 0 && c.height > 0, &format!("the {name} camera has no pixels"))?;
            ensure(
                matches!(c.bits, 8 | 10 | 12),
                &format!("the {name} camera has {} bits; 8, 10 and 12 exist", c.bits),
            )?;
            ensure(
                positive.iter().all(|v| v.is_finite() && *v > 0.0),
                &format!("the {name} camera's focal length, full well and gain must be positive"),
            )?;
            ensure(
                not_negative.iter().all(|v| v.is_finite() && *v >= 0.0) && c.blur_sigma_px < 20.0,
                &format!("the {name} camera's blur, noise and levels must not be negative"),
            )?;
        }
        let baseline = self.right_from_left.translation.vector.norm();
        ensure(baseline.is_finite() && baseline > 1e-3, "the cameras are at the same place")?;
        for (i, p) in self.projectors.iter().enumerate() {
            let positive = [p.dot_divergence_rad, p.tile_pitch[0], p.tile_pitch[1]];
            ensure(
                positive.iter().all(|v| v.is_finite() && *v > 0.0)
                    && p.emitters > 0
                    && p.doe_orders.iter().all(|n| (0..=50).contains(n)),
                &format!("projector {i} needs emitters, orders 0 to 50 and positive angles"),
            )?;
            ensure(
                p.peak_e_per_s >= 0.0 && p.aperture_sigma_m >= 0.0,
                &format!("projector {i}'s power and aperture must not be negative"),
            )?;
        }
        Ok(())
    }

    /// The sensor's own frame: origin midway between the cameras, x along the baseline, z between
    /// the cameras' axes. Scenes are placed in it.
    #[must_use]
    pub fn left_from_rig(&self) -> Isometry3<f64> {
        left_from_rig(&self.right_from_left)
    }
}

/// A camera's pose in the sensor's frame: at `x_m` on the baseline, off by (y, z), turned about y,
/// then by (pitch, roll).
fn rig_from_camera(
    x_m: f64,
    yaw_deg: f64,
    [y_m, z_m]: [f64; 2],
    [pitch_deg, roll_deg]: [f64; 2],
) -> Isometry3<f64> {
    let pose = isometry(Vector3::new(x_m, y_m, z_m), [0.0, yaw_deg.to_radians(), 0.0]);
    pose * isometry(Vector3::zeros(), [pitch_deg.to_radians(), 0.0, roll_deg.to_radians()])
}

fn left_from_rig(right_from_left: &Isometry3<f64>) -> Isometry3<f64> {
    let left_from_right = right_from_left.inverse();
    let baseline = left_from_right.translation.vector;
    let x = baseline.normalize();
    let axes = Vector3::z() + left_from_right.rotation * Vector3::z();
    let z = (axes - x * axes.dot(&x)).normalize();
    let y = z.cross(&x);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, z]));
    Isometry3::from_parts((baseline / 2.0).into(), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// Projector `i` of the row, aimed with the others, mounted within tolerances. The modules are one
/// design; what makes their patterns differ is where they sit and how they are turned. The roll is
/// deliberate, never near zero: copies of the emitter tile that lie on one epipolar line would all
/// look alike.
fn module(i: usize, left_from_rig: &Isometry3<f64>, seed: u64) -> ProjectorModel {
    let mut rng = KeyedRng::new(seed);
    let x_m = (i as f64 - (PROJECTORS as f64 - 1.0) / 2.0) * PROJECTOR_PITCH_M;
    let yaw = -(x_m / PROJECTORS_AIM_M).atan() + 0.4_f64.to_radians() * rng.symmetric();
    let pitch = 0.4_f64.to_radians() * rng.symmetric();
    // 4 to 9 degrees in steps that no two modules share, alternating in sign.
    let step = ((i * 3) % PROJECTORS) as f64 + 0.8 * rng.uniform();
    let sign = if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    let roll = sign * (4.0 + 0.5 * step).to_radians();
    let rig_from_module = isometry(Vector3::new(x_m, 0.0, 0.0), [pitch, yaw, 0.0])
        * isometry(Vector3::zeros(), [0.0, 0.0, roll]);
    let design = ProjectorModel::default();
    ProjectorModel {
        left_from_projector: left_from_rig * rig_from_module,
        peak_e_per_s: design.peak_e_per_s * (1.0 + 0.05 * rng.symmetric()),
        tile_pitch: design.tile_pitch.map(|p| p * (1.0 + 0.01 * rng.symmetric())),
        dot_divergence_rad: design.dot_divergence_rad * (1.0 + 0.04 * rng.symmetric()),
        seed: rng.next_u64(),
        ..design
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::geometry::transform_point;

    #[test]
    fn the_rig_frame_sits_between_the_cameras() {
        let model = SensorModel::default();
        let rig_from_left = model.left_from_rig().inverse();
        let left = transform_point(&rig_from_left, &Vector3::zeros());
        let left_from_right = model.right_from_left.inverse();
        let right = transform_point(&rig_from_left, &left_from_right.translation.vector);
        assert!((left + right).norm() < 1e-12);
        assert!((right.x - left.x - 0.4).abs() < 1e-4 && right.y.abs() < 1e-12);
        let left_axis = rig_from_left.rotation * Vector3::z();
        assert!((left_axis.x.atan2(left_axis.z).to_degrees() - 10.0).abs() < 0.3);
    }

    #[test]
    fn a_turned_camera_keeps_its_place() {
        let model = SensorModel::default();
        let turned = model.clone().with_right_camera_turned([0.05, 0.0, 0.0]);
        let centre = |m: &SensorModel| m.right_from_left.inverse().translation.vector;
        assert!((centre(&model) - centre(&turned)).norm() < 1e-12);
        let angle = model.right_from_left.rotation.angle_to(&turned.right_from_left.rotation);
        assert!((angle.to_degrees() - 0.05).abs() < 1e-9);
    }
}
