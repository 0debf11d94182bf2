//! From triggers and camera frames to windows of labelled stereo pairs.
//!
//! Everything here is a state machine without threads, clocks or hardware: times are arguments, what
//! happened to every frame comes out.
//!
//! - [`fit`]: a camera's clock as a line over the device's.
//! - [`pairer`]: which trigger a camera frame belongs to, and which two frames make a pair.
//! - [`lock`]: how a camera's clock is tied to the device's in the first place.
//! - [`window`]: the last N pairs, complete and consistent, or not at all.
//!
//! Invariants: a frame is labelled by a trigger event only when its timestamp and its sequence number
//! agree on that event; every frame that goes in comes out exactly once, in a pair or with the cause
//! of its rejection; a window never holds two pairs of one trigger or of two timings.

pub mod fit;
pub mod lock;
pub mod pairer;
pub mod window;

use serde::{Deserialize, Serialize};

/// One of the two cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// Camera 0.
    Left,
    /// Camera 1.
    Right,
}

impl Side {
    /// Both sides, left first.
    pub const BOTH: [Side; 2] = [Side::Left, Side::Right];

    /// 0 for the left camera, 1 for the right one.
    pub fn index(self) -> usize {
        self as usize
    }
}

impl std::fmt::Display for Side {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Side::Left => "left",
            Side::Right => "right",
        })
    }
}

/// What is known of a camera frame besides its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameStamp {
    /// Which camera.
    pub side: Side,
    /// The camera's own count of frames; 0 is the first after the camera was started.
    pub sequence: u32,
    /// The camera's own timestamp in nanoseconds of its clock: any fixed point of the exposure.
    pub timestamp_camera_ns: u64,
    /// When the frame was complete on the host, in nanoseconds of the host's clock.
    pub arrival_host_ns: u64,
    /// Fingerprint of the pixels, where they have enough noise for two frames never to be equal.
    pub fingerprint: Option<u64>,
    /// USB frame number (0..=2047, one a millisecond) at the start of exposure, where the camera tells it
    /// and is on the device's bus.
    pub usb_sof: Option<u16>,
}

/// A trigger event as it reached the host.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trigger {
    /// What the device said of it.
    pub label: crate::SlotLabel,
    /// Generation of the timing that lit the exposure.
    pub timing_generation: u16,
    /// When the event reached the host, in nanoseconds of the host's clock.
    pub arrival_host_ns: u64,
    /// USB frame number at the start of exposure, where the device is on USB.
    pub usb_sof: Option<u16>,
}

/// USB frame numbers by which two samples of one instant may differ: each is rounded, and the camera's
/// is carried back over the read-out.
const SOF_TOLERANCE: u16 = 2;

impl Trigger {
    /// Whether the USB frame number at this trigger is that of `stamp`'s exposure; `None` where either
    /// has none. Frame numbers come again after 2.048 s.
    pub fn sof_agrees(&self, stamp: &FrameStamp) -> Option<bool> {
        const MODULUS: u16 = stspp_protocol::usb::SOF_MODULUS;
        let ahead = (stamp.usb_sof? % MODULUS + MODULUS - self.usb_sof? % MODULUS) % MODULUS;
        Some(ahead <= SOF_TOLERANCE || ahead >= MODULUS - SOF_TOLERANCE)
    }

    /// Start of the exposure in nanoseconds of the device's clock.
    pub fn time_device_ns(&self) -> u64 {
        self.label.trigger_time_us.saturating_mul(1000)
    }

    /// Length of the exposure in nanoseconds.
    pub fn exposure_ns(&self) -> u64 {
        u64::from(self.label.exposure_us) * 1000
    }
}
