//! USB: the device core of the chip, the bus, and a host.

mod core;
pub mod descriptors;
mod endpoint;
pub mod enumerate;
pub mod host;

use self::core::DeviceCore;
use crate::soc::peripheral::{Cx, NEVER, Peripheral, Signal};
use host::Host;

/// Interrupt number of USBFS.
const IRQ: u16 = 67;

/// The device core with a host at the other end of the cable.
#[derive(Debug)]
pub struct Usbfs {
    core: DeviceCore,
    host: Host,
    next: u64,
}

impl Usbfs {
    /// A core after reset; the cable is plugged in.
    #[must_use]
    pub fn new() -> Self {
        Self { core: DeviceCore::new(true), host: Host::new(), next: NEVER }
    }

    /// The chip or the core was reset: the pull-up goes.
    pub fn core_reset(&mut self, cx: &mut Cx<'_>) {
        self.core = DeviceCore::new(self.host.cable_connected());
        self.settle(cx);
    }

    /// The host; call [`Usbfs::settle`] after using it.
    pub fn host(&mut self) -> &mut Host {
        &mut self.host
    }

    /// Plugs the cable in or pulls it.
    pub fn set_cable(&mut self, connected: bool, cx: &mut Cx<'_>) {
        self.host.set_cable(connected, cx.clocks.ns_at(cx.now));
        self.core.set_vbus(connected);
        self.settle(cx);
    }

    /// Brings the bus, the interrupt line and the next event up to date.
    pub fn settle(&mut self, cx: &mut Cx<'_>) {
        let now_ns = cx.clocks.ns_at(cx.now);
        let clocked = cx.clocks.usb_hz == 48_000_000;
        self.host.sense(self.core.pulled_up() && clocked, now_ns);
        cx.out.push(Signal::Irq(IRQ, self.core.interrupt()));
        self.next = match self.host.next_ns() {
            Some(ns) => cx.clocks.cycle_at(ns).max(cx.now + 1),
            None => NEVER,
        };
    }
}

impl Default for Usbfs {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Usbfs {
    fn read(&mut self, offset: u32, cx: &mut Cx<'_>) -> u32 {
        let word = self.core.read(offset);
        // Only popping the receive FIFO changes anything.
        if offset == 0x20 || offset >= 0x1000 {
            self.settle(cx);
        }
        word
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        self.core.write(offset, value);
        self.settle(cx);
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        DeviceCore::modelled(offset)
    }

    fn next_event(&self) -> u64 {
        self.next
    }

    fn event(&mut self, cx: &mut Cx<'_>) {
        self.host.step(cx.clocks.ns_at(cx.now), &mut self.core);
        self.settle(cx);
    }

    fn after_clock_change(&mut self, cx: &mut Cx<'_>) {
        self.settle(cx);
    }
}
