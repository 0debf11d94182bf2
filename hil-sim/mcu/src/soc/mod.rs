//! The chip around the core: peripherals, their wiring, and the events of virtual time.

pub mod access_log;
pub mod adc;
mod bus_map;
pub mod dma;
pub mod exti;
pub mod fmc;
pub mod fwdgt;
pub mod gpio;
pub mod misc;
pub mod peripheral;
mod pin_matrix;
pub mod pins;
pub mod rcu;
pub mod registers;
mod routing;
pub mod timer;
pub mod usart;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::clock::Clocks;
use crate::cpu::SharedMemory;
use crate::usb::Usbfs;
use access_log::AccessLog;
use adc::Adc;
use dma::Dma;
use exti::{Exti, Syscfg};
use fmc::Fmc;
use fwdgt::Fwdgt;
use gpio::Gpio;
use misc::{Crc, Ctc, Dbg, Pmu};
use peripheral::{Cx, NEVER, Peripheral, PeripheralId, ResetCause, Signal, TimerId};
use pins::{Level, PinChange};
use rcu::Rcu;
use timer::Timer;
use usart::Usart;

/// The chip's type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Variant {
    /// 84 MHz, no USB.
    F330,
    /// 108 MHz, USB full speed.
    F350,
}

impl Variant {
    /// Highest core clock of the datasheet.
    #[must_use]
    pub const fn max_hclk_hz(self) -> u32 {
        match self {
            Variant::F330 => 84_000_000,
            Variant::F350 => 108_000_000,
        }
    }
}

/// Bytes of flash.
pub const FLASH_BYTES: u32 = 128 * 1024;
/// Bytes of RAM.
pub const RAM_BYTES: u32 = 16 * 1024;

/// What the run loop reads without taking the chip's lock.
#[derive(Debug, Default)]
pub struct Shared {
    /// Cycle of the instruction that executes.
    pub now: AtomicU64,
    /// Cycle of the next event.
    pub next_event: AtomicU64,
    /// Interrupt lines, a reset or the clocks need the run loop.
    pub attention: AtomicBool,
}

/// Everything on the chip but the core and its memory cells.
pub struct Soc {
    variant: Variant,
    shared: Arc<Shared>,
    flash: Arc<dyn SharedMemory>,
    ram: Arc<dyn SharedMemory>,
    /// Frequencies, and where virtual time stands.
    pub clocks: Clocks,
    /// What the firmware touched that is not modelled.
    pub log: AccessLog,
    /// Bytes 0..12 are the unique device identifier.
    pub unique_id: [u8; 12],
    pub(crate) rcu: Rcu,
    pub(crate) gpio: [Gpio; 6],
    pub(crate) exti: Exti,
    pub(crate) syscfg: Syscfg,
    /// DMA controller.
    pub dma: Dma,
    /// Timers, by [`TimerId::index`].
    pub timers: [Timer; 7],
    /// USARTs.
    pub usarts: [Usart; 2],
    /// Converter and the voltages at its inputs.
    pub adc: Adc,
    /// Flash controller.
    pub fmc: Fmc,
    /// Watchdog.
    pub fwdgt: Fwdgt,
    pub(crate) pmu: Pmu,
    pub(crate) ctc: Ctc,
    pub(crate) crc: Crc,
    pub(crate) dbg: Dbg,
    /// USB core and its host.
    pub usbfs: Usbfs,
    irq_levels: u128,
    timer_outputs: [[Option<bool>; 7]; 7],
    pin_levels: [[Level; 16]; 6],
    pin_changes: Vec<PinChange>,
    pending_reset: Option<ResetCause>,
    pending_nmi: bool,
    signals: Vec<Signal>,
    clock_over_limit: bool,
    dma_channel_served: Option<u8>,
}

