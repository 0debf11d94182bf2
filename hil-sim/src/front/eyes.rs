//! A simulated camera's pictures for its USB device.
//!
//! Two full-size cameras at 30 Hz are more than a small machine can render. A still scene under the
//! same light makes the same picture but for the sensor's noise, so pictures are kept: for each light
//! and exposure a few with noise of their own, out of whose rows every frame is put together anew. No
//! two frames are equal, and each pixel's noise is a real draw. A moving scene is rendered frame by
//! frame, as fast as that goes.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::bench::Bench;
use super::uvc::descriptors::PixelFormat;
use super::uvc::payload::CLOCK_HZ;
use super::uvc::{Frame, FrameSource, Settings};
use crate::rig::{CAMERAS, Exposure};
use crate::world::{Camera, LightInterval, LightSource, RawImage, World};

/// Pictures with noise of their own that are kept for one light and exposure.
const VARIANTS: usize = 4;

/// Lights and exposures of which pictures are kept: two timings' worth for each camera.
const KEYS: usize = 64;

/// What a picture of a still scene depends on, besides noise.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Key {
    camera: Camera,
    exposure_us: u64,
    gain_percent: u32,
    /// Each light's time within the exposure, microseconds.
    lights_us: Vec<(LightSource, u64)>,
}

impl Key {
    fn of(exposure: &Exposure, gain_percent: u32) -> Self {
        // Crystals differ by millionths and edges jitter by less than a microsecond: times that are equal
        // but for that are one key. A two-thousandth of the light is far less than a grey value.
        let us = |ns: u64| {
            let step_ns = (ns / 2000).next_multiple_of(1000).max(1000);
            (ns + step_ns / 2) / step_ns * step_ns / 1000
        };
        let mut lights_us: Vec<_> = exposure
            .lights
            .iter()
            .map(|light| {
                let (on, off) =
                    (light.on_ns.max(exposure.open_ns), light.off_ns.min(exposure.close_ns));
                (light.source, us(off.saturating_sub(on)))
            })
            .filter(|(_, lit_us)| *lit_us > 0)
            .collect();
        lights_us.sort_unstable();
        let exposure_us = us(exposure.close_ns - exposure.open_ns);
        Self { camera: exposure.camera, exposure_us, gain_percent, lights_us }
    }

    fn render(&self, world: &World, seed: u64) -> RawImage {
        let lights: Vec<_> = self
            .lights_us
            .iter()
            .map(|&(source, us)| LightInterval { source, on_ns: 0, off_ns: us * 1000 })
            .collect();
        let gain = f64::from(self.gain_percent) / 100.0;
        let close_ns = self.exposure_us * 1000;
        world.expose_with_gain(self.camera, 0, close_ns, &lights, gain, seed)
    }
}

/// Pictures of a scene, kept where it stands still.
pub struct FrameBank {
    world: Arc<World>,
    format: PixelFormat,
    /// As they are sent, each with noise of its own.
    kept: Mutex<BTreeMap<Key, Vec<Arc<Vec<u8>>>>>,
}

impl FrameBank {
    /// An empty bank of pictures that are sent as `format`.
    #[must_use]
    pub fn new(world: Arc<World>, format: PixelFormat) -> Self {
        Self { world, format, kept: Mutex::default() }
    }

    /// Makes all pictures of an exposure beforehand, where the scene stands still.
    pub fn prepare(&self, exposure: &Exposure, gain_percent: u32) {
        if self.world.is_still() {
            let key = Key::of(exposure, gain_percent);
            while self.variants(&key, 0).len() < VARIANTS {}
        }
    }

    /// The picture of an exposure, as it is sent.
    #[must_use]
    pub fn picture(&self, exposure: &Exposure, gain_percent: u32) -> Vec<u8> {
        let Exposure { camera, open_ns, close_ns, lights, .. } = exposure;
        if !self.world.is_still() {
            let gain = f64::from(gain_percent) / 100.0;
            let world = &self.world;
            let picture =
                world.expose_with_gain(*camera, *open_ns, *close_ns, lights, gain, *open_ns);
            return self.format.pack(&picture.data);
        }
        let variants = self.variants(&Key::of(exposure, gain_percent), *open_ns);
        let model = self.world.model();
        let height = match camera {
            Camera::Left => model.left.height,
            Camera::Right => model.right.height,
        };
        let row_bytes = variants[0].len() / height;
        let mut bytes = Vec::with_capacity(variants[0].len());
        // SplitMix64 over the exposure's time and the row.
        let mut state = *open_ns;
        for row in 0..height {
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut bits = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            let variant = &variants[((bits >> 40) % variants.len() as u64) as usize];
            bytes.extend_from_slice(&variant[row * row_bytes..][..row_bytes]);
        }
        bytes
    }

