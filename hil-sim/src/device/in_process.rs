//! The firmware's logic in this process, in virtual time.
//!
//! [`InProcess`] runs `stspp-firmware-logic` itself, over a gate engine that computes its edges
//! ([`engine`]) and flash in memory ([`flash`]). What is not here is the chip: interrupts take no time,
//! and the bounds below are constants instead of being measured.
//!
//! | From | To | Time |
//! |---|---|---|
//! | `host_write` | request handled | [`LINK_LATENCY_NS`] |
//! | reply or event sent | `host_read` has it | [`LINK_LATENCY_NS`] |
//! | interlock opens, temperature too high | outputs low | at once |
//! | reset | first event | [`BOOT_NS`] |
//! | F350: cable pulled | link known to be lost | [`SUSPEND_NS`] |
//! | hang | watchdog reset, outputs low | [`WATCHDOG_NS`] |
//!
//! The link has no limit on its rate. On an F330 nothing tells the firmware of a pulled cable; there
//! the heartbeat ends the light.

pub mod clock;
pub mod engine;
pub mod flash;

use std::collections::VecDeque;

use stspp_firmware_logic::controller::{Boot, Controller as Logic, Identity};
use stspp_firmware_logic::hardware::{GateEngine, SystemAction};
use stspp_protocol::fault::{FaultReason, FaultSet};
use stspp_protocol::reply::DeviceState;
use stspp_protocol::version::{BoardKind, ResetCause, SerialNumber};
use stspp_protocol::wire::MAX_FRAME_LEN;

use self::clock::DeviceClock;
use self::engine::VirtualEngine;
use self::flash::MemoryFlash;
use super::{Controller, PinEdge};

/// Time that bytes take in each direction.
pub const LINK_LATENCY_NS: u64 = 50_000;

/// From a reset to a controller that answers.
pub const BOOT_NS: u64 = 5_000_000;

/// A USB device is suspended after 3 ms without a start of frame (USB 2.0, 7.1.7.6).
pub const SUSPEND_NS: u64 = 3_000_000;

/// Longest time between two feedings of the watchdog.
pub const WATCHDOG_NS: u64 = 100_000_000;

/// How an [`InProcess`] device comes into being.
#[derive(Debug, Clone)]
pub struct InProcessOptions {
    /// Board.
    pub board: BoardKind,
    /// Serial number.
    pub serial: SerialNumber,
    /// How much the device's clock is fast, millionths.
    pub clock_error_ppm: i32,
    /// Flash, with the settings of an earlier life.
    pub flash: MemoryFlash,
}

impl Default for InProcessOptions {
    fn default() -> Self {
        Self {
            board: BoardKind::F350,
            serial: SerialNumber(*b"stspp-sim000"),
            clock_error_ppm: 0,
            flash: MemoryFlash::default(),
        }
    }
}

impl InProcessOptions {
    /// A device of its own for each seed: serial number, and a crystal within 50 ppm.
    #[must_use]
    pub fn seeded(seed: u64) -> Self {
        // SplitMix64's output function spreads neighbouring seeds.
        let mut bits = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        bits ^= bits >> 31;
        let mut serial = *b"sim-00000000";
        serial[4..].copy_from_slice(&bits.to_be_bytes());
        Self {
            serial: SerialNumber(serial),
            clock_error_ppm: (bits % 101) as i32 - 50,
            ..Self::default()
        }
    }
}

/// Something that goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Injection {
    /// The firmware panics: outputs low, reset, fault carried over.
    Panic,
    /// The processor faults: as a panic.
    HardFault,
    /// The firmware hangs; the gate engine goes on until the watchdog resets the chip.
    Hang,
    /// The reset pin is pulled.
    PinReset,
    /// Power is lost and comes back: nothing but flash survives.
    PowerCycle,
    /// The gate timer stops at the next slot boundary.
    EngineStall,
    /// The next event never arrives.
    LoseNextEvent,
    /// The next event arrives twice.
    DuplicateNextEvent,
    /// A bit of the next frame to the host is flipped.
    CorruptNextFrame,
}

#[derive(Debug, Default)]
struct LinkFaults {
    lose_events: u32,
    duplicate_events: u32,
    corrupt_frames: u32,
}

#[derive(Debug)]
enum Life {
    Up(Box<Logic<VirtualEngine, MemoryFlash>>),
    /// Does not serve anything any more; reset by the watchdog at the time.
    Hung(Box<Logic<VirtualEngine, MemoryFlash>>, u64),
    /// Up again at the time.
    Booting(Boot, MemoryFlash, u64),
    /// Until power is cycled.
    Bootloader(MemoryFlash),
}

