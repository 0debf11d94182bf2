//! The state machine: what goes in, what comes out, and when the light may be on.
//!
//! ```text
//!              Arm                    StartStream, StartBurst
//!   ┌──────┐ ───────► ┌───────┐ ──────────────────────────► ┌─────────┐
//!   │ Idle │          │ Armed │                             │ Running │
//!   └──────┘ ◄─────── └───────┘ ◄────────────────────────── └─────────┘
//!      ▲    Disarm, Hello │      StopStream, burst done          │
//!      │                  │                                      │
//!      │◄─────────────────┼──────────── Disarm, Hello ───────────┤
//!      │ ClearFaults      ▼ fault                                ▼ fault
//!      └───────────────────────────── Faulted ◄──────────────────┘
//! ```
//!
//! Outputs can be high in `Running`, and the floodlight's in `Armed`; on leaving them they are forced
//! off. Some faults latch in `Idle` too: see [`interlock`](crate::interlock).
//!
//! Whoever owns a [`Controller`] calls it with the device time of the moment: [`receive`] for bytes of
//! the link, [`on_slot_done`] and the other `on_` methods for what the hardware reports, and [`poll`] no
//! later than [`next_deadline_us`]. It takes replies from `receive` and events from [`next_event`].
//!
//! [`receive`]: Controller::receive
//! [`on_slot_done`]: Controller::on_slot_done
//! [`poll`]: Controller::poll
//! [`next_deadline_us`]: Controller::next_deadline_us
//! [`next_event`]: Controller::next_event

use stspp_protocol::event::{BootEvent, FaultEvent, StateEvent};
use stspp_protocol::fault::{FaultReason, FaultRecord, FaultSet};
use stspp_protocol::message::{Event, Reply, Request, Serve, encode_error};
use stspp_protocol::reply::{DeviceState, LinkCounters, RequestError};
use stspp_protocol::timing::Limits;
use stspp_protocol::trigger::TriggerSource;
use stspp_protocol::version::{
    BoardKind, Capabilities, DeviceInfo, FirmwareVersion, PROTOCOL_VERSION, ResetCause,
    SerialNumber,
};
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};

use crate::duty::{DutyBudget, Exhausted};
use crate::hardware::{GateEngine, SettingsStore, SlotDone, SystemAction};
use crate::interlock::Interlock;
use crate::outbox::Outbox;
use crate::sequencer::{Sequencer, Strayed};
use crate::settings::{self, Settings};
use crate::timing::{GateWord, SlotPlan};

/// The floodlight's timer is overdue when it is this late.
pub const FLOODLIGHT_MARGIN_US: u64 = 1_000;

/// Who the device is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Hardware; its limits hold.
    pub board: BoardKind,
    /// Unique per chip.
    pub serial: SerialNumber,
    /// Version of the firmware.
    pub firmware: FirmwareVersion,
    /// Optional abilities.
    pub capabilities: Capabilities,
}

/// Version of this firmware: the logic's, on whatever board it runs.
pub const FIRMWARE_VERSION: FirmwareVersion = FirmwareVersion {
    major: decimal(env!("CARGO_PKG_VERSION_MAJOR")),
    minor: decimal(env!("CARGO_PKG_VERSION_MINOR")),
    patch: decimal(env!("CARGO_PKG_VERSION_PATCH")),
};

const fn decimal(digits: &str) -> u8 {
    match u8::from_str_radix(digits, 10) {
        Ok(number) => number,
        Err(_) => 0,
    }
}

impl Identity {
    /// A board with everything that it can have.
    #[must_use]
    pub const fn new(board: BoardKind, serial: SerialNumber) -> Self {
        let both = Capabilities::SETTINGS_STORE
            .union(Capabilities::BOOTLOADER)
            .union(Capabilities::FLOODLIGHT)
            .union(Capabilities::TEMPERATURE)
            .union(Capabilities::TRIGGER_IN);
        let capabilities = match board {
            BoardKind::F330 => both,
            BoardKind::F350 => both.union(Capabilities::USB_SOF),
        };
        Self { board, serial, firmware: FIRMWARE_VERSION, capabilities }
    }
}

/// How the controller came up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Boot {
    /// Why it was reset.
    pub cause: ResetCause,
    /// Faults that were latched before the reset or caused it.
    pub carried: FaultSet,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Session {
    None,
    Open,
    /// The host's major version is another.
    Refused,
}

/// The floodlight, on by request.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Floodlight {
    pub(crate) since_us: u64,
    pub(crate) charged_until_us: u64,
    pub(crate) until_us: u64,
}