    /// The pictures that are there, after one more was made unless there are enough.
    fn variants(&self, key: &Key, seed: u64) -> Vec<Arc<Vec<u8>>> {
        let mut variants = self.lock().get(key).cloned().unwrap_or_default();
        if variants.len() < VARIANTS {
            // Rendered without the lock: the other camera goes on.
            let seed = seed.wrapping_mul(VARIANTS as u64).wrapping_add(variants.len() as u64);
            let picture = key.render(&self.world, seed);
            variants.push(Arc::new(self.format.pack(&picture.data)));
            let mut kept = self.lock();
            if kept.len() >= KEYS && !kept.contains_key(key) {
                kept.clear();
            }
            kept.insert(key.clone(), variants.clone());
        }
        variants
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, BTreeMap<Key, Vec<Arc<Vec<u8>>>>> {
        // Entries are put in whole.
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What happens to one of a camera's frames on its way, for tests of hosts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameFault {
    /// It is never sent; the camera's time goes on.
    Lost,
    /// It is sent twice.
    Duplicated,
    /// From now on every frame is sent one later than it should be.
    Lagging,
    /// Half of it is missing.
    Short,
    /// Its data are damaged, and the camera says so.
    Corrupt,
}

/// One of the sensor's cameras, or both as one that sends their pictures side by side.
pub struct Eye {
    bench: Arc<Bench>,
    bank: Arc<FrameBank>,
    /// What a picture shows, from left to right.
    cameras: Vec<Camera>,
    /// The camera's clock against the sensor's: offset in nanoseconds, drift in millionths.
    clock: (u64, i64),
    faults: Arc<Mutex<Vec<FrameFault>>>,
    again: Option<Frame>,
    lagging: Option<Frame>,
    lags: bool,
}

impl Eye {
    /// The camera of the sensor on `bench` before the scene of `bank`.
    #[must_use]
    pub fn new(bench: Arc<Bench>, bank: Arc<FrameBank>, camera: Camera) -> Self {
        let clock = match camera {
            Camera::Left => (41_234_567_891, 37),
            Camera::Right => (7_345_678_912, -52),
        };
        let (cameras, faults) = (vec![camera], Arc::default());
        Self { bench, bank, cameras, clock, faults, again: None, lagging: None, lags: false }
    }

    /// Both cameras as one, whose clock is the left one's.
    #[must_use]
    pub fn both(bench: Arc<Bench>, bank: Arc<FrameBank>) -> Self {
        Self { cameras: CAMERAS.into(), ..Self::new(bench, bank, Camera::Left) }
    }

    /// Faults to come, the next frame's last.
    #[must_use]
    pub fn faults(&self) -> Arc<Mutex<Vec<FrameFault>>> {
        Arc::clone(&self.faults)
    }

    fn ticks(&self, time_ns: u64) -> u32 {
        let (offset_ns, drift_ppm) = self.clock;
        let drift_ns = i128::from(time_ns) * i128::from(drift_ppm) / 1_000_000;
        let camera_ns = i128::from(offset_ns) + i128::from(time_ns) + drift_ns;
        (camera_ns * i128::from(CLOCK_HZ) / 1_000_000_000) as u32
    }

    fn take(&mut self, settings: Settings) -> Option<Frame> {
        let exposures: Vec<Exposure> = {
            let mut rig = self.bench.rig();
            let longest_ns = u64::from(settings.exposure_us) * 1000;
            for camera in &self.cameras {
                rig.set_longest_exposure_ns(*camera, Some(longest_ns));
            }
            if !self.cameras.iter().all(|camera| rig.is_ready(*camera)) {
                return None;
            }
            self.cameras.iter().filter_map(|camera| rig.take_ready(*camera)).collect()
        };
        let open_ns = exposures.first()?.open_ns;
        let mut pictures: Vec<Vec<u8>> =
            exposures.iter().map(|e| self.bank.picture(e, settings.gain_percent)).collect();
        let pixels = match pictures.len() {
            1 => pictures.swap_remove(0),
            _ => side_by_side(&pictures, self.bank.world.model().left.height),
        };
        let sof = self.bench.frame_number(open_ns);
        Some(Frame { pixels, exposure_ticks: self.ticks(open_ns), sof, is_damaged: false })
    }
}

/// Rows of all pictures, which have as many, one after the other.
fn side_by_side(pictures: &[Vec<u8>], height: usize) -> Vec<u8> {
    let row = |picture: &'_ Vec<u8>, y: usize| {
        let bytes = picture.len() / height;
        picture[y * bytes..][..bytes].to_vec()
    };
    (0..height).flat_map(|y| pictures.iter().flat_map(move |picture| row(picture, y))).collect()
}

impl FrameSource for Eye {
    fn start(&mut self) {
        (self.again, self.lagging, self.lags) = (None, None, false);
        let mut rig = self.bench.rig();
        self.cameras.iter().for_each(|camera| rig.start_camera(*camera));
    }

    fn stop(&mut self) {
        let mut rig = self.bench.rig();
        self.cameras.iter().for_each(|camera| rig.stop_camera(*camera));
    }

    fn poll(&mut self, settings: Settings) -> Option<Frame> {
        if let Some(again) = self.again.take() {
            return Some(again);
        }
        let mut frame = self.take(settings)?;
        let fault = self.faults.lock().unwrap_or_else(PoisonError::into_inner).pop();
        match fault {
            Some(FrameFault::Lost) => return None,
            Some(FrameFault::Duplicated) => self.again = Some(frame.clone()),
            Some(FrameFault::Lagging) => self.lags = true,
            Some(FrameFault::Short) => frame.pixels.truncate(frame.pixels.len() / 2),
            Some(FrameFault::Corrupt) => frame.is_damaged = true,
            None => {}
        }
        if self.lags {
            return self.lagging.replace(frame);
        }
        Some(frame)
    }

    fn clock(&self) -> (u32, u16) {
        let now_ns = self.bench.rig().now_ns();
        (self.ticks(now_ns), self.bench.frame_number(now_ns))
    }
}
