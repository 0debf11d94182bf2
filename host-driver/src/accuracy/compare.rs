//! Two ways to match the same recording, by their errors at the same pixels.

use serde::Serialize;
use stspp_matcher::Image;

use super::budget;
use super::score::OUTLIER_M;
use super::tables::{AccuracyError, Case};
use crate::DepthFrame;
use crate::reconstruct::Options;

/// Errors of two matches at pixels that both have within 5 mm of the truth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Compared {
    /// The scene.
    pub scene: String,
    /// Which of those pixels.
    pub pixels: &'static str,
    /// How many.
    pub count: usize,
    /// RMS of the first match's errors along the ray, in millimetres.
    pub rms_mm: f64,
    /// Of the second match's.
    pub reference_rms_mm: f64,
}

impl Compared {
    /// How much larger the first one's RMS is, as a part of the second's.
    pub fn excess(&self) -> f64 {
        self.rms_mm / self.reference_rms_mm - 1.0
    }
}

/// A circle of the scene, by both matches.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ComparedCircle {
    /// True radius in millimetres.
    pub radius_mm: f64,
    /// True centre in the left camera's frame, millimetres.
    pub centre_mm: [f64; 3],
    /// Whether it is a hole; unknown where neither match shows it.
    pub is_hole: Option<bool>,
    /// Error of the radius by the first match, in millimetres.
    pub radius_error_mm: Option<f64>,
    /// By the second.
    pub reference_radius_error_mm: Option<f64>,
}

/// Matches a case in two ways.
///
/// # Errors
/// From the matcher.
pub fn compare(
    case: &Case,
    scene: &str,
    frames: usize,
    options: Options,
    reference: Options,
) -> Result<(Vec<Compared>, Vec<ComparedCircle>), AccuracyError> {
    let (_, frame) = case.line(scene, frames, options)?;
    let (_, other) = case.line(scene, frames, reference)?;
    let truth = case.truth_for(options, frames);
    let distance = budget::step_distances(&frame, truth);
    let errors = |frame: &DepthFrame| {
        let mut errors = Image::new(frame.depth_m.width(), frame.depth_m.height(), f32::NAN);
        for y in 0..errors.height() {
            let depths = frame.depth_m.row(y).iter().zip(truth.depth_m.row(y));
            for (x, (to, (z, true_z))) in errors.row_mut(y).iter_mut().zip(depths).enumerate() {
                if (z - true_z).abs() <= OUTLIER_M {
                    *to = (truth.error_along_ray_m(x, y, *z) * 1e3) as f32;
                }
            }
        }
        errors
    };
    let (first, second) = (errors(&frame), errors(&other));
    let of = |pixels: &'static str, far: bool| {
        let (mut count, mut squares, mut reference) = (0usize, 0.0, 0.0);
        let both = first.as_slice().iter().zip(second.as_slice()).zip(distance.as_slice());
        for ((a, b), distance) in both {
            let wanted = !far || *distance > budget::NEAR_PX;
            if wanted && !a.is_nan() && !b.is_nan() {
                count += 1;
                squares += f64::from(a * a);
                reference += f64::from(b * b);
            }
        }
        let rms = |squares: f64| (squares / count.max(1) as f64).sqrt();
        Compared {
            scene: scene.to_owned(),
            pixels,
            count,
            rms_mm: rms(squares),
            reference_rms_mm: rms(reference),
        }
    };
    let lines = vec![of("all", false), of("over 8 px from steps", true)];
    let circles = case.circles(&frame, frames).into_iter().zip(case.circles(&other, frames));
    let circles = circles.map(|(a, b)| {
        let of = |circle: &super::circles::FoundCircle| circle.radius_error_m().map(|e| e * 1e3);
        let rim = a.rim.as_ref().or(b.rim.as_ref());
        ComparedCircle {
            radius_mm: a.radius_m * 1e3,
            centre_mm: (a.centre_m.coords * 1e3).into(),
            is_hole: rim.ok().map(|rim| rim.is_hole),
            radius_error_mm: of(&a),
            reference_radius_error_mm: of(&b),
        }
    });
    Ok((lines, circles.collect()))
}