/// The firmware's logic over a gate engine and a settings store.
#[derive(Debug)]
pub struct Controller<E, S> {
    pub(crate) identity: Identity,
    pub(crate) limits: Limits,
    pub(crate) engine: E,
    pub(crate) store: S,
    pub(crate) boot: Boot,
    pub(crate) session: Session,
    pub(crate) state: DeviceState,
    pub(crate) now_us: u64,
    last_heard_us: u64,
    pub(crate) interlock: Interlock,
    pub(crate) duty: DutyBudget,
    pub(crate) sequencer: Sequencer,
    pub(crate) floodlight: Option<Floodlight>,
    pub(crate) outbox: Outbox,
    decoder: FrameDecoder,
    bytes_overrun: u32,
    pub(crate) action: Option<SystemAction>,
    pub(crate) trigger_source: TriggerSource,
    /// Minor of the host's protocol, from its `Hello`; 0 before one.
    pub(crate) host_minor: u16,
}

impl<E: GateEngine, S: SettingsStore> Controller<E, S> {
    /// Comes up dark: forces the outputs off, loads the stored settings (or a new device's where there
    /// are none that this board can meet), and announces itself.
    pub fn new(identity: Identity, mut engine: E, store: S, boot: Boot) -> Self {
        let limits = identity.board.limits();
        engine.force_off();
        let stored = settings::load(&store)
            .ok()
            .filter(|stored| stored.timing.validate(&limits).is_ok())
            .unwrap_or_default();
        let sequencer = Sequencer::new(stored.timing);
        let plan = SlotPlan::compile(
            sequencer.timing(),
            &limits,
            engine.ticks_per_us(),
            sequencer.generation(),
        );
        if let Ok(plan) = plan {
            engine.load(&plan);
        }
        let interlock = Interlock::new(&limits, boot.carried);
        let state = if boot.carried.is_empty() { DeviceState::Idle } else { DeviceState::Faulted };
        let mut outbox = Outbox::new();
        outbox.push(BootEvent {
            protocol: PROTOCOL_VERSION,
            reset_cause: boot.cause,
            latched: boot.carried,
        });
        Self {
            identity,
            limits,
            engine,
            store,
            boot,
            session: Session::None,
            state,
            now_us: 0,
            last_heard_us: 0,
            interlock,
            duty: DutyBudget::new(&limits, boot.cause == ResetCause::PowerOn),
            sequencer,
            floodlight: None,
            outbox,
            decoder: FrameDecoder::new(),
            bytes_overrun: 0,
            action: None,
            trigger_source: TriggerSource::FreeRunning,
            host_minor: 0,
        }
    }

    // ---- Inputs -------------------------------------------------------------------------------

    /// Takes bytes of the link from the front of `bytes`, up to the end of the first request that is
    /// answered; its reply is the first `n` bytes of `out`. `None` when all bytes are taken.
    pub fn receive(
        &mut self,
        now_us: u64,
        bytes: &mut &[u8],
        out: &mut [u8; MAX_FRAME_LEN],
    ) -> Option<usize> {
        self.poll(now_us);
        loop {
            let (seq, request) = match self.decoder.next_frame(bytes)? {
                Ok(frame) => (frame.seq, Request::decode(&frame)),
                Err(_) => continue,
            };
            let reply = request.and_then(|request| self.answer(request));
            let encoded = match &reply {
                Ok(reply) => reply.encode(seq, out),
                Err(error) => encode_error(seq, error, out),
            };
            if let Ok(frame) = encoded {
                return Some(frame.len());
            }
        }
    }

    fn answer(&mut self, request: Request) -> Result<Reply, RequestError> {
        self.last_heard_us = self.now_us;
        if self.session == Session::Refused && !matches!(request, Request::Hello(_)) {
            return Err(RequestError::VersionMismatch { device: PROTOCOL_VERSION });
        }
        self.serve(request)
    }

    /// Lets time-outs happen. Call no later than [`next_deadline_us`](Self::next_deadline_us).
    pub fn poll(&mut self, now_us: u64) {
        self.now_us = self.now_us.max(now_us);
        let now_us = self.now_us;
        let silence_us = now_us.saturating_sub(self.last_heard_us);
        let timeout_us = self.limits.heartbeat_timeout_us;
        if self.light_allowed() && silence_us >= u64::from(timeout_us) {
            let silence_us = i32::try_from(silence_us).unwrap_or(i32::MAX);
            self.fault(FaultReason::HeartbeatLost, silence_us, as_value(timeout_us));
        }
        if self.slot_deadline_us().is_some_and(|deadline_us| now_us >= deadline_us) {
            let done = self.sequencer.slots_done();
            self.fault(FaultReason::Engine, as_value(done), as_value(done.saturating_add(1)));
        }
        if let Some(floodlight) = self.floodlight
            && now_us >= floodlight.until_us
        {
            if !self.engine.floodlight_is_on() {
                self.charge_floodlight();
                self.floodlight = None;
            } else if now_us >= floodlight.until_us.saturating_add(FLOODLIGHT_MARGIN_US) {
                let on_us = now_us.saturating_sub(floodlight.since_us);
                let allowed_us = floodlight.until_us.saturating_sub(floodlight.since_us);
                let value = |us: u64| i32::try_from(us).unwrap_or(i32::MAX);
                self.fault(FaultReason::OnTime, value(on_us), value(allowed_us));
            }
        }
    }

