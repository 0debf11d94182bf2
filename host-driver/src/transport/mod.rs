//! The command path: bytes of the control link, and the protocol over them.
//!
//! [`Transport`] is what a USB endpoint pair, a serial port or the simulator implements; [`Link`] talks
//! the protocol over any of them. Images do not pass here: see [`crate::camera`].

mod link;

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
    /// The operating system reports an error.
    #[error("{link}: {source}")]
    Io {
        /// Which link.
        link: String,
        /// The error.
        source: std::io::Error,
    },
}
