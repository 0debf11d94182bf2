//! The gate engine in virtual time: what timer, compare outputs and DMA do on the chip, computed.
//!
//! The timer counts microseconds of the device's clock. Edges come out exactly where the plan's
//! compare values put them.

use stspp_firmware_logic::hardware::{Aborted, GateEngine, SlotDone, TriggerEdges};
use stspp_firmware_logic::runner::START_LEAD_US;
use stspp_firmware_logic::timing::{GateWord, SlotPlan};
use stspp_protocol::trigger::{TriggerEdge, TriggerSource};
use stspp_protocol::usb::SOF_MODULUS;

use super::clock::DeviceClock;
use crate::device::{Line, PinEdge};

/// Cameras that are triggered, both at once.
const CAMERAS: u8 = 2;

/// What happens next within a slot, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Phase {
    GateOn,
    TriggerOn,
    TriggerOff,
    GateOff,
    Boundary,
    /// No slot is under way; the next one waits for an edge at trigger-in.
    Waiting,
}

#[derive(Debug, Clone)]
struct Run {
    slot_start_us: u64,
    slot_number: u32,
    slot_index: usize,
    end: Option<u32>,
    phase: Phase,
    /// Slots start by edges at trigger-in.
    external: bool,
    /// Start of the slot that an edge has asked for.
    asked_us: Option<u64>,
    /// The soonest that an edge's slot may start.
    soonest_us: u64,
}

impl Run {
    /// Slots that have begun, or that an edge has asked for.
    fn slots_begun(&self) -> u32 {
        let under_way = self.phase != Phase::Waiting;
        self.slot_number + u32::from(under_way) + u32::from(self.asked_us.is_some())
    }
}

/// Gate engine of the in-process device.
#[derive(Debug)]
pub struct VirtualEngine {
    clock: DeviceClock,
    has_usb: bool,
    now_ns: u64,
    plan: Option<SlotPlan>,
    pending: Option<SlotPlan>,
    run: Option<Run>,
    /// End of a floodlight pulse outside of a run, device time.
    floodlight_until_us: Option<u64>,
    gates: GateWord,
    triggers: bool,
    edges: Vec<PinEdge>,
    stalls_at_next_slot: bool,
    source: TriggerSource,
    trigger_in: bool,
    taken: u32,
    ignored: u32,
}

impl VirtualEngine {
    /// A stopped engine, all outputs low.
    pub fn new(clock: DeviceClock, has_usb: bool) -> Self {
        Self {
            clock,
            has_usb,
            now_ns: 0,
            plan: None,
            pending: None,
            run: None,
            floodlight_until_us: None,
            gates: GateWord::DARK,
            triggers: false,
            edges: Vec::new(),
            stalls_at_next_slot: false,
            source: TriggerSource::FreeRunning,
            trigger_in: false,
            taken: 0,
            ignored: 0,
        }
    }

    /// The level at trigger-in, from now on.
    pub fn set_trigger_in(&mut self, high: bool) {
        if std::mem::replace(&mut self.trigger_in, high) == high {
            return;
        }
        let TriggerSource::External(external) = self.source else { return };
        if high != (external.edge == TriggerEdge::Rising) {
            return;
        }
        let start_us = self.time_us() + u64::from(external.delay_us);
        let Some(run) = self.run.as_mut().filter(|run| run.external) else { return };
        if run.end.is_some_and(|end| run.slots_begun() >= end) {
            return;
        }
        if start_us >= run.soonest_us && run.asked_us.is_none() {
            run.asked_us = Some(start_us);
            self.taken = self.taken.wrapping_add(1);
            if run.slot_number == 0 && run.phase == Phase::Waiting {
                // The first slot of a run is under way from now on: no plan takes over before it.
                self.settle_cycle();
            }
        } else {
            self.ignored = self.ignored.wrapping_add(1);
        }
    }

    /// Sets the time at which the firmware's next calls happen.
    pub fn set_now_ns(&mut self, now_ns: u64) {
        self.now_ns = now_ns;
    }

    /// Device time at `time_ns`.
    pub fn now_us(&self, time_ns: u64) -> u64 {
        self.clock.us_from_ns(time_ns)
    }

    /// Virtual time at which the device's clock first shows `time_us`.
    pub fn ns_from_us(&self, time_us: u64) -> u64 {
        self.clock.ns_from_us(time_us)
    }

    /// Moves the edges so far to `edges`.
    pub fn take_edges(&mut self, edges: &mut Vec<PinEdge>) {
        edges.append(&mut self.edges);
    }

    /// Lets the gate timer stop counting at the next slot boundary: a fault for tests.
    pub fn stall(&mut self) {
        self.stalls_at_next_slot = true;
    }

