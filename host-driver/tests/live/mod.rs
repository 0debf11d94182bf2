//! A small simulated sensor whose parts can be tampered with, and what its frames really show.
#![allow(dead_code, reason = "each test file uses its part")]

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use stspp::camera::{CameraError, CameraFrame, CameraSource};
use stspp::raw::RawPixels;
use stspp::sim::{Rig, SimOptions, SimSensor};
use stspp::sync::Side;
use stspp::transport::{Transport, TransportError};
use stspp::{RawImage, Sensor, SourceUri, StreamOptions};

/// A small random generator: the same faults every time.
pub struct Dice(pub u64);

impl Dice {
    /// A number below `sides`.
    pub fn roll(&mut self, sides: u64) -> u64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % sides
    }
}

/// What happens to a camera frame on its way.
pub type Tamper = Box<dyn FnMut(CameraFrame) -> Vec<CameraFrame> + Send>;

/// What happens to the bytes of one read from the device.
pub type Garble = Box<dyn FnMut(&mut Vec<u8>) + Send>;

/// Whether the host's bytes reach the device.
pub type Muted = Arc<std::sync::atomic::AtomicBool>;

struct TamperedCameras {
    inner: Box<dyn CameraSource>,
    tamper: Tamper,
    ready: VecDeque<CameraFrame>,
}

impl CameraSource for TamperedCameras {
    fn start(&mut self) -> Result<(), CameraError> {
        self.ready.clear();
        self.inner.start()
    }

    fn stop(&mut self) {
        self.inner.stop();
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Option<CameraFrame>, CameraError> {
        if self.ready.is_empty()
            && let Some(frame) = self.inner.next_frame(timeout)?
        {
            self.ready.extend((self.tamper)(frame));
        }
        Ok(self.ready.pop_front())
    }

    fn is_lossless(&self) -> bool {
        self.inner.is_lossless()
    }
}

struct TamperedLink {
    inner: Box<dyn Transport>,
    garble: Garble,
    muted: Muted,
}

impl Transport for TamperedLink {
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> Result<(), TransportError> {
        if self.muted.load(std::sync::atomic::Ordering::Acquire) {
            return Ok(());
        }
        self.inner.write(bytes, timeout)
    }

    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError> {
        let mut bytes = Vec::new();
        let read = self.inner.read(&mut bytes, timeout)?;
        (self.garble)(&mut bytes);
        into.append(&mut bytes);
        Ok(read)
    }
}

/// A simulated sensor under test.
pub struct Bench {
    pub sensor: Sensor,
    pub rig: Arc<Mutex<Rig>>,
    pub muted: Muted,
}

impl Bench {
    /// Opens `uri` with frames and link bytes going through `tamper` and `garble`.
    pub fn new(uri: &str, tamper: Tamper, garble: Garble) -> Self {
        let source: SourceUri = uri.parse().unwrap();
        let SourceUri::Sim { scene, options } = &source else { panic!("{uri} is not sim:") };
        let options = SimOptions::parse(scene.as_deref(), options).unwrap();
        let sim = SimSensor::new(&options).unwrap();
        let rig = Arc::clone(&sim.rig);
        let mut parts = sim.into_parts(source);
        let muted = Muted::default();
        parts.cameras =
            Box::new(TamperedCameras { inner: parts.cameras, tamper, ready: VecDeque::new() });
        parts.transport =
            Box::new(TamperedLink { inner: parts.transport, garble, muted: Arc::clone(&muted) });
        Self { sensor: Sensor::from_parts(parts).unwrap(), rig, muted }
    }

    /// As it is.
    pub fn honest(uri: &str) -> Self {
        Self::new(uri, Box::new(|frame| vec![frame]), Box::new(|_| {}))
    }

    pub fn rig(&self) -> MutexGuard<'_, Rig> {
        self.rig.lock().unwrap()
    }
}

fn pixels(image: &RawImage) -> Vec<f64> {
    let values: Vec<f64> = match &image.pixels {
        RawPixels::Gray8(image) => image.as_slice().iter().map(|&v| f64::from(v)).collect(),
        RawPixels::Gray16(image) => image.as_slice().iter().map(|&v| f64::from(v)).collect(),
    };
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.into_iter().map(|v| v - mean).collect()
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
}

/// Recognises by the pixels which projector lit an image: the witness that no label can fool.
pub struct Witness([Vec<Vec<f64>>; 2]);

impl Witness {
    /// Learns one cycle of ten projectors from an undisturbed sensor of the same scene.
    pub fn learn(uri: &str) -> Self {
        let mut sensor = Sensor::open(uri).unwrap();
        let pairs: Vec<_> =
            sensor.pairs(&StreamOptions::default()).unwrap().take(10).map(Result::unwrap).collect();
        let of = |side: Side| {
            let image = |pair: &stspp::LabelledPair| match side {
                Side::Left => pixels(&pair.left),
                Side::Right => pixels(&pair.right),
            };
            pairs.iter().map(image).collect()
        };
        Self([of(Side::Left), of(Side::Right)])
    }

    /// The projector that lit `image`.
    pub fn projector(&self, side: Side, image: &RawImage) -> usize {
        let image = pixels(image);
        let likeness: Vec<f64> =
            self.0[side.index()].iter().map(|known| correlation(known, &image)).collect();
        let best = (0..likeness.len()).max_by(|&a, &b| likeness[a].total_cmp(&likeness[b]));
        best.unwrap()
    }
}

/// Mean grey value.
pub fn brightness(image: &RawImage) -> f64 {
    match &image.pixels {
        RawPixels::Gray8(image) => {
            let sum: u64 = image.as_slice().iter().map(|&v| u64::from(v)).sum();
            sum as f64 / image.as_slice().len() as f64
        }
        RawPixels::Gray16(image) => {
            let sum: u64 = image.as_slice().iter().map(|&v| u64::from(v)).sum();
            sum as f64 / image.as_slice().len() as f64
        }
    }
}