    /// Device time by which [`poll`](Self::poll) must be called; `None` while nothing is due.
    #[must_use]
    pub fn next_deadline_us(&self) -> Option<u64> {
        let heartbeat = self.light_allowed().then(|| {
            self.last_heard_us.saturating_add(u64::from(self.limits.heartbeat_timeout_us))
        });
        let floodlight = self
            .floodlight
            .map(|floodlight| floodlight.until_us.saturating_add(FLOODLIGHT_MARGIN_US));
        [heartbeat, floodlight, self.slot_deadline_us()].into_iter().flatten().min()
    }

    fn slot_deadline_us(&self) -> Option<u64> {
        self.sequencer.deadline_us(self.engine.trigger_edges().slot_under_way_us)
    }

    /// Takes the engine's report of a slot whose gate has gone off.
    pub fn on_slot_done(&mut self, now_us: u64, done: &SlotDone) {
        self.now_us = self.now_us.max(now_us);
        self.duty.advance(self.now_us);
        let charged = self.duty.charge(done.gates, done.on_time_us);
        match self.sequencer.slot_done(done, &self.limits) {
            Ok(progress) => {
                if let Some(timing) = progress.timing {
                    self.outbox.push(timing);
                }
                self.outbox.push(progress.trigger);
                if progress.run_ended && self.state == DeviceState::Running {
                    self.enter(DeviceState::Armed);
                }
            }
            Err(Strayed::Slot { seen, expected }) => {
                self.fault(FaultReason::Engine, as_value(seen), as_value(expected));
            }
            Err(Strayed::OnTime { seen_us, limit_us }) => {
                self.fault(FaultReason::OnTime, as_value(seen_us), as_value(limit_us));
            }
        }
        if let Err(exhausted) = charged {
            self.duty_fault(exhausted);
        }
    }

    /// Takes the level of the interlock input. The board itself has forced the outputs off on opening,
    /// within its bound; this latches the reason.
    pub fn on_interlock(&mut self, now_us: u64, closed: bool) {
        self.now_us = self.now_us.max(now_us);
        self.interlock.set_active(FaultReason::Interlock, !closed);
        if !closed && self.light_allowed() {
            self.fault(FaultReason::Interlock, 0, 0);
        }
    }

    /// Takes a temperature reading, tenths of a degree Celsius.
    pub fn on_temperature(&mut self, now_us: u64, temperature_dc: i16) {
        self.now_us = self.now_us.max(now_us);
        if let Some(record) = self.interlock.read_temperature(self.now_us, temperature_dc)
            && !self.interlock.latched().contains(record.reason)
        {
            self.fault(record.reason, record.value, record.limit);
        }
    }

    /// The link went down (USB suspend or reset, cable pulled). The session is over.
    pub fn on_link_lost(&mut self, now_us: u64) {
        self.now_us = self.now_us.max(now_us);
        self.session = Session::None;
        self.decoder.reset();
        self.interlock.set_active(FaultReason::LinkLost, true);
        if self.light_allowed() {
            self.fault(FaultReason::LinkLost, 0, 0);
        }
    }

    /// The link is up again.
    pub fn on_link_up(&mut self, now_us: u64) {
        self.now_us = self.now_us.max(now_us);
        self.interlock.set_active(FaultReason::LinkLost, false);
    }

    /// Notes bytes that the receiver lost.
    pub fn on_overrun(&mut self, bytes: u32) {
        self.bytes_overrun = self.bytes_overrun.wrapping_add(bytes);
    }

    /// A fault that the board found.
    pub fn on_fault(&mut self, now_us: u64, reason: FaultReason, value: i32, limit: i32) {
        self.now_us = self.now_us.max(now_us);
        self.fault(reason, value, limit);
    }

    /// The board found that a debugger has halted the processor: the outputs' supervision stood still.
    pub fn on_debug_halt(&mut self, now_us: u64) {
        self.now_us = self.now_us.max(now_us);
        if self.light_allowed() {
            self.fault(FaultReason::DebugHalt, 0, 0);
        }
    }

    /// The board is not the one that this firmware is for: no light for as long as it runs.
    pub fn on_wrong_board(&mut self, found: i32, needed: i32) {
        self.interlock.set_active(FaultReason::WrongBoard, true);
        self.fault(FaultReason::WrongBoard, found, needed);
    }

    // ---- Outputs ------------------------------------------------------------------------------