    /// When the hardware does something next.
    pub fn next_event_ns(&self) -> Option<u64> {
        self.next_event_us().map(|time_us| self.clock.ns_from_us(time_us))
    }

    fn next_event_us(&self) -> Option<u64> {
        let run_us = match (&self.run, &self.plan) {
            (Some(run), Some(_)) if run.phase == Phase::Waiting => run.asked_us,
            (Some(run), Some(plan)) => {
                let ticks = match run.phase {
                    Phase::GateOn => plan.gate_on_ticks(),
                    Phase::TriggerOn => plan.trigger_on_ticks(),
                    Phase::TriggerOff => plan.trigger_off_ticks(),
                    Phase::GateOff => plan.gate_off_ticks(),
                    Phase::Boundary | Phase::Waiting => plan.period_ticks(),
                };
                Some(run.slot_start_us + u64::from(ticks / plan.ticks_per_us()))
            }
            _ => None,
        };
        run_us.into_iter().chain(self.floodlight_until_us).min()
    }

    /// Does what happens at [`next_event_ns`](Self::next_event_ns). A slot that is done comes back, as
    /// the interrupt reports it.
    pub fn step(&mut self) -> Option<SlotDone> {
        let time_us = self.next_event_us()?;
        let time_ns = self.clock.ns_from_us(time_us);
        self.now_ns = time_ns;
        if self.floodlight_until_us == Some(time_us) {
            self.floodlight_until_us = None;
            self.set_gates(time_ns, GateWord::DARK);
            return None;
        }
        if self.run.as_ref()?.phase == Phase::Waiting {
            self.begin_external_slot(time_us);
            return None;
        }
        let (run, plan) = (self.run.as_mut()?, self.plan.as_ref()?);
        let gates = plan.gates()[run.slot_index];
        match run.phase {
            Phase::GateOn => {
                run.phase = Phase::TriggerOn;
                self.set_gates(time_ns, gates);
                None
            }
            Phase::TriggerOn => {
                run.phase = Phase::TriggerOff;
                self.set_triggers(time_ns, true);
                None
            }
            Phase::TriggerOff => {
                run.phase = Phase::GateOff;
                self.set_triggers(time_ns, false);
                None
            }
            Phase::GateOff => {
                run.phase = Phase::Boundary;
                let done = self.slot_done(gates);
                self.set_gates(time_ns, GateWord::DARK);
                if let Some(run) = self.run.as_mut().filter(|run| run.external) {
                    run.phase = Phase::Waiting;
                    run.slot_number += 1;
                    run.slot_index += 1;
                }
                done
            }
            Phase::Boundary | Phase::Waiting => {
                self.next_slot(time_us);
                None
            }
        }
    }

    /// Starts the slot that an edge at trigger-in has asked for.
    fn begin_external_slot(&mut self, time_us: u64) {
        let Some(run) = &mut self.run else { return };
        run.asked_us = None;
        run.slot_start_us = time_us;
        run.phase = Phase::GateOn;
        if run.slot_number > 0 {
            self.settle_cycle();
        }
        if let (Some(run), Some(plan)) = (&mut self.run, &self.plan) {
            run.soonest_us = time_us + u64::from(plan.period_ticks() / plan.ticks_per_us());
        }
    }

    /// At the end of a cycle the next one begins, under a new plan where one waits.
    fn settle_cycle(&mut self) {
        let Some(run) = &mut self.run else { return };
        if self.plan.as_ref().is_none_or(|plan| run.slot_index >= plan.gates().len()) {
            run.slot_index = 0;
        }
        if run.slot_index == 0
            && let Some(pending) = self.pending.take()
        {
            self.plan = Some(pending);
        }
    }

    fn slot_done(&mut self, gates: GateWord) -> Option<SlotDone> {
        let (run, plan) = (self.run.as_ref()?, self.plan.as_ref()?);
        let us = |ticks: u32| ticks / plan.ticks_per_us();
        let trigger_time_us = run.slot_start_us + u64::from(us(plan.trigger_on_ticks()));
        let sof = |time_us| {
            let milliseconds = self.clock.ns_from_us(time_us) / 1_000_000;
            (milliseconds % u64::from(SOF_MODULUS)) as u16
        };
        let done = SlotDone {
            slot_number: run.slot_number,
            slot_index: run.slot_index as u8,
            gates,
            timing_generation: plan.timing_generation(),
            trigger_time_us,
            on_time_us: us(plan.on_time_ticks()),
            usb_sof: self.has_usb.then(|| sof(trigger_time_us)),
        };
        if run.end.is_some_and(|end| run.slot_number + 1 >= end) {
            self.run = None;
        }
        Some(done)
    }