/// The in-process device.
#[derive(Debug)]
pub struct InProcess {
    options: InProcessOptions,
    now_ns: u64,
    life: Life,
    to_device: VecDeque<(u64, Vec<u8>)>,
    to_host: VecDeque<(u64, Vec<u8>)>,
    link_connected: bool,
    /// When the device notices that the cable is gone.
    suspend_at_ns: Option<u64>,
    interlock_closed: bool,
    temperature_dc: i16,
    trigger_in: bool,
    link_faults: LinkFaults,
    /// Edges of a life that has ended.
    edges: Vec<PinEdge>,
}

impl Default for InProcess {
    fn default() -> Self {
        Self::new(InProcessOptions::default())
    }
}

impl InProcess {
    /// Powers a device on; it answers from time 0.
    #[must_use]
    pub fn new(options: InProcessOptions) -> Self {
        let boot = Boot { cause: ResetCause::PowerOn, carried: FaultSet::EMPTY };
        let life = Life::Booting(boot, options.flash.clone(), 0);
        let mut device = Self {
            options,
            now_ns: 0,
            life,
            to_device: VecDeque::new(),
            to_host: VecDeque::new(),
            link_connected: true,
            suspend_at_ns: None,
            interlock_closed: true,
            temperature_dc: 250,
            trigger_in: false,
            link_faults: LinkFaults::default(),
            edges: Vec::new(),
        };
        device.boot();
        device
    }

    /// State of the firmware; `None` while it does not run.
    #[must_use]
    pub fn state(&self) -> Option<DeviceState> {
        match &self.life {
            Life::Up(logic) => Some(logic.state()),
            _ => None,
        }
    }

    /// Whether the device waits in its bootloader.
    #[must_use]
    pub fn is_in_bootloader(&self) -> bool {
        matches!(self.life, Life::Bootloader(_))
    }

    /// Device time, whole microseconds since its last reset; 0 while it does not run.
    #[must_use]
    pub fn device_time_us(&self) -> u64 {
        match &self.life {
            Life::Up(logic) | Life::Hung(logic, _) => logic.engine().now_us(self.now_ns),
            _ => 0,
        }
    }

    /// Takes the device apart for its flash.
    #[must_use]
    pub fn into_flash(self) -> MemoryFlash {
        match self.life {
            Life::Up(logic) | Life::Hung(logic, _) => logic.into_parts().1,
            Life::Booting(_, flash, _) | Life::Bootloader(flash) => flash,
        }
    }

    /// Lets something go wrong now.
    pub fn inject(&mut self, injection: Injection) {
        match injection {
            Injection::Panic => self.die(ResetCause::Software, Some(FaultReason::Panic)),
            Injection::HardFault => self.die(ResetCause::Software, Some(FaultReason::HardFault)),
            Injection::PinReset => self.die(ResetCause::Pin, None),
            Injection::PowerCycle => self.die(ResetCause::PowerOn, None),
            Injection::Hang => {
                if let Life::Up(logic) = self.take_life() {
                    self.life = Life::Hung(logic, self.now_ns + WATCHDOG_NS);
                }
            }
            Injection::EngineStall => {
                if let Life::Up(logic) = &mut self.life {
                    logic.engine_mut().stall();
                }
            }
            Injection::LoseNextEvent => self.link_faults.lose_events += 1,
            Injection::DuplicateNextEvent => self.link_faults.duplicate_events += 1,
            Injection::CorruptNextFrame => self.link_faults.corrupt_frames += 1,
        }
    }

    // ---- Lives --------------------------------------------------------------------------------

    /// Takes the life out; what stands in for it is replaced by the caller.
    fn take_life(&mut self) -> Life {
        std::mem::replace(&mut self.life, Life::Bootloader(MemoryFlash::default()))
    }

    /// Outputs low, and up again after the boot time.
    fn die(&mut self, cause: ResetCause, fault: Option<FaultReason>) {
        let (mut carried, flash) = match self.take_life() {
            Life::Up(mut logic) | Life::Hung(mut logic, _) => {
                logic.engine_mut().set_now_ns(self.now_ns);
                logic.engine_mut().force_off();
                logic.engine_mut().take_edges(&mut self.edges);
                (logic.latched(), logic.into_parts().1)
            }
            Life::Booting(boot, flash, _) => (boot.carried, flash),
            Life::Bootloader(flash) => (FaultSet::EMPTY, flash),
        };
        if cause == ResetCause::PowerOn {
            carried = FaultSet::EMPTY;
        }
        if let Some(reason) = fault {
            carried.insert(reason);
        }
        self.life = Life::Booting(Boot { cause, carried }, flash, self.now_ns + BOOT_NS);
    }

