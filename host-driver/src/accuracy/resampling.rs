//! What the choice of the rectification's kernel and of its samples' depth costs: a plane's RMS for each.

use serde::Serialize;
use stspp_hil_sim::world::{SceneSpec, SensorModel};
use stspp_matcher::{Image, Matcher, SAMPLES_PER_DN8, Sample};

use super::score::central_plane_mm;
use super::tables::AccuracyError;
use super::{CanvasTruth, Capture};
use crate::reconstruct::{Options, RectifiedStack};
use crate::rectify::{Kernel, Rectifier};

/// A way to rectify, and the plane that comes of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Resampled {
    /// The kernel.
    pub kernel: String,
    /// Bits of the rectified samples: 14, or 8 as other software keeps them.
    pub bits: u8,
    /// Distance of the plane in metres.
    pub distance_m: f64,
    /// RMS of the plane fit over the central half, in millimetres.
    pub fit_rms_mm: f64,
    /// Mean error along the ray there, in millimetres.
    pub bias_mm: f64,
}

/// The ways that are compared; the first one is the product's.
const WAYS: [(Kernel, u8); 6] = [
    (Kernel::KaiserSinc, 14),
    (Kernel::KaiserSinc, 8),
    (Kernel::Lanczos4, 14),
    (Kernel::Keys, 14),
    (Kernel::Linear, 14),
    (Kernel::Linear, 8),
];

/// Simulates a plane once, and rectifies and matches it in every way. `progress` is told what begins.
///
/// # Errors
/// For a scene that cannot be simulated, and from the matcher.
pub fn plane(
    distance_m: f64,
    seed: u64,
    frames: usize,
    options: &Options,
    progress: &mut dyn FnMut(String),
) -> Result<Vec<Resampled>, AccuracyError> {
    let spec = SceneSpec::parse("plane", &[("distance_m", &distance_m.to_string())])?;
    let capture = Capture::record(&spec, SensorModel::with_seed(seed), frames, &mut |k| {
        progress(format!("plane at {distance_m} m: image {} of {frames}", k + 1));
    })?;
    let mut truth: Option<CanvasTruth> = None;
    let mut found = Vec::new();
    for (kernel, bits) in WAYS {
        progress(format!("plane at {distance_m} m: {kernel:?}, {bits} bits"));
        let rectifier = Rectifier::with_kernel(&capture.calibration, options.depth, kernel)?;
        let mut stack = RectifiedStack::new(rectifier, &capture.pairs, capture.labels.clone())?;
        if bits == 8 {
            stack.left.iter_mut().chain(&mut stack.right).for_each(round_to_8_bits);
        }
        let (geometry, mask) = (stack.rectifier.geometry(), stack.rectifier.left_mask());
        let centre_ns = capture.centre_ns(0..frames);
        // The canvas is the same for every kernel.
        let truth = truth
            .get_or_insert_with(|| CanvasTruth::trace(&capture.world, geometry, mask, centre_ns));
        let params = options.params_in(stack.rectifier.disparity_range());
        let frame = stack.depth_frame(&mut Matcher::new(params)?, 0..frames)?;
        let (fit_rms_mm, bias_mm) = central_plane_mm(&frame, truth).unwrap_or((f64::NAN, f64::NAN));
        let kernel = format!("{kernel:?}");
        found.push(Resampled { kernel, bits, distance_m, fit_rms_mm, bias_mm });
    }
    Ok(found)
}

fn round_to_8_bits(image: &mut Image<Sample>) {
    for v in image.as_mut_slice() {
        *v = (*v + SAMPLES_PER_DN8 / 2) / SAMPLES_PER_DN8 * SAMPLES_PER_DN8;
    }
}
