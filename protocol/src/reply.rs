//! What the device answers.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::fault::FaultSet;
use crate::timing::{ProjectionTiming, TimingError};
use crate::version::{PROTOCOL_VERSION, ProtocolVersion};

/// What the device is doing; drawn in `docs/protocol.md`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DeviceState {
    /// No light allowed.
    Idle,
    /// Light allowed, none from the sequencer; the floodlight may be on.
    Armed,
    /// The sequencer cycles through the slots.
    Running,
    /// A fault is latched: no light until cleared and armed again.
    Faulted,
}

impl fmt::Display for DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            DeviceState::Idle => "idle",
            DeviceState::Armed => "armed",
            DeviceState::Running => "running",
            DeviceState::Faulted => "faulted",
        })
    }
}

/// Done; nothing more to say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done;

/// Answer to [`Heartbeat`](crate::request::Heartbeat).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Alive {
    /// Device time when the request was handled.
    pub device_time_us: u64,
    /// State.
    pub state: DeviceState,
}

/// The timing in force or accepted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActiveTiming {
    /// The timing.
    pub timing: ProjectionTiming,
    /// Generation that its frames carry.
    pub timing_generation: u16,
    /// Whether it waits for the end of a running slot cycle.
    pub pending: bool,
}

/// Answer to [`SetTiming`](crate::request::SetTiming).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimingAccepted {
    /// Generation that frames lit under the new timing will carry.
    pub timing_generation: u16,
    /// Whether it waits for the end of the running slot cycle.
    pub pending: bool,
}

/// Answer to [`StartStream`](crate::request::StartStream) and
/// [`StartBurst`](crate::request::StartBurst).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Started {
    /// Number of the first frame.
    pub first_frame_sequence: u32,
    /// Generation of the timing that lights it.
    pub timing_generation: u16,
    /// Device time at which slot 0 starts.
    pub start_time_us: u64,
}

/// Answer to [`StopStream`](crate::request::StopStream).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stopping {
    /// One more than the number of the last frame that is or will be triggered.
    pub end_frame_sequence: u32,
}

/// Counters of the link as the device sees it, since reset; they wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkCounters {
    /// Valid frames received.
    pub frames_received: u32,
    /// Frames dropped for their CRC, their encoding or their length.
    pub frames_rejected: u32,
    /// Bytes lost before they could be read (receiver overrun).
    pub bytes_overrun: u32,
}

/// Answer to [`GetStatus`](crate::request::GetStatus).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Status {
    /// What the device is doing.
    pub state: DeviceState,
    /// Device time when the request was handled.
    pub device_time_us: u64,
    /// Whether a [`Hello`](crate::request::Hello) of a compatible host has been seen.
    pub session: bool,
    /// Latched faults.
    pub latched: FaultSet,
    /// Interlock input: closed allows light.
    pub interlock_closed: bool,
    /// Temperature at the projectors in tenths of a degree Celsius.
    pub temperature_dc: i16,
    /// Generation of the timing accepted last.
    pub timing_generation: u16,
    /// Number of the next frame: all lower ones have been triggered.
    pub next_frame_sequence: u32,
    /// Whether the floodlight is on by request.
    pub floodlight_on: bool,
    /// Events that found the outgoing queue full, since reset.
    pub events_dropped: u32,
    /// The link.
    pub link: LinkCounters,
}

/// A request field that was out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RequestField {
    /// [`StartBurst::frames`](crate::request::StartBurst::frames).
    BurstFrames,
    /// [`FloodlightOn::duration_us`](crate::request::FloodlightOn::duration_us).
    FloodlightDurationUs,
    /// [`RebootToBootloader::key`](crate::request::RebootToBootloader::key).
    BootloaderKey,
    /// [`ExternalTrigger::delay_us`](crate::trigger::ExternalTrigger::delay_us). Since 1.1.
    TriggerDelayUs,
}

/// What went wrong with the settings store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StorageError {
    /// Nothing is stored.
    Empty,
    /// Writing failed; what was stored before is still there.
    Write,
    /// What is stored is damaged, or cannot be read.
    Read,
}

/// Why a request was refused. A refused request has changed nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RequestError {
    /// The host's major version is not the device's. Layout frozen over all majors.
    VersionMismatch {
        /// What the device speaks.
        device: ProtocolVersion,
    },
    /// The device does not know this message id. Layout frozen over all majors.
    UnknownMessage {
        /// The id.
        id: u8,
    },
    /// The body is not that of this message.
    Malformed {
        /// The id.
        id: u8,
    },
    /// No [`Hello`](crate::request::Hello) yet.
    NoSession,
    /// Not possible in this state.
    WrongState {
        /// State of the device.
        state: DeviceState,
        /// State in which the request is served.
        needed: DeviceState,
    },
    /// The timing cannot be met.
    Timing(TimingError),
    /// Faults are latched: read, clear, arm.
    Faulted {
        /// Which.
        latched: FaultSet,
    },
    /// The interlock is open.
    InterlockOpen,
    /// A number is outside its range.
    OutOfRange {
        /// Which number.
        field: RequestField,
        /// What was asked.
        value: u32,
        /// Least allowed.
        min: u32,
        /// Most allowed.
        max: u32,
    },
    /// An emitter has used up its duty for now.
    DutyBudget {
        /// Projector 0..=9, or the number of projectors for the floodlight.
        emitter: u8,
        /// When asking again will succeed.
        retry_after_us: u32,
    },
    /// Settings could not be read or written.
    Storage(StorageError),
    /// This board cannot do that.
    Unsupported,
}

impl fmt::Display for RequestError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            RequestError::VersionMismatch { device } => write!(
                f,
                "the device speaks protocol {device}, this host {PROTOCOL_VERSION}: update the older one"
            ),
            RequestError::UnknownMessage { id } => {
                write!(f, "the device does not know message {id:#04x}: its firmware is older")
            }
            RequestError::Malformed { id } => {
                write!(f, "the device could not read the body of message {id:#04x}")
            }
            RequestError::NoSession => f.write_str("no session: send Hello first"),
            RequestError::WrongState { state, needed } => {
                write!(f, "the device is {state}; this needs it {needed}")
            }
            RequestError::Timing(error) => error.fmt(f),
            RequestError::Faulted { latched } => {
                write!(f, "faults are latched ({latched}): clear them, then arm")
            }
            RequestError::InterlockOpen => f.write_str("the interlock is open: close it, then arm"),
            RequestError::OutOfRange { field, value, min, max } => {
                let name = match field {
                    RequestField::BurstFrames => "frames",
                    RequestField::FloodlightDurationUs => "duration_us",
                    RequestField::BootloaderKey => "key",
                    RequestField::TriggerDelayUs => "delay_us",
                };
                write!(f, "{name} is {value}; allowed is {min}..={max}")
            }
            RequestError::DutyBudget { emitter, retry_after_us } => {
                write!(f, "emitter {emitter} has used its duty: ask again in {retry_after_us} us")
            }
            RequestError::Storage(StorageError::Empty) => f.write_str("no settings are stored"),
            RequestError::Storage(StorageError::Write) => {
                f.write_str("the settings could not be written; the old ones are kept")
            }
            RequestError::Storage(StorageError::Read) => {
                f.write_str("the stored settings are damaged: set the timing and store it anew")
            }
            RequestError::Unsupported => f.write_str("this board cannot do that"),
        }
    }
}

impl core::error::Error for RequestError {}

impl From<TimingError> for RequestError {
    fn from(error: TimingError) -> Self {
        RequestError::Timing(error)
    }
}
