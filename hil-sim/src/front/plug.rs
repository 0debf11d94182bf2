//! A USB device whose cable can be pulled.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::usb::{Answer, Identity, Setup, UsbFunction};

/// The cable of a device: in at first.
#[derive(Debug, Clone)]
pub struct Cable(Arc<AtomicBool>);

impl Default for Cable {
    fn default() -> Self {
        Self(Arc::new(AtomicBool::new(true)))
    }
}

impl Cable {
    /// Pulls it out, or plugs it in.
    pub fn set_plugged(&self, plugged: bool) {
        self.0.store(plugged, Ordering::Release);
    }

    /// Whether it is in.
    #[must_use]
    pub fn is_plugged(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// A device behind a cable.
pub struct Plugged<F> {
    function: F,
    cable: Cable,
}

impl<F> Plugged<F> {
    /// Puts `function` behind `cable`.
    pub fn new(function: F, cable: Cable) -> Self {
        Self { function, cable }
    }
}

impl<F: UsbFunction> UsbFunction for Plugged<F> {
    fn identity(&self) -> Identity {
        self.function.identity()
    }

    fn reset(&mut self) {
        self.function.reset();
    }

    fn control(&mut self, setup: Setup, data: &[u8]) -> Answer<Vec<u8>> {
        self.function.control(setup, data)
    }

    fn transfer_in(&mut self, endpoint: u8, length: usize) -> Answer<Vec<u8>> {
        self.function.transfer_in(endpoint, length)
    }

    fn transfer_out(&mut self, endpoint: u8, data: &[u8]) -> Answer<usize> {
        self.function.transfer_out(endpoint, data)
    }

    fn poll(&mut self) {
        self.function.poll();
    }

    fn unlinked(&mut self, endpoint: u8, is_in: bool) {
        self.function.unlinked(endpoint, is_in);
    }

    fn is_attached(&self) -> bool {
        self.cable.is_plugged() && self.function.is_attached()
    }

    fn detach(&mut self) {
        self.function.detach();
    }
}
