//! The emulated F350's USB port for a host of another kind, such as a Linux kernel over USB/IP, while
//! the same chip goes on gating the simulated light.
//!
//! [`share`] splits a [`McuController`] in two: a [`Controller`] for whoever looks at its pins, and a
//! [`UsbFunction`] for the server. Both let virtual time follow a clock of the caller's:
//!
//! ```text
//!   rig, cameras ──► SharedController::run_until(clock)   ┐
//!                                                         ├─► one chip, one virtual time
//!   USB/IP ───────► UsbPort: poll() to the clock,         ┘
//!                   a new request up to LEAD_NS beyond it
//! ```
//!
//! A request of the kernel becomes a request of the emulated host, with the bus's own transactions,
//! NAKs and frames. A pending one stays with the emulated host, which polls as a host controller does;
//! the server asks for it again and again, and is told "not yet".

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use stspp_hil_sim::device::{Controller, PinEdge};
use stspp_hil_sim::front::usb::{Answer, BusError, Identity, Setup, Speed, UsbFunction};

use crate::chip::Chip;
use crate::controller::McuController;
use crate::usb::descriptors::TransferType;
use crate::usb::enumerate::{ADDRESS, control};
use crate::usb::host::{BusState, Completion, Request, UrbId, UrbStatus};

/// Nanoseconds of the time that the chip follows, on the scale of [`Controller::now_ns`].
pub type Clock = Arc<dyn Fn() -> u64 + Send + Sync>;

/// How far a new request may carry virtual time beyond the clock: most are answered within, so that
/// the host need not wait for the server's next round.
const LEAD_NS: u64 = 1_000_000;

/// Most virtual time that one poll makes up for, so that requests are served in between even where the
/// emulation is slower than the clock.
const CATCH_UP_NS: u64 = 20_000_000;

/// How often a request is looked after while virtual time is carried ahead.
const LOOK_NS: u64 = 20_000;

/// Reset, recovery and, where the device is just coming up, debouncing.
const RESET_NS: u64 = 300_000_000;

/// Time that a device has to take its address (USB 2.0, 9.2.6.3).
const ADDRESS_NS: u64 = 2_000_000;

const SET_ADDRESS: (u8, u8) = (0x00, 5);

/// Splits an emulated controller with USB into what gates light and what a USB server offers. `None`
/// where the chip has no USB device (F330).
#[must_use]
pub fn share(mut controller: McuController, clock: Clock) -> Option<(SharedController, UsbPort)> {
    let enumerated = controller.lend_usb()?;
    let device_descriptor = enumerated.device_bytes.as_slice().try_into().ok()?;
    let identity = Identity::new(Speed::Full, device_descriptor, &enumerated.configuration_bytes);
    let interrupt_in_ms = enumerated
        .configuration
        .interfaces
        .iter()
        .flat_map(|interface| &interface.endpoints)
        .filter(|e| e.transfer == TransferType::Interrupt && e.address & 0x80 != 0)
        .map(|e| (e.address & 0xf, u16::from(e.interval.max(1))))
        .collect();
    let resets = controller.chip().soc().usbfs.host().resets();
    let controller = Arc::new(Mutex::new(controller));
    let port = UsbPort {
        controller: Arc::clone(&controller),
        clock,
        identity,
        interrupt_in_ms,
        in_flight: HashMap::new(),
        kept: HashMap::new(),
        resets,
    };
    Some((SharedController(controller), port))
}

fn lock(controller: &Mutex<McuController>) -> MutexGuard<'_, McuController> {
    controller.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The chip's pins and inputs; its link belongs to whoever has the [`UsbPort`].
#[derive(Clone)]
pub struct SharedController(Arc<Mutex<McuController>>);

impl SharedController {
    /// The emulated controller, for measurements and faults.
    pub fn lock(&self) -> MutexGuard<'_, McuController> {
        lock(&self.0)
    }
}

impl Controller for SharedController {
    fn now_ns(&self) -> u64 {
        self.lock().now_ns()
    }

    /// Nothing: the bytes come from the other host.
    fn host_write(&mut self, _bytes: &[u8]) {}

