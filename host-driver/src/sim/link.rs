//! The simulated sensor's control link.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::Rig;
use crate::transport::{Transport, TransportError};

/// Bytes to and from the simulated controller.
pub struct SimLink {
    rig: Arc<Mutex<Rig>>,
}

impl SimLink {
    /// The link of `rig`.
    pub fn new(rig: Arc<Mutex<Rig>>) -> Self {
        Self { rig }
    }
}

impl Transport for SimLink {
    fn write(&mut self, bytes: &[u8], _timeout: Duration) -> Result<(), TransportError> {
        self.rig.lock().unwrap_or_else(PoisonError::into_inner).write(bytes);
        Ok(())
    }

    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError> {
        Ok(self.rig.lock().unwrap_or_else(PoisonError::into_inner).read(into, timeout))
    }
}
