//! A USB device whose cable can be pulled and whose endpoints can be halted.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::usb::{Answer, Identity, Kind, Setup, UsbFunction};

/// What happens to a transfer on its way to the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tampering {
    /// It never arrives.
    Lost,
    /// A bit of it is turned over, and the bus did not notice.
    Corrupt,
}

/// The cable of a device: in at first.
#[derive(Debug, Clone)]
pub struct Cable {
    plugged: Arc<AtomicBool>,
    /// Addresses of halted endpoints.
    halted: Arc<Mutex<Vec<u8>>>,
    /// What happens to the next transfers from these endpoints.
    tampered: Arc<Mutex<Vec<(u8, Tampering)>>>,
}

impl Default for Cable {
    fn default() -> Self {
        let plugged = Arc::new(AtomicBool::new(true));
        Self { plugged, halted: Arc::default(), tampered: Arc::default() }
    }
}

impl Cable {
    /// Pulls it out, or plugs it in.
    pub fn set_plugged(&self, plugged: bool) {
        self.plugged.store(plugged, Ordering::Release);
    }

    /// Whether it is in.
    #[must_use]
    pub fn is_plugged(&self) -> bool {
        self.plugged.load(Ordering::Acquire)
    }

    /// Halts an endpoint until the host clears it.
    pub fn halt(&self, endpoint: u8) {
        self.halted().push(endpoint);
    }

    /// Tampers with the next transfer from an endpoint.
    pub fn tamper(&self, endpoint: u8, tampering: Tampering) {
        self.tampered.lock().unwrap_or_else(PoisonError::into_inner).push((endpoint, tampering));
    }

    fn take_tampering(&self, endpoint: u8) -> Option<Tampering> {
        let mut tampered = self.tampered.lock().unwrap_or_else(PoisonError::into_inner);
        let at = tampered.iter().position(|(of, _)| *of == endpoint)?;
        Some(tampered.remove(at).1)
    }

    fn halted(&self) -> MutexGuard<'_, Vec<u8>> {
        self.halted.lock().unwrap_or_else(PoisonError::into_inner)
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
        self.cable.halted().clear();
        self.function.reset();
    }

    fn control(&mut self, setup: Setup, data: &[u8]) -> Answer<Vec<u8>> {
        const CLEAR_FEATURE: u8 = 1;
        if setup.kind() == Kind::Standard
            && setup.recipient() == 2
            && setup.request == CLEAR_FEATURE
        {
            let mut halted = self.cable.halted();
            let before = halted.len();
            halted.retain(|endpoint| u16::from(*endpoint) != setup.index);
            if halted.len() < before {
                // The device itself knows of no halt.
                return Answer::Done(vec![]);
            }
        }
        self.function.control(setup, data)
    }

    fn transfer_in(&mut self, endpoint: u8, length: usize) -> Answer<Vec<u8>> {
        if self.cable.halted().contains(&(endpoint | 0x80)) {
            return Answer::Stall;
        }
        let mut answer = self.function.transfer_in(endpoint, length);
        if let Answer::Done(data) = &mut answer
            && !data.is_empty()
        {
            match self.cable.take_tampering(endpoint | 0x80) {
                Some(Tampering::Lost) => return Answer::Nak,
                Some(Tampering::Corrupt) => {
                    let middle = data.len() / 2;
                    data[middle] ^= 0x10;
                }
                None => {}
            }
        }
        answer
    }

    fn transfer_out(&mut self, endpoint: u8, data: &[u8]) -> Answer<usize> {
        if self.cable.halted().contains(&endpoint) {
            return Answer::Stall;
        }
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
