//! What the host asks. Each type names its reply in the [message table](crate::message).

use serde::{Deserialize, Serialize};

use crate::timing::ProjectionTiming;
use crate::trigger::TriggerSource;
use crate::version::ProtocolVersion;

/// Starts a session: streaming stops, the device disarms, and messages of the host's version follow.
///
/// Arming and settings need a session. Layout frozen over all major versions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// Protocol that the host speaks.
    pub host: ProtocolVersion,
}

/// Asks who the device is without touching its session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetInfo;

/// Says that the host is alive; any other valid request says so too.
///
/// While armed or running, a silence of
/// [`Limits::heartbeat_timeout_us`](crate::timing::Limits::heartbeat_timeout_us) is a fault. The reply's
/// device time lets the host fit device time to its own clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Heartbeat;

/// Asks for state, counters and sensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetStatus;

/// Asks for the timing that was accepted last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetTiming;

/// Replaces the timing. While running, the new one takes effect at the next slot-cycle boundary.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetTiming {
    /// The timing wanted.
    pub timing: ProjectionTiming,
}

/// Allows light. Refused while a fault is latched, the interlock is open, or there is no session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Arm;

/// Switches all light off at once and forbids it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Disarm;

/// Cycles through the slots until told otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct StartStream;

/// Ends a stream or burst after the slot that is under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopStream;

/// Triggers `frames` frames, from slot 0 on, cycling; then the device is armed again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct StartBurst {
    /// How many, at least 1.
    pub frames: u16,
}

/// Switches the floodlight on for a bounded time, outside of streaming (armed only).
///
/// A hardware timer ends it. Asking again while it is on restarts the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FloodlightOn {
    /// For how long, at most
    /// [`Limits::max_floodlight_on_us`](crate::timing::Limits::max_floodlight_on_us).
    pub duration_us: u32,
}

/// Switches the floodlight off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FloodlightOff;

/// Asks for the faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetFaults;

/// Unlatches every fault whose cause is gone. Light still needs a new [`Arm`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClearFaults;

/// Stores the timing so that the next power-on starts with it. Only while no light is allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SaveSettings;

/// Goes back to the stored settings. Only while no light is allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoadSettings;

/// Goes back to the settings of a new device, without storing them. Only while no light is allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoadDefaults;

/// Restarts the controller once the reply is out; light goes off first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reset;

/// Restarts into the bootloader for a firmware update; light goes off first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RebootToBootloader {
    /// [`BOOTLOADER_KEY`], against accidents.
    pub key: u32,
}

/// Chooses what starts the slots of the runs to come. Refused while running, and without
/// [`Capabilities::TRIGGER_IN`](crate::version::Capabilities::TRIGGER_IN). Since 1.1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetTriggerSource {
    /// What starts slots.
    pub source: TriggerSource,
}

/// Asks what starts slots, and for the count of edges. Since 1.1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetTriggerSource;

/// Key that [`RebootToBootloader`] must carry.
pub const BOOTLOADER_KEY: u32 = 0xB007_10AD;
