//! What the device pushes without being asked.
//!
//! Events count on their own sequence number in the frame header: a gap tells the host that events
//! were lost on the way (or dropped by a device whose link was full; then
//! [`Status::events_dropped`](crate::reply::Status::events_dropped) counts them too).

use serde::{Deserialize, Serialize};

use crate::fault::{FaultRecord, FaultSet};
use crate::reply::DeviceState;
use crate::version::{ProtocolVersion, ResetCause};

/// One camera trigger: the host labels the frame of each camera by it.
///
/// Sent when the slot is done, after its gate went off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TriggerEvent {
    /// Counts triggers since the controller's reset; never restarts in between, so no two frames of a
    /// boot share a number.
    pub frame_sequence: u32,
    /// Which slot of the timing lit this frame, from 0.
    pub slot_index: u8,
    /// Projectors that were on.
    pub projector_mask: u16,
    /// Whether the floodlight was on.
    pub floodlight: bool,
    /// Rise of the camera trigger (start of exposure), device time.
    pub trigger_time_us: u64,
    /// USB start-of-frame number (0..=2047) current at the rise; `None` where there is no USB.
    pub usb_sof: Option<u16>,
    /// Generation of the timing that lit the frame: frames of different generations belong to
    /// different patterns and are never matched together.
    pub timing_generation: u16,
}

/// A fault latched; the light is off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FaultEvent {
    /// What happened.
    pub record: FaultRecord,
    /// All faults latched now.
    pub latched: FaultSet,
}

/// The device went to another state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StateEvent {
    /// State that was left.
    pub from: DeviceState,
    /// State from now on.
    pub to: DeviceState,
    /// Device time of the change.
    pub time_us: u64,
    /// Number that the next frame will have: all lower ones have been triggered.
    pub next_frame_sequence: u32,
}

/// A new timing took effect at a slot-cycle boundary.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TimingEvent {
    /// Generation from now on.
    pub timing_generation: u16,
    /// First frame lit under it.
    pub first_frame_sequence: u32,
}

/// The controller started. A host that sees this in a session knows that the session is gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct BootEvent {
    /// Protocol that the device speaks.
    pub protocol: ProtocolVersion,
    /// Why it started.
    pub reset_cause: ResetCause,
    /// Faults that survived the reset.
    pub latched: FaultSet,
}
