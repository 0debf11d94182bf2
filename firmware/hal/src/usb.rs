//! USB device on USBFS (user manual, "Universal serial bus full-speed interface (USBFS)"), through
//! `embassy-usb-synopsys-otg`: GD's core is Synopsys' OTG FS, and its USBFS_GCCFG has the layout
//! that the crate calls version 1 (PWRON 16, VBUSACEN 18, VBUSBCEN 19, SOFOEN 20, VBUSIG 21).

use crate::Peri;
use crate::chip::{USB_ENDPOINTS, USB_FIFO_WORDS};
use crate::interrupt::typelevel::{self, Binding, Handler};
use crate::interrupt::{Interrupt, InterruptExt};
use crate::peripherals::{PA11, PA12, USBFS};
use crate::regs;
use embassy_usb_driver::{
    Bus as BusTrait, Direction, EndpointAddress, EndpointAllocError, EndpointType, Event,
    Unsupported,
};
use embassy_usb_synopsys_otg::otg_v1::Otg;
use embassy_usb_synopsys_otg::{
    Bus as OtgBus, Driver as OtgDriver, OtgInstance, PhyType, StateStorage, on_interrupt,
};
pub use embassy_usb_synopsys_otg::{Config, ControlPipe, Endpoint, In, Out};

/// USBFS's base address (memory map).
const BASE: *mut () = 0x5000_0000 as *mut ();
/// Words of the receive FIFO beyond the packets: SETUP packets and status words (user manual,
/// "Data FIFO": 13 words for control transfers, plus one per OUT endpoint, plus global NAK).
const EXTRA_RX_FIFO_WORDS: u16 = 30;
/// Turn-around time in PHY clocks for an AHB clock above 32 MHz (GUSBCS, UTT).
const TURNAROUND: u8 = 5;

static STATE: StateStorage<USB_ENDPOINTS> = StateStorage::new();

fn otg() -> Otg {
    // SAFETY: the core's registers; the driver owns the peripheral's singleton.
    unsafe { Otg::from_ptr(BASE) }
}

/// Number of the last start-of-frame packet, 0..=2047 (USBFS_DSTAT, FNRSOF).
pub fn frame_number() -> u16 {
    otg().dsts().read().fnsof() & 0x7ff
}

/// The driver for `embassy_usb::Builder`.
pub struct Driver<'d> {
    inner: OtgDriver<'d>,
}

impl<'d> Driver<'d> {
    /// Takes USBFS and its pins. `out_buffer` holds one packet of every OUT endpoint, endpoint 0's
    /// 64 bytes included.
    pub fn new(
        _usbfs: Peri<'d, USBFS>,
        _dm: Peri<'d, PA11>,
        _dp: Peri<'d, PA12>,
        _irq: impl Binding<typelevel::USBFS, InterruptHandler>,
        out_buffer: &'d mut [u8],
        config: Config,
    ) -> Self {
        // Clocked from here on: endpoints may be asked for their state before the bus is polled.
        // The PHY takes PA11 and PA12 over as soon as it is powered.
        regs::rcu().ahben.modify(|_, w| w.usbfsen().set_bit());
        let instance = OtgInstance {
            regs: otg(),
            state: STATE.as_state(),
            fifo_depth_words: USB_FIFO_WORDS,
            extra_rx_fifo_words: EXTRA_RX_FIFO_WORDS,
            phy_type: PhyType::InternalFullSpeed,
            calculate_trdt_fn: |_| TURNAROUND,
        };
        Self { inner: OtgDriver::new(out_buffer, instance, config) }
    }
}

impl<'d> embassy_usb_driver::Driver<'d> for Driver<'d> {
    type EndpointOut = Endpoint<'d, Out>;
    type EndpointIn = Endpoint<'d, In>;
    type ControlPipe = ControlPipe<'d>;
    type Bus = Bus<'d>;

    fn alloc_endpoint_in(
        &mut self,
        kind: EndpointType,
        address: Option<EndpointAddress>,
        max_packet_size: u16,
        interval_ms: u8,
    ) -> Result<Self::EndpointIn, EndpointAllocError> {
        self.inner.alloc_endpoint_in(kind, address, max_packet_size, interval_ms)
    }

    fn alloc_endpoint_out(
        &mut self,
        kind: EndpointType,
        address: Option<EndpointAddress>,
        max_packet_size: u16,
        interval_ms: u8,
    ) -> Result<Self::EndpointOut, EndpointAllocError> {
        self.inner.alloc_endpoint_out(kind, address, max_packet_size, interval_ms)
    }

    fn start(self, control_max_packet_size: u16) -> (Self::Bus, Self::ControlPipe) {
        let (bus, control) = self.inner.start(control_max_packet_size);
        (Bus { inner: bus, started: false }, control)
    }
}

/// The bus: as the inner one, after the core is reset and powered.
pub struct Bus<'d> {
    inner: OtgBus<'d>,
    started: bool,
}

impl Bus<'_> {
    fn start(&mut self) {
        regs::rcu().ahbrst.modify(|_, w| w.usbfsrst().set_bit());
        regs::rcu().ahbrst.modify(|_, w| w.usbfsrst().clear_bit());
        self.inner.core_soft_reset();
        self.inner.configure_as_device();
        self.inner.config_v1();
        // SAFETY: bound, by the driver's constructor.
        unsafe { Interrupt::USBFS.enable() };
        self.started = true;
    }

    /// Takes back what waited for the host's token when the bus was reset. The core keeps EPENA over
    /// a bus reset, and a writer waits until it is clear: without this, an endpoint whose last
    /// packet was never fetched would stay silent after the next configuration.
    fn abandon_in_transfers(&mut self) {
        for index in 1..USB_ENDPOINTS {
            let address = EndpointAddress::from_parts(index, Direction::In);
            self.inner.endpoint_set_enabled(address, false);
        }
    }
}

impl BusTrait for Bus<'_> {
    async fn enable(&mut self) {
        self.inner.enable().await;
    }

    async fn disable(&mut self) {
        self.inner.disable().await;
    }

    async fn poll(&mut self) -> Event {
        if !self.started {
            self.start();
        }
        let event = self.inner.poll().await;
        if matches!(event, Event::Reset) {
            self.abandon_in_transfers();
        }
        event
    }

    fn endpoint_set_enabled(&mut self, address: EndpointAddress, enabled: bool) {
        self.inner.endpoint_set_enabled(address, enabled);
    }

    fn endpoint_set_stalled(&mut self, address: EndpointAddress, stalled: bool) {
        self.inner.endpoint_set_stalled(address, stalled);
    }

    fn endpoint_is_stalled(&mut self, address: EndpointAddress) -> bool {
        self.inner.endpoint_is_stalled(address)
    }

    async fn remote_wakeup(&mut self) -> Result<(), Unsupported> {
        self.inner.remote_wakeup().await
    }
}

/// Handler of USBFS's interrupt.
pub struct InterruptHandler;

impl Handler<typelevel::USBFS> for InterruptHandler {
    unsafe fn on_interrupt() {
        // SAFETY: this is the core's interrupt.
        unsafe { on_interrupt(otg(), &STATE.as_state()) };
    }
}