    fn next_slot(&mut self, time_us: u64) {
        let Some(run) = &mut self.run else { return };
        if self.stalls_at_next_slot {
            self.stalls_at_next_slot = false;
            self.run = None;
            return;
        }
        run.slot_start_us = time_us;
        run.slot_number += 1;
        run.slot_index += 1;
        run.phase = Phase::GateOn;
        self.settle_cycle();
    }

    fn set_gates(&mut self, time_ns: u64, gates: GateWord) {
        let changed = self.gates.projector_mask() ^ gates.projector_mask();
        for index in (0..16).filter(|index| changed >> index & 1 != 0) {
            let high = gates.projector_mask() >> index & 1 != 0;
            self.edges.push(PinEdge { time_ns, line: Line::Projector(index), high });
        }
        if self.gates.floodlight() != gates.floodlight() {
            let high = gates.floodlight();
            self.edges.push(PinEdge { time_ns, line: Line::Floodlight, high });
        }
        self.gates = gates;
    }

    fn set_triggers(&mut self, time_ns: u64, high: bool) {
        if self.triggers != high {
            for camera in 0..CAMERAS {
                self.edges.push(PinEdge { time_ns, line: Line::CameraTrigger(camera), high });
            }
        }
        self.triggers = high;
    }

    fn time_us(&self) -> u64 {
        self.clock.us_from_ns(self.now_ns)
    }
}

impl GateEngine for VirtualEngine {
    fn ticks_per_us(&self) -> u32 {
        1
    }

    fn load(&mut self, plan: &SlotPlan) {
        if self.run.is_some() {
            self.pending = Some(plan.clone());
        } else {
            self.plan = Some(plan.clone());
            self.pending = None;
        }
    }

    fn start(&mut self, slots: Option<u32>) -> u64 {
        if let Some(pending) = self.pending.take() {
            self.plan = Some(pending);
        }
        let external = self.source != TriggerSource::FreeRunning;
        let start_us = self.time_us() + if external { 0 } else { START_LEAD_US };
        self.run = Some(Run {
            slot_start_us: start_us,
            slot_number: 0,
            slot_index: 0,
            end: slots,
            phase: if external { Phase::Waiting } else { Phase::GateOn },
            external,
            asked_us: None,
            soonest_us: start_us,
        });
        start_us
    }

    fn stop(&mut self) -> u32 {
        let Some(run) = &mut self.run else { return 0 };
        if run.external {
            // A slot that has not begun is taken back, but for the first.
            if run.slots_begun() > 1 {
                run.asked_us = None;
            }
            let slots = run.slots_begun();
            run.end = Some(slots);
            if run.phase == Phase::Waiting && run.asked_us.is_none() {
                self.run = None;
            }
            return slots;
        }
        let slots = run.slot_number + 1;
        if run.phase == Phase::Boundary {
            self.run = None;
        } else {
            run.end = Some(slots);
        }
        slots
    }

    fn force_off(&mut self) -> Aborted {
        let aborted = match (self.run.take(), &self.plan) {
            (Some(run), Some(plan)) => {
                let risen = run.phase > Phase::TriggerOn && run.phase != Phase::Waiting;
                let triggered = u32::from(risen);
                let is_lit = run.phase > Phase::GateOn && run.phase < Phase::Boundary;
                let on_since_us =
                    run.slot_start_us + u64::from(plan.gate_on_ticks() / plan.ticks_per_us());
                let on_time_us = self.time_us().saturating_sub(on_since_us) + 1;
                Aborted {
                    slots_triggered: run.slot_number + triggered,
                    gates: if is_lit { self.gates } else { GateWord::DARK },
                    on_time_us: if is_lit { on_time_us as u32 } else { 0 },
                }
            }
            _ => Aborted::default(),
        };
        self.floodlight_until_us = None;
        self.set_gates(self.now_ns, GateWord::DARK);
        self.set_triggers(self.now_ns, false);
        aborted
    }

    fn set_floodlight(&mut self, duration_us: u32) {
        if duration_us == 0 {
            self.floodlight_until_us = None;
            self.set_gates(self.now_ns, GateWord::DARK);
        } else {
            self.floodlight_until_us = Some(self.time_us() + u64::from(duration_us));
            self.set_gates(self.now_ns, GateWord::FLOODLIGHT_ONLY);
        }
    }

    fn floodlight_is_on(&self) -> bool {
        self.run.is_none() && self.gates.floodlight()
    }

    fn set_trigger_source(&mut self, source: TriggerSource) {
        self.source = source;
    }

    fn trigger_edges(&self) -> TriggerEdges {
        let run = self.run.as_ref().filter(|run| run.external);
        let slot_under_way_us = run.and_then(|run| match run.phase {
            Phase::Waiting => run.asked_us,
            _ => Some(run.slot_start_us),
        });
        TriggerEdges { taken: self.taken, ignored: self.ignored, slot_under_way_us }
    }
}