    /// Nothing: the other host has them.
    fn host_read(&mut self, _out: &mut Vec<u8>) {}

    fn run_until(&mut self, time_ns: u64, edges: &mut Vec<PinEdge>) {
        self.lock().run_until(time_ns, edges);
    }

    fn set_interlock_closed(&mut self, closed: bool) {
        self.lock().set_interlock_closed(closed);
    }

    fn set_temperature_c(&mut self, temperature_c: f32) {
        self.lock().set_temperature_c(temperature_c);
    }

    fn set_trigger_in(&mut self, high: bool) {
        self.lock().set_trigger_in(high);
    }

    fn set_link_connected(&mut self, connected: bool) {
        self.lock().set_link_connected(connected);
    }
}

/// Endpoint number, and whether data goes to the host (false for endpoint 0).
type Pipe = (u8, bool);

/// What a pipe's given-up IN transfer had received.
struct Kept {
    data: Vec<u8>,
    /// A short packet had ended it.
    ended: bool,
}

struct InFlight {
    id: UrbId,
    /// Came before this request was made.
    before: Vec<u8>,
}

/// The chip's USB device, to be put behind a server.
pub struct UsbPort {
    controller: Arc<Mutex<McuController>>,
    clock: Clock,
    identity: Identity,
    interrupt_in_ms: HashMap<u8, u16>,
    in_flight: HashMap<Pipe, InFlight>,
    kept: HashMap<u8, Kept>,
    /// Bus resets that this side knows of: one more means that the device left and came back.
    resets: u64,
}

impl UsbPort {
    /// The answer to the pipe's request, which is submitted first where none is in flight. A new one
    /// carries time ahead until it is answered or the lead is used up.
    fn exchange(
        &mut self,
        pipe: Pipe,
        before: Vec<u8>,
        request: impl FnOnce() -> Request,
    ) -> Option<(Completion, Vec<u8>)> {
        let mut controller = lock(&self.controller);
        let chip = controller.chip();
        let is_new = !self.in_flight.contains_key(&pipe);
        let flight = self
            .in_flight
            .entry(pipe)
            .or_insert_with(|| InFlight { id: submit(chip, request()), before });
        let id = flight.id;
        let mut done = chip.soc().usbfs.host().take_completion_of(id);
        // An IN that waits for an event must not push time ahead.
        if done.is_none() && is_new && !self.interrupt_in_ms.contains_key(&pipe.0) {
            let ahead_ns = ((self.clock)() + LEAD_NS).saturating_sub(chip.now_ns());
            chip.run_until(ahead_ns, LOOK_NS, |chip| {
                done = chip.soc().usbfs.host().take_completion_of(id);
                done.is_some()
            });
        }
        let done = done?;
        let before = self.in_flight.remove(&pipe).map(|flight| flight.before).unwrap_or_default();
        Some((done, before))
    }
}

fn submit(chip: &mut Chip, request: Request) -> UrbId {
    let now_ns = chip.now_ns();
    chip.act(|soc, cx| {
        let id = soc.usbfs.host().submit(request, now_ns);
        soc.usbfs.settle(cx);
        id
    })
}

fn answer<T>(status: UrbStatus, done: impl FnOnce() -> T) -> Answer<T> {
    match status {
        UrbStatus::Ok => Answer::Done(done()),
        UrbStatus::Stall => Answer::Stall,
        UrbStatus::NoAnswer => Answer::Broken(BusError::NoAnswer),
        UrbStatus::Babble => Answer::Broken(BusError::Babble),
        UrbStatus::Unlinked | UrbStatus::Disconnected => Answer::Broken(BusError::Gone),
    }
}

impl UsbFunction for UsbPort {
    fn identity(&self) -> Identity {
        self.identity.clone()
    }

