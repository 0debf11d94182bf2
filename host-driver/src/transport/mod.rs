//! The command path: bytes of the control link, and the protocol over them.
//!
//! [`Transport`] is what a USB endpoint pair ([`usb`]), a serial port ([`serial`]) or the simulator
//! implements; [`Link`] talks the protocol over any of them. Images do not pass here: see
//! [`crate::camera`].

mod link;
pub mod serial;
#[cfg(feature = "usb")]
pub mod usb;

use std::path::PathBuf;
use std::time::Duration;

pub use link::{DeviceClock, Link, LinkStats, TimedEvent};

/// Bytes of the control link, both ways. Every wait is bounded.
pub trait Transport: Send {
    /// Sends all of `bytes` within `timeout`.
    ///
    /// # Errors
    /// When the link is gone, or the device does not take the bytes in time.
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> Result<(), TransportError>;

    /// Appends what the device has sent to `into`; waits up to `timeout` when that is nothing yet.
    /// Returns the number of bytes: 0 after the time has passed. A timeout of zero does not wait.
    ///
    /// # Errors
    /// When the link is gone.
    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError>;
}

/// Why the control link does not work.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TransportError {
    /// No such sensor is plugged in.
    #[error("{link}: no sensor found; check cable and power (`stspp list`, `stspp doctor`)")]
    NotFound {
        /// What was looked for.
        link: String,
    },
    /// Several sensors fit.
    #[error("{link}: several sensors fit; name one of {}", .found.join(", "))]
    Ambiguous {
        /// What was looked for.
        link: String,
        /// Sources that name one each.
        found: Vec<String>,
    },
    /// The user may not open the device.
    #[error("{link}: {} may not be opened; {remedy}", .node.display())]
    Permission {
        /// Which link.
        link: String,
        /// The device's file.
        node: PathBuf,
        /// What to do.
        remedy: &'static str,
    },
    /// Another program has the device.
    #[error("{link}: in use by another program; close it")]
    Busy {
        /// Which link.
        link: String,
    },
    /// Somebody answers, but not a sensor.
    #[error(
        "what answers is not a sensor: {bytes} bytes came, no message of the protocol among them; \
         check which device is at this port"
    )]
    NotASensor {
        /// Bytes that came.
        bytes: u64,
    },
    /// What was named is not a serial port.
    #[error("{link}: not a serial port: {source}")]
    NotAPort {
        /// Which link.
        link: String,
        /// The error.
        source: std::io::Error,
    },
    /// Unplugged or switched off.
    #[error("{link}: the sensor is gone; plug it in again")]
    Gone {
        /// Which link.
        link: String,
    },
    /// The device does not take bytes.
    #[error("{link}: the sensor takes no bytes for {:.3} s", .waited.as_secs_f64())]
    Stuck {
        /// Which link.
        link: String,
        /// How long it was tried.
        waited: Duration,
    },
    /// An endpoint halts again and again.
    #[error(
        "{link}: endpoint {endpoint:#04x} stays halted after {attempts} attempts to clear it; \
         unplug the sensor and plug it in again"
    )]
    Halted {
        /// Which link.
        link: String,
        /// The endpoint's address.
        endpoint: u8,
        /// How often it was cleared in vain.
        attempts: u32,
    },
    /// The operating system reports an error.
    #[error("{link}: {source}")]
    Io {
        /// Which link.
        link: String,
        /// The error.
        source: std::io::Error,
    },
}
