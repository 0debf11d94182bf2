//! Where to hold a board: a tour of poses that determines every unknown, and what the cameras would
//! see of it. The simulator moves boards along it, and the statistical tests draw their sightings
//! from it.

use nalgebra::{Isometry3, Point2, Point3, Translation3, UnitQuaternion, Vector2, Vector3};

use super::Board;
use super::observations::{Observations, Sighting, View};
use crate::StereoCalibration;
use crate::rectify::rect_from_left;

/// Distances that the tour goes through, as parts of the range from near to far.
const DISTANCES: [f64; 5] = [0.0, 0.62, 0.22, 1.0, 0.4];
/// Parts of the image, from its middle, that boards are centred on; the first two are the corners.
const PLACES: [[f64; 2]; 9] = [
    [0.0, 0.0],
    [-0.72, -0.68],
    [0.72, 0.68],
    [0.72, -0.68],
    [-0.72, 0.68],
    [-0.7, 0.0],
    [0.7, 0.0],
    [0.0, -0.66],
    [0.0, 0.66],
];

/// Numbers that look random and repeat with their seed.
#[derive(Debug, Clone)]
pub struct Draw(u64);

impl Draw {
    /// A sequence for a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5bd1_e995_7b93_a1c5)
    }

    /// Uniform in 0..1 (SplitMix64).
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Uniform in -1..1.
    pub fn symmetric(&mut self) -> f64 {
        2.0 * self.uniform() - 1.0
    }

    /// Normal with variance 1 (Box-Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// What a tour visits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tour {
    /// Poses.
    pub views: usize,
    /// Nearest and farthest distance of the board's middle.
    pub depth_m: [f64; 2],
    /// Least and largest angle between the board's normal and the sensor's axis.
    pub tilt_deg: [f64; 2],
    /// Directions of the tilt: `None` for all round, or one direction only.
    pub tilt_direction_deg: Option<f64>,
    /// Part of the image, from its middle to the sides, that the board's middle visits: left, right.
    pub across: [f64; 2],
    /// Seed of what is left to chance.
    pub seed: u64,
}

impl Default for Tour {
    fn default() -> Self {
        Self {
            views: 25,
            depth_m: [0.85, 1.95],
            tilt_deg: [12.0, 40.0],
            tilt_direction_deg: None,
            across: [-1.0, 1.0],
            seed: 1,
        }
    }
}

impl Tour {
    /// Board poses in the left camera's frame.
    pub fn left_from_board(&self, rig: &StereoCalibration) -> Vec<Isometry3<f64>> {
        let mut draw = Draw::new(self.seed);
        let facing = facing(rig);
        (0..self.views)
            .map(|k| {
                let near_to_far = DISTANCES[k % DISTANCES.len()] + 0.06 * draw.symmetric();
                let [near, far] = self.depth_m;
                let depth_m = near + (far - near) * near_to_far.clamp(0.0, 1.0);
                let [mut x, y] = PLACES[(k * 4) % PLACES.len()];
                x = x.clamp(self.across[0], self.across[1]) + 0.06 * draw.symmetric();
                let y = y + 0.06 * draw.symmetric();
                // Every place is shown to the left camera, then to the right one.
                let side = k / PLACES.len() % 2;
                let middle = place(rig, side, [x, y], depth_m);
                let [least, most] = self.tilt_deg.map(f64::to_radians);
                let tilt = least + (most - least) * draw.uniform();
                // Steps of the golden angle go all round evenly, whatever the number of views.
                let direction = match self.tilt_direction_deg {
                    Some(degrees) => degrees.to_radians(),
                    None => k as f64 * 2.399_963,
                };
                let axis = Vector3::new(direction.cos(), direction.sin(), 0.0);
                let rotation = UnitQuaternion::from_scaled_axis(axis * tilt)
                    * UnitQuaternion::from_scaled_axis(Vector3::z() * 0.25 * draw.symmetric());
                Isometry3::from_parts(Translation3::from(middle), facing * rotation)
            })
            .collect()
    }
}

/// Rotation of a board that faces the sensor upright, in the left camera's frame.
fn facing(rig: &StereoCalibration) -> UnitQuaternion<f64> {
    let rect_from_left = rect_from_left(rig).unwrap_or_default();
    UnitQuaternion::from_rotation_matrix(&rect_from_left.inverse())
}

/// The point at `depth_m` that camera `side` sees at a place of its image, in the left camera's frame.
fn place(rig: &StereoCalibration, side: usize, [x, y]: [f64; 2], depth_m: f64) -> Vector3<f64> {
    let camera = if side == 0 { &rig.left } else { &rig.right };
    let half = camera.resolution_px.map(|size| size as f64 / 2.0);
    let pixel = Vector2::new(half[0] * (1.0 + x), half[1] * (1.0 + y));
    let ray = camera.normalised_of_pixel(pixel).unwrap_or_default();
    let in_camera = Point3::new(ray.x, ray.y, 1.0) * depth_m;
    if side == 0 {
        in_camera.coords
    } else {
        rig.right_from_left.inverse_transform_point(&in_camera).coords
    }
}

/// What the cameras of `rig` see of the board at these poses, each coordinate off by normal noise of
/// `sigma_px`. Points outside an image or behind a camera are not seen.
pub fn sightings(
    rig: &StereoCalibration,
    board: &Board,
    left_from_board: &[Isometry3<f64>],
    sigma_px: f64,
    draw: &mut Draw,
) -> Observations {
    sightings_of_print(rig, board, &|p| p, left_from_board, sigma_px, draw)
}

/// [`sightings`] of a print that is not as the board says: `print` tells where a point really is.
pub fn sightings_of_print(
    rig: &StereoCalibration,
    board: &Board,
    print: &dyn Fn(Point2<f64>) -> Point2<f64>,
    left_from_board: &[Isometry3<f64>],
    sigma_px: f64,
    draw: &mut Draw,
) -> Observations {
    let margin_px = 8.0;
    let mut see = |side: usize, left_from_board: &Isometry3<f64>| {
        let (camera, pose) = if side == 0 {
            (&rig.left, *left_from_board)
        } else {
            (&rig.right, rig.right_from_left * left_from_board)
        };
        let [width, height] = camera.resolution_px.map(|size| size as f64 - 1.0 - margin_px);
        (0..board.point_count())
            .filter_map(|point| {
                let p = print(board.point_m(point));
                let mut pixel = camera.project(&(pose * Point3::new(p.x, p.y, 0.0)))?;
                if let Some(radius_m) = board.disc_radius_m() {
                    pixel += super::eccentricity::of_disc(camera, &pose, p, radius_m)?;
                }
                let is_inside =
                    (margin_px..width).contains(&pixel.x) && (margin_px..height).contains(&pixel.y);
                pixel += Vector2::new(draw.normal(), draw.normal()) * sigma_px;
                is_inside.then_some(Sighting { point, pixel })
            })
            .collect::<Vec<_>>()
    };
    let views = left_from_board
        .iter()
        .enumerate()
        .map(|(k, pose)| View { name: format!("{k:02}"), left: see(0, pose), right: see(1, pose) })
        .collect();
    Observations { board: *board, resolution_px: rig.left.resolution_px, views }
}
