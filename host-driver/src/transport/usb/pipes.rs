//! What the control link needs of a USB device.

use std::time::Duration;

/// How a transfer failed.
#[derive(Debug)]
pub enum PipeError {
    /// Nothing in time; nothing was moved.
    Timeout,
    /// The endpoint is halted until it is cleared.
    Halted,
    /// The device is gone.
    Gone,
    /// Something else, perhaps for this transfer only.
    Io(std::io::Error),
}

/// Endpoints of an open USB device. Every wait is bounded.
pub trait Pipes: Send + Sync {
    /// Reads one transfer from an IN endpoint; returns its length.
    ///
    /// # Errors
    /// [`PipeError`].
    fn read(&self, endpoint: u8, buffer: &mut [u8], timeout: Duration) -> Result<usize, PipeError>;

    /// Writes to an OUT endpoint; returns how many bytes were taken.
    ///
    /// # Errors
    /// [`PipeError`].
    fn write(&self, endpoint: u8, bytes: &[u8], timeout: Duration) -> Result<usize, PipeError>;

    /// Clears an endpoint's halt.
    ///
    /// # Errors
    /// [`PipeError`].
    fn clear_halt(&self, endpoint: u8) -> Result<(), PipeError>;
}