    fn boot(&mut self) {
        match self.take_life() {
            Life::Booting(boot, flash, _) => {
                let clock = DeviceClock::new(self.now_ns, self.options.clock_error_ppm);
                let has_usb = self.options.board == BoardKind::F350;
                let mut engine = VirtualEngine::new(clock, has_usb);
                engine.set_now_ns(self.now_ns);
                engine.set_trigger_in(self.trigger_in);
                let identity = Identity::new(self.options.board, self.options.serial);
                let mut logic = Logic::new(identity, engine, flash, boot);
                logic.on_interlock(0, self.interlock_closed);
                logic.on_temperature(0, self.temperature_dc);
                self.life = Life::Up(Box::new(logic));
                self.settle();
            }
            other => self.life = other,
        }
    }

    // ---- Time ---------------------------------------------------------------------------------

    /// When something happens next.
    fn next_ns(&self) -> Option<u64> {
        let life_ns = match &self.life {
            Life::Up(logic) => {
                let engine = logic.engine();
                let deadline_ns = logic.next_deadline_us().map(|us| engine.ns_from_us(us));
                engine.next_event_ns().into_iter().chain(deadline_ns).min()
            }
            Life::Hung(logic, reset_ns) => {
                logic.engine().next_event_ns().into_iter().chain([*reset_ns]).min()
            }
            Life::Booting(_, _, up_ns) => Some(*up_ns),
            Life::Bootloader(_) => None,
        };
        let link_ns = self.to_device.front().map(|(time_ns, _)| *time_ns);
        life_ns.into_iter().chain(link_ns).chain(self.suspend_at_ns).min()
    }

    /// Lets everything happen that is due now.
    fn happen(&mut self) {
        match &mut self.life {
            Life::Up(logic) => {
                while logic.engine().next_event_ns().is_some_and(|time_ns| time_ns <= self.now_ns) {
                    if let Some(done) = logic.engine_mut().step() {
                        let now_us = logic.engine().now_us(self.now_ns);
                        logic.on_slot_done(now_us, &done);
                    }
                }
                logic.engine_mut().set_now_ns(self.now_ns);
                let now_us = logic.engine().now_us(self.now_ns);
                logic.poll(now_us);
            }
            Life::Hung(logic, reset_ns) => {
                let reset_ns = *reset_ns;
                while logic.engine().next_event_ns().is_some_and(|time_ns| time_ns <= self.now_ns) {
                    // The interrupt is not served: the report is lost.
                    let _ = logic.engine_mut().step();
                }
                if self.now_ns >= reset_ns {
                    self.die(ResetCause::Watchdog, Some(FaultReason::Watchdog));
                }
            }
            Life::Booting(_, _, up_ns) => {
                if self.now_ns >= *up_ns {
                    self.boot();
                }
            }
            Life::Bootloader(_) => {}
        }
        if self.suspend_at_ns.is_some_and(|time_ns| time_ns <= self.now_ns) {
            self.suspend_at_ns = None;
            self.with_logic(|logic, now_us| logic.on_link_lost(now_us));
        }
        while let Some((_, bytes)) =
            self.to_device.pop_front_if(|(time_ns, _)| *time_ns <= self.now_ns)
        {
            self.hear(&bytes);
        }
        self.settle();
    }

    /// Gives bytes to the firmware, if there is one to hear them.
    fn hear(&mut self, mut bytes: &[u8]) {
        let mut out = [0; MAX_FRAME_LEN];
        while let Life::Up(logic) = &mut self.life {
            let now_us = logic.engine().now_us(self.now_ns);
            let Some(len) = logic.receive(now_us, &mut bytes, &mut out) else { break };
            self.settle_events();
            self.send(&out[..len], false);
            self.settle_action();
        }
    }

    /// Calls the firmware, if it runs, and takes what it has to say.
    fn with_logic(&mut self, call: impl FnOnce(&mut Logic<VirtualEngine, MemoryFlash>, u64)) {
        if let Life::Up(logic) = &mut self.life {
            logic.engine_mut().set_now_ns(self.now_ns);
            let now_us = logic.engine().now_us(self.now_ns);
            call(logic, now_us);
        }
        self.settle();
    }