    /// Resets the bus and gives the device an address: a USB/IP host does that itself only for ports
    /// that it has.
    fn reset(&mut self) {
        self.in_flight.clear();
        self.kept.clear();
        let mut controller = lock(&self.controller);
        let chip = controller.chip();
        let before = chip.soc().usbfs.host().resets();
        let now_ns = chip.now_ns();
        chip.act(|soc, cx| {
            soc.usbfs.host().reset_bus(now_ns);
            soc.usbfs.settle(cx);
        });
        let is_up = chip.run_until(RESET_NS, 1_000_000, |chip| {
            let mut soc = chip.soc();
            let host = soc.usbfs.host();
            host.resets() > before && host.state() == BusState::Active
        });
        while chip.soc().usbfs.host().take_completion().is_some() {}
        let addressed =
            is_up && control(chip, "SET_ADDRESS", [0, 5, ADDRESS, 0, 0, 0, 0, 0], &[]).is_ok();
        // A device that has not taken its address is as good as absent.
        self.resets = if addressed { chip.soc().usbfs.host().resets() } else { u64::MAX };
        chip.run_for_ns(ADDRESS_NS);
    }

    fn control(&mut self, setup: Setup, data: &[u8]) -> Answer<Vec<u8>> {
        if (setup.request_type, setup.request) == SET_ADDRESS {
            // It has one; which, is between it and the emulated host.
            return Answer::Done(vec![]);
        }
        let bytes = setup.to_bytes();
        let request = || Request::Control { setup: bytes, data: data.to_vec() };
        match self.exchange((0, false), vec![], request) {
            None => Answer::Nak,
            Some((done, _)) => answer(done.status, || done.data),
        }
    }

    fn transfer_in(&mut self, endpoint: u8, length: usize) -> Answer<Vec<u8>> {
        let pipe = (endpoint, true);
        let mut before = vec![];
        if !self.in_flight.contains_key(&pipe)
            && let Some(mut kept) = self.kept.remove(&endpoint)
        {
            if kept.data.len() > length {
                let rest = kept.data.split_off(length);
                self.kept.insert(endpoint, Kept { data: rest, ended: kept.ended });
                return Answer::Done(kept.data);
            }
            if kept.ended || kept.data.len() == length {
                return Answer::Done(kept.data);
            }
            before = kept.data;
        }
        let interval_ms = self.interrupt_in_ms.get(&endpoint).copied();
        let wanted = length - before.len();
        let request = || match interval_ms {
            Some(interval_ms) => Request::InterruptIn { endpoint, length: wanted, interval_ms },
            None => Request::In { endpoint, length: wanted },
        };
        match self.exchange(pipe, before, request) {
            None => Answer::Nak,
            Some((done, mut data)) => answer(done.status, || {
                data.extend(done.data);
                data
            }),
        }
    }

    fn transfer_out(&mut self, endpoint: u8, data: &[u8]) -> Answer<usize> {
        let request = || Request::Out { endpoint, data: data.to_vec() };
        match self.exchange((endpoint, false), vec![], request) {
            None => Answer::Nak,
            Some((done, _)) => answer(done.status, || done.actual),
        }
    }

    fn poll(&mut self) {
        let mut controller = lock(&self.controller);
        let chip = controller.chip();
        let until_ns = (self.clock)().min(chip.now_ns() + CATCH_UP_NS);
        chip.run_until_ns(until_ns);
    }

    /// Takes the transfer back from the emulated host. What it had received is not lost: the next
    /// request on the pipe begins with it.
    fn unlinked(&mut self, endpoint: u8, is_in: bool) {
        let Some(flight) = self.in_flight.remove(&(endpoint, is_in)) else { return };
        let mut controller = lock(&self.controller);
        let chip = controller.chip();
        let now_ns = chip.now_ns();
        let mut soc = chip.soc();
        let host = soc.usbfs.host();
        host.unlink(flight.id, now_ns);
        let Some(done) = host.take_completion_of(flight.id) else { return };
        let mut data = flight.before;
        data.extend(done.data);
        if is_in && endpoint != 0 && !data.is_empty() {
            self.kept.insert(endpoint, Kept { data, ended: done.status == UrbStatus::Ok });
        }
    }

    fn is_attached(&self) -> bool {
        let mut controller = lock(&self.controller);
        let mut soc = controller.chip().soc();
        let host = soc.usbfs.host();
        host.resets() == self.resets && host.state() != BusState::Detached
    }
}