impl Soc {
    /// The chip just after power-on.
    #[must_use]
    pub fn new(
        variant: Variant,
        shared: Arc<Shared>,
        flash: Arc<dyn SharedMemory>,
        ram: Arc<dyn SharedMemory>,
    ) -> Self {
        Self {
            variant,
            shared,
            clocks: Clocks::after_reset(),
            log: AccessLog::default(),
            unique_id: *b"\x35\x00\x2dSTSPP\x01\x02\x03\x04",
            rcu: Rcu::new(variant == Variant::F350, true, 0, ResetCause::Power),
            gpio: std::array::from_fn(|port| Gpio::new(port as u8)),
            exti: Exti::new(),
            syscfg: Syscfg::default(),
            dma: Dma::default(),
            timers: TimerId::ALL.map(Timer::new),
            usarts: [Usart::new(0), Usart::new(1)],
            adc: Adc::new(),
            fmc: Fmc::new(Arc::clone(&flash)),
            fwdgt: Fwdgt::new(),
            pmu: Pmu::default(),
            ctc: Ctc::default(),
            crc: Crc::default(),
            dbg: Dbg::default(),
            usbfs: Usbfs::new(),
            irq_levels: 0,
            timer_outputs: [[None; 7]; 7],
            pin_levels: [[Level::Floating; 16]; 6],
            pin_changes: Vec::new(),
            pending_reset: None,
            pending_nmi: false,
            signals: Vec::new(),
            clock_over_limit: false,
            dma_channel_served: None,
            flash,
            ram,
        }
    }

    /// Which chip this is.
    #[must_use]
    pub fn variant(&self) -> Variant {
        self.variant
    }

    /// Levels of the interrupt lines, bit n for interrupt n.
    #[must_use]
    pub fn irq_levels(&self) -> u128 {
        self.irq_levels
    }

    /// A reset that a model asked for since the last call.
    pub fn take_reset(&mut self) -> Option<ResetCause> {
        self.pending_reset.take()
    }

    /// Whether a model raised the non-maskable interrupt since the last call.
    pub fn take_nmi(&mut self) -> bool {
        std::mem::take(&mut self.pending_nmi)
    }

    /// The board's crystal stops or works (again).
    pub fn set_crystal(&mut self, works: bool, now: u64) {
        self.act(now, |soc, cx| soc.rcu.set_crystal(works, cx.out));
    }

    /// Takes the pin changes so far, in time order.
    pub fn take_pin_changes(&mut self) -> Vec<PinChange> {
        std::mem::take(&mut self.pin_changes)
    }

    /// What the chip does to a pin now.
    #[must_use]
    pub fn pin_level(&self, pin: pins::Pin) -> Level {
        self.pin_levels[usize::from(pin.port)][usize::from(pin.number)]
    }

    /// Everything but the debug unit and the reset flags goes to its reset state at `now`; what is
    /// wired to the chip stays.
    pub fn reset(&mut self, cause: ResetCause, now: u64) {
        let flags = self.rcu.reset_flags();
        let crystal = self.rcu.crystal_fitted;
        self.clocks = self.clocks.rebase(now, Clocks::after_reset());
        self.rcu = Rcu::new(self.variant == Variant::F350, crystal, flags, cause);
        for port in &mut self.gpio {
            let fresh = Gpio::new(port.index()).wired_as(port);
            *port = fresh;
        }
        self.exti = Exti::new();
        self.syscfg = Syscfg::default();
        self.dma = Dma::default();
        self.timers = TimerId::ALL.map(Timer::new);
        for usart in &mut self.usarts {
            let fresh = Usart::new(usart.index()).wired_as(usart);
            *usart = fresh;
        }
        self.adc = Adc::new().wired_as(&self.adc);
        self.fmc = Fmc::new(Arc::clone(&self.flash));
        self.fwdgt = Fwdgt::new();
        self.pmu = Pmu::default();
        self.ctc = Ctc::default();
        self.crc = Crc::default();
        if cause == ResetCause::Power {
            self.dbg = Dbg::default();
        }
        self.irq_levels = 0;
        self.timer_outputs = [[None; 7]; 7];
        self.pending_reset = None;
        self.pending_nmi = false;
        self.with(now, |soc, cx| {
            soc.usbfs.core_reset(cx);
            for usart in &mut soc.usarts {
                usart.after_reset(cx);
            }
        });
        for port in 0..6 {
            self.refresh_port(port, now);
        }
        self.publish();
    }

