//! Recordings of simulated scenes with ideal timing: one projector a frame.

use stspp_hil_sim::world::{
    LightInterval, LightSource, RawImage as SimImage, SceneSpec, SensorModel, World, WorldError,
};
use stspp_matcher::Image;

use crate::raw::RawPixels;
use crate::recording::StereoPair;
use crate::sim::calibration_of;
use crate::{RawImage, SlotLabel, StereoCalibration};

/// The paper's timing: 30 frames a second, exposed for 32 ms.
const FRAME_PERIOD_US: u64 = 33_333;
const EXPOSURE_US: u64 = 32_000;

/// A simulated camera's image as a real one's.
pub fn raw_of(image: SimImage) -> RawImage {
    let (width, height, bits) = (image.width, image.height, image.bits);
    // The simulator's images have as many pixels as they say: no fill is ever seen.
    if bits <= 8 {
        let pixels = image.data.iter().map(|&v| v as u8).collect();
        let pixels = Image::from_vec(width, height, pixels);
        RawImage::gray8(pixels.unwrap_or_else(|| Image::new(width, height, 0)))
    } else {
        let pixels = Image::from_vec(width, height, image.data);
        RawImage::gray16(pixels.unwrap_or_else(|| Image::new(width, height, 0)), bits)
    }
}

/// A scene before the simulated sensor, and what its cameras recorded.
#[derive(Debug)]
pub struct Capture {
    /// The scene.
    pub world: World,
    /// The sensor's calibration, without error.
    pub calibration: StereoCalibration,
    /// One pair for each projector, in time order.
    pub pairs: Vec<StereoPair>,
    /// What lit each pair.
    pub labels: Vec<SlotLabel>,
}

impl Capture {
    /// Records `frames` pairs of a scene, pair k lit by projector k alone. `progress` is told each.
    ///
    /// # Errors
    /// For a scene or a sensor that cannot be simulated.
    pub fn record(
        scene: &SceneSpec,
        model: SensorModel,
        frames: usize,
        progress: &mut dyn FnMut(usize),
    ) -> Result<Self, WorldError> {
        Ok(Self::record_from(World::new(scene, model)?, 0, frames, progress))
    }

    /// Records `frames` pairs of a world from frame `first` of its time on: for scenes that move.
    pub fn record_from(
        world: World,
        first: usize,
        frames: usize,
        progress: &mut dyn FnMut(usize),
    ) -> Self {
        let calibration = calibration_of(world.model());
        let (mut pairs, mut labels) = (Vec::new(), Vec::new());
        for index in 0..frames {
            progress(index);
            let k = first + index;
            let trigger_time_us = k as u64 * FRAME_PERIOD_US;
            let (open_ns, close_ns) =
                (trigger_time_us * 1000, (trigger_time_us + EXPOSURE_US) * 1000);
            let projector = (index % world.model().projectors.len().max(1)) as u8;
            let light = LightInterval {
                source: LightSource::Projector(projector),
                on_ns: open_ns,
                off_ns: close_ns,
            };
            let (left, right) = world.expose_pair(open_ns, close_ns, &[light], k as u64);
            pairs.push(StereoPair { left: raw_of(left), right: raw_of(right) });
            labels.push(SlotLabel {
                sequence: k as u32,
                slot: index as u16,
                projector_mask: 1 << projector,
                floodlight: false,
                trigger_time_us,
                exposure_us: EXPOSURE_US as u32,
            });
        }
        Self { world, calibration, pairs, labels }
    }

    /// Part of the pixels, of both cameras, that are at full scale: their dots are cut off.
    pub fn saturated(&self) -> f64 {
        let (mut full, mut count) = (0_usize, 0_usize);
        for image in self.pairs.iter().flat_map(|pair| [&pair.left, &pair.right]) {
            let scale = image.full_scale();
            full += match &image.pixels {
                RawPixels::Gray8(pixels) => {
                    pixels.as_slice().iter().filter(|v| u16::from(**v) >= scale).count()
                }
                RawPixels::Gray16(pixels) => {
                    pixels.as_slice().iter().filter(|v| **v >= scale).count()
                }
            };
            count += image.width() * image.height();
        }
        full as f64 / count.max(1) as f64
    }

    /// Centre of the newest of the recording's first `frames` exposures, in nanoseconds of the scene's
    /// time.
    pub fn newest_ns(&self, frames: usize) -> u64 {
        let label = self.labels.get(frames.saturating_sub(1));
        label.map_or(0, |label| (label.exposure_centre_s() * 1e9) as u64)
    }

    /// Centre of the recording's exposures `first..first + frames` in nanoseconds of the scene's time.
    pub fn centre_ns(&self, frames: std::ops::Range<usize>) -> u64 {
        let times = self.labels[frames].iter().map(SlotLabel::exposure_centre_s);
        let (sum, count) = times.fold((0.0, 0), |(sum, n), t| (sum + t, n + 1));
        (sum / f64::from(count.max(1)) * 1e9) as u64
    }
}
