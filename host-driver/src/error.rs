//! What can go wrong with a sensor: each error names the part, and what to do about it.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use stspp_protocol::fault::{FaultRecord, FaultSet};
use stspp_protocol::reply::{DeviceState, RequestError};
use stspp_protocol::timing::TimingError;

use crate::calibration::CalibrationError;
use crate::camera::CameraError;
use crate::recording::RecordingError;
use crate::rectify::RectifyError;
use crate::sync::Side;
use crate::transport::TransportError;
use crate::uri::UriError;

/// Errors of [`crate::Sensor`] and its streams.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The source is not understood.
    #[error(transparent)]
    Uri(#[from] UriError),
    /// The source is understood, but this build has no driver for it.
    #[error("{scheme}: is not built into this version of stspp; {remedy}")]
    NotBuiltIn {
        /// The source's scheme.
        scheme: &'static str,
        /// What to do.
        remedy: &'static str,
    },
    /// The simulated sensor cannot be made.
    #[error("sim: {0}")]
    Simulation(String),
    /// The recording cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The calibration is not possible.
    #[error(transparent)]
    Calibration(#[from] CalibrationError),
    /// Nobody has said how this sensor's cameras see.
    #[error(transparent)]
    NoCalibration(#[from] CalibrationMissing),
    /// Another sensor answers than the one that was open.
    #[error("sensor {got} answers instead of {expected}; open it as a sensor of its own")]
    OtherSensor {
        /// Serial number of the one that was open.
        expected: String,
        /// Serial number of the one that answers.
        got: String,
    },
    /// The images cannot be rectified.
    #[error(transparent)]
    Rectify(#[from] RectifyError),
    /// The matcher was asked for what it cannot do.
    #[error("matcher: {0}")]
    Match(#[from] stspp_matcher::Error),
    /// The control link failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A camera failed.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Nothing came in time.
    #[error(transparent)]
    Timeout(#[from] Timeout),
    /// The device refused a request; nothing has changed.
    #[error("{request}: {source}")]
    Refused {
        /// The request's name.
        request: &'static str,
        /// Why.
        source: RequestError,
    },
    /// The timing breaks these rules; see [`crate::timing::violations`].
    #[error("{}", Violations(.0))]
    Timing(Vec<TimingError>),
    /// A fault switched the light off.
    #[error(transparent)]
    Faulted(#[from] Faulted),
    /// The device restarted by itself: the session and the stream are gone.
    #[error("the device restarted ({0}); open the stream again")]
    DeviceReset(String),
    /// The sensor is streaming already.
    #[error("the sensor is streaming already: drop the other stream first")]
    Streaming,
    /// The source cannot do this.
    #[error("{scheme}: cannot {what}")]
    Unsupported {
        /// The source's scheme.
        scheme: &'static str,
        /// What was asked.
        what: &'static str,
    },
    /// The timing has no slot with speckle, so that there is nothing to match.
    #[error("the timing lights no projector without the floodlight: no depth can come of it")]
    NoSpeckleSlot,
    /// A file could not be written.
    #[error("{}: {source}", .path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A thread of the stream could not be started, or panicked.
    #[error("the {thread} thread of the stream: {what}")]
    Thread {
        /// The thread.
        thread: &'static str,
        /// What happened.
        what: String,
    },
    /// The stream has ended.
    #[error("the stream has ended; open another one")]
    Stopped,
}

/// There is no calibration for a sensor.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "no calibration of sensor {serial}: looked for {}; put its camchain.yaml there, or name one by \
     `?calibration=FILE`", .looked_for.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ")
)]
pub struct CalibrationMissing {
    /// Serial number of the sensor.
    pub serial: String,
    /// Files that were looked for.
    pub looked_for: Vec<PathBuf>,
}

/// What did not come in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// No reply on the control link: cable, power, or another program.
    Reply {
        /// The request that was not answered.
        request: &'static str,
    },
    /// The device answers but sends no trigger events.
    Trigger,
    /// Triggers, but no frame of either camera: trigger cables, or cameras in free-running mode.
    Exposure,
    /// Only the other camera delivers.
    Camera(Side),
    /// Frames and triggers, but they do not fit together.
    Pairing,
    /// Pairs, but no complete window: too many are lost.
    Window,
    /// Complete windows wait for the matcher: the machine is too slow for the time allowed.
    Matching,
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reply { request } => write!(
                f,
                "no reply to {request}: the control link is silent; check cable and power"
            ),
            Self::Trigger => f.write_str(
                "no trigger: the device answers but triggers no camera (with an external trigger: no \
                 edge comes)",
            ),
            Self::Exposure => f.write_str(
                "no exposure: the device triggers but neither camera delivers; check the trigger \
                 cables and the cameras' trigger mode",
            ),
            Self::Camera(side) => write!(f, "no frame of the {side} camera; check its cable"),
            Self::Pairing => f.write_str(
                "no pair: frames and triggers arrive but do not fit together; see the counters",
            ),
            Self::Window => {
                f.write_str("no complete window: too many pairs are lost; see the counters")
            }
            Self::Matching => {
                f.write_str("no depth yet: windows wait for the matcher; allow more time")
            }
        }
    }
}

/// Nothing came within a time limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("timeout after {:.3} s: {missing}", .waited.as_secs_f64())]
pub struct Timeout {
    /// The limit, on the source's clock.
    pub waited: Duration,
    /// What is missing.
    pub missing: Missing,
}

/// A latched fault: the light is off and stays off until it is cleared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Faulted {
    /// The fault that ended the stream, where the device told.
    pub record: Option<FaultRecord>,
    /// All latched faults.
    pub latched: FaultSet,
    /// State of the device.
    pub state: DeviceState,
}

impl fmt::Display for Faulted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the device switched its light off: {}", self.latched)?;
        if let Some(record) = &self.record {
            write!(
                f,
                " (value {}, limit {}, at {:.6} s of its clock)",
                record.value,
                record.limit,
                record.time_us as f64 * 1e-6
            )?;
        }
        f.write_str("; remove the cause, clear the faults and start again")
    }
}

impl std::error::Error for Faulted {}

struct Violations<'a>(&'a [TimingError]);

impl fmt::Display for Violations<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (k, violation) in self.0.iter().enumerate() {
            write!(f, "{}{violation}", if k == 0 { "" } else { "; " })?;
        }
        Ok(())
    }
}