    /// Handles every event up to `now`.
    pub fn advance(&mut self, now: u64) {
        loop {
            let due = self.next_event();
            if due > now {
                break;
            }
            self.dispatch_event(due);
            self.route(due);
        }
        self.publish();
    }

    /// The cycle of the earliest event.
    #[must_use]
    pub fn next_event(&self) -> u64 {
        let mut next = self
            .dma
            .next_event()
            .min(self.adc.next_event())
            .min(self.fmc.next_event())
            .min(self.fwdgt.next_event());
        for timer in &self.timers {
            next = next.min(timer.next_event());
        }
        for usart in &self.usarts {
            next = next.min(usart.next_event());
        }
        if self.variant == Variant::F350 {
            next = next.min(self.usbfs.next_event());
        }
        next
    }

    fn dispatch_event(&mut self, due: u64) {
        if self.dma.next_event() == due {
            self.make_dma_transfer(due);
            return;
        }
        self.with(due, |soc, cx| {
            let devices: [&mut dyn Peripheral; 13] = {
                let [t0, t1, t2, t13, t14, t15, t16] = &mut soc.timers;
                let [u0, u1] = &mut soc.usarts;
                [
                    t0,
                    t1,
                    t2,
                    t13,
                    t14,
                    t15,
                    t16,
                    u0,
                    u1,
                    &mut soc.adc,
                    &mut soc.fmc,
                    &mut soc.fwdgt,
                    &mut soc.usbfs,
                ]
            };
            for device in devices {
                if device.next_event() == due {
                    device.event(cx);
                    return;
                }
            }
        });
    }

    /// Lends the models a context at `now`, and keeps the signals they send.
    fn with<T>(&mut self, now: u64, act: impl FnOnce(&mut Self, &mut Cx<'_>) -> T) -> T {
        let clocks = self.clocks;
        let mut out = std::mem::take(&mut self.signals);
        let result = act(self, &mut Cx { now, clocks: &clocks, out: &mut out });
        self.signals = out;
        result
    }

    /// An action of the world outside, at `now`.
    pub fn act<T>(&mut self, now: u64, act: impl FnOnce(&mut Self, &mut Cx<'_>) -> T) -> T {
        self.advance(now);
        let result = self.with(now, act);
        self.route(now);
        self.publish();
        result
    }

    /// Tells the run loop when it is needed next.
    fn publish(&self) {
        self.shared.next_event.store(self.next_event(), Ordering::Relaxed);
    }

    /// Holds or releases what the debug unit holds while the core is halted.
    pub fn set_halted(&mut self, halted: bool, now: u64) {
        self.act(now, |soc, cx| {
            for id in TimerId::ALL {
                let hold = halted && soc.dbg.holds(id);
                soc.timers[id.index()].hold(hold, cx);
            }
            let hold = halted && soc.dbg.holds_watchdog();
            soc.fwdgt.hold(hold, cx);
        });
    }

    fn peripheral(&mut self, id: PeripheralId) -> &mut dyn Peripheral {
        match id {
            PeripheralId::Rcu => &mut self.rcu,
            PeripheralId::Gpio(port) => &mut self.gpio[usize::from(port)],
            PeripheralId::Exti => &mut self.exti,
            PeripheralId::Syscfg => &mut self.syscfg,
            PeripheralId::Dma => &mut self.dma,
            PeripheralId::Timer(id) => &mut self.timers[id.index()],
            PeripheralId::Usart(n) => &mut self.usarts[usize::from(n)],
            PeripheralId::Adc => &mut self.adc,
            PeripheralId::Fmc => &mut self.fmc,
            PeripheralId::Fwdgt => &mut self.fwdgt,
            PeripheralId::Pmu => &mut self.pmu,
            PeripheralId::Ctc => &mut self.ctc,
            PeripheralId::Crc => &mut self.crc,
            PeripheralId::Dbg => &mut self.dbg,
            PeripheralId::Usbfs => &mut self.usbfs,
        }
    }

    /// Whether no event is due.
    #[must_use]
    pub fn is_quiet(&self) -> bool {
        self.next_event() == NEVER
    }
}