    /// Writes the next event as a frame; it is the first `n` bytes of `out`.
    pub fn next_event(&mut self, out: &mut [u8; MAX_FRAME_LEN]) -> Option<usize> {
        loop {
            let (seq, event): (u16, Event) = self.outbox.pop()?;
            if let Ok(frame) = event.encode(seq, out) {
                return Some(frame.len());
            }
        }
    }

    /// Whether an event waits.
    #[must_use]
    pub fn has_event(&self) -> bool {
        !self.outbox.is_empty()
    }

    /// What to do once all replies are out.
    pub const fn take_action(&mut self) -> Option<SystemAction> {
        self.action.take()
    }

    /// What the device is doing.
    #[must_use]
    pub const fn state(&self) -> DeviceState {
        self.state
    }

    /// Latched faults; the board keeps them over a reset.
    #[must_use]
    pub const fn latched(&self) -> FaultSet {
        self.interlock.latched()
    }

    /// The gate engine.
    #[must_use]
    pub const fn engine(&self) -> &E {
        &self.engine
    }

    /// The gate engine, for its owner's interrupt.
    pub const fn engine_mut(&mut self) -> &mut E {
        &mut self.engine
    }

    /// Gives back engine and store.
    #[must_use]
    pub fn into_parts(self) -> (E, S) {
        (self.engine, self.store)
    }

    // ---- State --------------------------------------------------------------------------------

    pub(crate) fn info(&self) -> DeviceInfo {
        DeviceInfo {
            protocol: PROTOCOL_VERSION,
            firmware: self.identity.firmware,
            board: self.identity.board,
            serial: self.identity.serial,
            capabilities: self.identity.capabilities,
            limits: self.limits,
            reset_cause: self.boot.cause,
            latched: self.interlock.latched(),
        }
    }

    pub(crate) const fn link_counters(&self) -> LinkCounters {
        LinkCounters {
            frames_received: self.decoder.received(),
            frames_rejected: self.decoder.rejected(),
            bytes_overrun: self.bytes_overrun,
        }
    }

    pub(crate) fn settings(&self) -> Settings {
        Settings { timing: self.sequencer.timing().clone() }
    }

    const fn light_allowed(&self) -> bool {
        matches!(self.state, DeviceState::Armed | DeviceState::Running)
    }

    pub(crate) fn enter(&mut self, state: DeviceState) {
        if state != self.state {
            let from = core::mem::replace(&mut self.state, state);
            self.outbox.push(StateEvent {
                from,
                to: state,
                time_us: self.now_us,
                next_frame_sequence: self.sequencer.next_frame_sequence(),
            });
        }
    }

    /// Forces every output off and settles what was lit. Returns an emitter that has overdrawn.
    fn force_off(&mut self) -> Result<(), Exhausted> {
        let aborted = self.engine.force_off();
        let was_running = self.sequencer.is_running();
        self.sequencer.aborted(aborted.slots_triggered);
        self.charge_floodlight();
        self.floodlight = None;
        if was_running {
            self.duty.advance(self.now_us);
            return self.duty.charge(aborted.gates, aborted.on_time_us);
        }
        Ok(())
    }

    /// Forces every output off and goes to `Idle`, or stays `Faulted`.
    pub(crate) fn go_dark(&mut self) {
        let settled = self.force_off();
        if self.state != DeviceState::Faulted {
            self.enter(DeviceState::Idle);
        }
        if let Err(exhausted) = settled {
            self.duty_fault(exhausted);
        }
    }

    fn fault(&mut self, reason: FaultReason, value: i32, limit: i32) {
        // The outputs are off already; a bucket that this overdraws adds nothing to that.
        let _ = self.force_off();
        let record = FaultRecord { reason, time_us: self.now_us, value, limit };
        if let Some(mut record) = self.interlock.latch(record) {
            record.reason = record.reason.as_of(self.host_minor);
            self.outbox.push(FaultEvent { record, latched: self.interlock.latched() });
        }
        self.enter(DeviceState::Faulted);
    }

    fn duty_fault(&mut self, exhausted: Exhausted) {
        self.fault(
            FaultReason::Duty,
            as_value(exhausted.level_us),
            as_value(exhausted.capacity_us),
        );
    }

    /// Charges the floodlight's time since it was charged last.
    pub(crate) fn charge_floodlight(&mut self) {
        let Some(floodlight) = &mut self.floodlight else { return };
        let until_us = self.now_us.min(floodlight.until_us);
        let on_us = until_us.saturating_sub(floodlight.charged_until_us);
        floodlight.charged_until_us = until_us;
        self.duty.advance(until_us);
        // At most the longest on-time, on a bucket that was half empty: it cannot run over.
        let _ =
            self.duty.charge(GateWord::FLOODLIGHT_ONLY, u32::try_from(on_us).unwrap_or(u32::MAX));
    }
}

fn as_value(number: u32) -> i32 {
    i32::try_from(number).unwrap_or(i32::MAX)
}