    fn settle(&mut self) {
        self.settle_events();
        self.settle_action();
    }

    fn settle_events(&mut self) {
        let mut out = [0; MAX_FRAME_LEN];
        while let Life::Up(logic) = &mut self.life
            && let Some(len) = logic.next_event(&mut out)
        {
            self.send(&out[..len], true);
        }
    }

    fn settle_action(&mut self) {
        let Life::Up(logic) = &mut self.life else { return };
        match logic.take_action() {
            Some(SystemAction::Reset) => self.die(ResetCause::Software, None),
            Some(SystemAction::Bootloader) => {
                self.die(ResetCause::Software, None);
                if let Life::Booting(_, flash, _) = self.take_life() {
                    self.life = Life::Bootloader(flash);
                }
            }
            None => {}
        }
    }

    fn send(&mut self, frame: &[u8], is_event: bool) {
        if !self.link_connected {
            return;
        }
        let faults = &mut self.link_faults;
        let mut copies = 1;
        if is_event && faults.lose_events > 0 {
            faults.lose_events -= 1;
            copies = 0;
        } else if is_event && faults.duplicate_events > 0 {
            faults.duplicate_events -= 1;
            copies = 2;
        }
        for _ in 0..copies {
            let mut bytes = frame.to_vec();
            if self.link_faults.corrupt_frames > 0 {
                self.link_faults.corrupt_frames -= 1;
                let middle = bytes.len() / 2;
                // Never to a zero, which would end the frame there.
                bytes[middle] ^= if bytes[middle] == 0x10 { 0x20 } else { 0x10 };
            }
            self.to_host.push_back((self.now_ns + LINK_LATENCY_NS, bytes));
        }
    }
}

impl Controller for InProcess {
    fn now_ns(&self) -> u64 {
        self.now_ns
    }

    fn host_write(&mut self, bytes: &[u8]) {
        if self.link_connected && !bytes.is_empty() {
            self.to_device.push_back((self.now_ns + LINK_LATENCY_NS, bytes.to_vec()));
        }
    }

    fn host_read(&mut self, out: &mut Vec<u8>) {
        while let Some((_, bytes)) = self.to_host.pop_front_if(|(at, _)| *at <= self.now_ns) {
            out.extend_from_slice(&bytes);
        }
    }

    fn run_until(&mut self, time_ns: u64, edges: &mut Vec<PinEdge>) {
        while let Some(next_ns) = self.next_ns().filter(|next_ns| *next_ns <= time_ns) {
            self.now_ns = self.now_ns.max(next_ns);
            self.happen();
        }
        self.now_ns = self.now_ns.max(time_ns);
        edges.append(&mut self.edges);
        if let Life::Up(logic) | Life::Hung(logic, _) = &mut self.life {
            logic.engine_mut().take_edges(edges);
        }
    }

    fn set_interlock_closed(&mut self, closed: bool) {
        self.interlock_closed = closed;
        if !closed && let Life::Hung(logic, _) = &mut self.life {
            // On the chip an interrupt of the highest priority does this, hung or not.
            logic.engine_mut().set_now_ns(self.now_ns);
            logic.engine_mut().force_off();
        }
        self.with_logic(|logic, now_us| logic.on_interlock(now_us, closed));
    }

    fn set_temperature_c(&mut self, temperature_c: f32) {
        // Saturates; NaN reads as 0.
        self.temperature_dc = (temperature_c * 10.0).round() as i16;
        let temperature_dc = self.temperature_dc;
        self.with_logic(|logic, now_us| logic.on_temperature(now_us, temperature_dc));
    }

    fn set_trigger_in(&mut self, high: bool) {
        self.trigger_in = high;
        let now_ns = self.now_ns;
        if let Life::Up(logic) | Life::Hung(logic, _) = &mut self.life {
            logic.engine_mut().set_now_ns(now_ns);
            logic.engine_mut().set_trigger_in(high);
        }
    }

    fn set_link_connected(&mut self, connected: bool) {
        if connected == self.link_connected {
            return;
        }
        self.link_connected = connected;
        self.to_device.clear();
        self.to_host.clear();
        self.suspend_at_ns = None;
        if self.options.board == BoardKind::F350 {
            if connected {
                self.with_logic(|logic, now_us| logic.on_link_up(now_us));
            } else {
                self.suspend_at_ns = Some(self.now_ns + SUSPEND_NS);
            }
        }
    }
}
