//! Runs a [`SlotPlan`] on hardware that takes timed writes ahead of time.
//!
//! A slot is *committed* when its edges are handed to the [`EdgeQueue`]; from then on they happen
//! without software. Slot `n + 1` is committed when slot `n`'s first edge has happened, so there is
//! always a whole slot's time for it, and what is committed is at most two slots: when the software
//! dies, the light ends by itself.
//!
//! ```text
//!   slot n      gate on ─ trigger on ─ trigger off ─ gate off
//!                  │                                    │
//!   software       ├► commits n + 1                     └► reports n (SlotDone)
//!   stop, load     └► retract n + 1 if it has not begun and can still be held
//! ```
//!
//! In a run with an external trigger a slot is committed when its edge is seen
//! ([`Runner::on_trigger_edge`]), and nothing else commits one.
//!
//! The owner calls [`Runner::on_events`] from the interrupt that follows each edge. How late that
//! runs does not move any edge; it must only run once per slot.

use heapless::{Deque, Vec};

use stspp_protocol::trigger::TriggerSource;

use crate::hardware::{Aborted, SlotDone, TriggerEdges};
use crate::timing::{GateWord, SlotPlan};

/// From a start request to slot 0.
pub const START_LEAD_US: u64 = 60;

/// Most edges of a slot.
pub const SLOT_EDGES: usize = 4;

/// What an edge does to the outputs; `None` leaves them alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Effect {
    /// Exactly these gates are on from now on.
    pub gates: Option<GateWord>,
    /// Level of the camera triggers.
    pub triggers: Option<bool>,
}

/// An edge at a device time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Edge {
    /// When.
    pub at_us: u64,
    /// What.
    pub effect: Effect,
}

/// The edges came too late, or there is no room for them; none has been queued or retracted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refused;

/// Hardware that works off timed writes on its own. Events are its edges, counted from 0.
pub trait EdgeQueue {
    /// Device time.
    fn now_us(&self) -> u64;

    /// Forgets everything and counts from 0 again.
    fn restart(&mut self);

    /// Queues edges in order of time, all or none; returns the number of the first.
    ///
    /// # Errors
    ///
    /// [`Refused`] where they cannot be met.
    fn queue(&mut self, edges: &[Edge]) -> Result<u32, Refused>;

    /// Takes back event `first` and all after it.
    ///
    /// # Errors
    ///
    /// [`Refused`] where it is too late for that.
    fn retract(&mut self, first: u32) -> Result<(), Refused>;
}

#[derive(Debug, Clone)]
struct Slot {
    number: u32,
    index: usize,
    gates: GateWord,
    generation: u16,
    start_us: u64,
    gate_on_us: u64,
    trigger_on_us: u64,
    gate_off_us: u64,
    first_event: u32,
    edges: Vec<Edge, SLOT_EDGES>,
    usb_sof: Option<u16>,
}

#[derive(Debug, Clone, Copy)]
struct Run {
    next_number: u32,
    next_index: usize,
    /// Free-running: start of the next slot. External: the soonest that it may start.
    next_start_us: u64,
    end: Option<u32>,
    /// From an edge at trigger-in to the start of its slot; `None` for a free run.
    external_delay_us: Option<u32>,
}

/// What the events since the last call mean to a guard of the on-time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Light {
    /// All gates were off at some moment since the last call.
    pub was_dark: bool,
    /// A gate is on now.
    pub is_lit: bool,
}

/// The plan, the run, and the slots that are committed.
#[derive(Debug, Default)]
pub struct Runner {
    plan: Option<SlotPlan>,
    pending: Option<SlotPlan>,
    run: Option<Run>,
    committed: Deque<Slot, 4>,
    processed: u32,
    is_lit: bool,
    triggered: u32,
    source: TriggerSource,
    edges: TriggerEdges,
}

impl Runner {
    /// Stopped, without a plan.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            plan: None,
            pending: None,
            run: None,
            committed: Deque::new(),
            processed: 0,
            is_lit: false,
            triggered: 0,
            source: TriggerSource::FreeRunning,
            edges: TriggerEdges { taken: 0, ignored: 0, slot_under_way_us: None },
        }
    }

    /// Whether a slot is committed or may still be.
    #[must_use]
    pub fn is_running(&self) -> bool {
        !self.committed.is_empty() || self.waits_for_edge()
    }

    /// Whether an edge at trigger-in would start a slot now or later.
    #[must_use]
    pub fn waits_for_edge(&self) -> bool {
        self.run.is_some_and(|run| {
            run.external_delay_us.is_some() && run.end.is_none_or(|end| run.next_number < end)
        })
    }

    /// Chooses what starts the slots of the next run.
    pub const fn set_trigger_source(&mut self, source: TriggerSource) {
        self.source = source;
    }

    /// Edges so far, and the slot that waits or plays by one.
    #[must_use]
    pub fn trigger_edges(&self) -> TriggerEdges {
        let external = self.run.is_some_and(|run| run.external_delay_us.is_some());
        let slot = self.committed.front().filter(|_| external);
        TriggerEdges { slot_under_way_us: slot.map(|slot| slot.start_us), ..self.edges }
    }

    /// Notes an edge at trigger-in at `at_us`, and `more` that came too close to it to be told apart.
    /// Commits its slot, or counts it where that would begin too soon.
    pub fn on_trigger_edge(&mut self, at_us: u64, more: u32, queue: &mut impl EdgeQueue) {
        if !self.waits_for_edge() {
            return;
        }
        let Some(run) = &mut self.run else { return };
        let start_us = at_us.saturating_add(u64::from(run.external_delay_us.unwrap_or(0)));
        let number = run.next_number;
        if start_us >= run.next_start_us && !self.committed.is_full() {
            run.next_start_us = start_us;
            self.commit(queue);
        }
        // Too soon, or too late for the queue.
        let taken = self.run.is_some_and(|run| run.next_number != number);
        self.edges.taken = self.edges.taken.wrapping_add(u32::from(taken));
        let ignored = more.wrapping_add(u32::from(!taken));
        self.edges.ignored = self.edges.ignored.wrapping_add(ignored);
    }

    /// Takes a plan: for the next start or, running, for the next cycle boundary that can be met.
    pub fn load(&mut self, plan: &SlotPlan, queue: &mut impl EdgeQueue) {
        if !self.is_running() {
            self.plan = Some(plan.clone());
            self.pending = None;
            return;
        }
        self.pending = Some(plan.clone());
        // The boundary's slot may be committed already, under the old plan.
        let at_boundary = self.committed.back().is_some_and(|slot| slot.index == 0);
        if at_boundary && self.retract_next(queue) {
            self.commit(queue);
        }
    }

    /// Starts slot 0; returns its device time.
    pub fn start(&mut self, slots: Option<u32>, queue: &mut impl EdgeQueue) -> u64 {
        if let Some(pending) = self.pending.take() {
            self.plan = Some(pending);
        }
        queue.restart();
        self.committed.clear();
        self.processed = 0;
        self.triggered = 0;
        self.is_lit = false;
        let external_delay_us = match self.source {
            TriggerSource::FreeRunning => None,
            TriggerSource::External(external) => Some(external.delay_us),
        };
        let lead_us = if external_delay_us.is_some() { 0 } else { START_LEAD_US };
        let start_us = queue.now_us().saturating_add(lead_us);
        self.run = Some(Run {
            next_number: 0,
            next_index: 0,
            next_start_us: start_us,
            end: slots,
            external_delay_us,
        });
        if external_delay_us.is_none() {
            self.commit(queue);
        }
        start_us
    }

    /// Ends the run after the slot under way, or the next where that cannot be held any more.
    /// Returns how many slots the run will have had.
    pub fn stop(&mut self, queue: &mut impl EdgeQueue) -> u32 {
        self.retract_next(queue);
        let Some(run) = &mut self.run else { return self.triggered };
        run.end = Some(run.next_number);
        let slots = run.next_number;
        if self.committed.is_empty() {
            // Between two edges at trigger-in there is nothing to wait for.
            self.run = None;
        }
        slots
    }

    /// Notes that all outputs are off and the queue is dead, at `now_us` and after `happened`
    /// events.
    pub fn abort(&mut self, happened: u32, now_us: u64) -> Aborted {
        self.advance(happened, || None, |_| {});
        let lit = self.committed.front().filter(|_| self.is_lit);
        let aborted = Aborted {
            slots_triggered: self.triggered,
            gates: lit.map_or(GateWord::DARK, |slot| slot.gates),
            on_time_us: lit.map_or(0, |slot| {
                let on_us = now_us.saturating_sub(slot.gate_on_us).saturating_add(1);
                u32::try_from(on_us).unwrap_or(u32::MAX)
            }),
        };
        self.run = None;
        self.committed.clear();
        self.is_lit = false;
        aborted
    }

    /// Takes note of events: `happened` in all so far. Commits the next slot where one is due and
    /// hands finished ones to `report`. `usb_sof` is asked once per trigger.
    pub fn on_events(
        &mut self,
        happened: u32,
        usb_sof: impl FnMut() -> Option<u16>,
        report: impl FnMut(SlotDone),
        queue: &mut impl EdgeQueue,
    ) -> Light {
        let was_lit = self.is_lit;
        let was_dark = self.advance(happened, usb_sof, report) || !was_lit;
        if self.run.is_some_and(|run| run.external_delay_us.is_some()) {
            return Light { was_dark, is_lit: self.is_lit };
        }
        let first_has_begun = self.committed.front().is_some_and(|slot| {
            self.committed.len() == 1 && self.processed.wrapping_sub(slot.first_event) as i32 > 0
        });
        // A run whose only slot has finished before this ran is committed to nothing any more.
        let between = self.committed.is_empty() && self.run.is_some();
        if first_has_begun || between {
            self.commit(queue);
        }
        Light { was_dark, is_lit: self.is_lit }
    }

    /// Processes events up to `happened`; true where the gates went off among them.
    fn advance(
        &mut self,
        happened: u32,
        mut usb_sof: impl FnMut() -> Option<u16>,
        mut report: impl FnMut(SlotDone),
    ) -> bool {
        let mut went_dark = false;
        while happened.wrapping_sub(self.processed) as i32 > 0 {
            let event = self.processed;
            self.processed = event.wrapping_add(1);
            let Some(slot) = self.committed.front_mut() else { continue };
            let place = event.wrapping_sub(slot.first_event) as usize;
            let Some(edge) = slot.edges.get(place) else { continue };
            if edge.effect.triggers == Some(true) {
                slot.usb_sof = usb_sof();
                self.triggered = slot.number.saturating_add(1);
            }
            if let Some(gates) = edge.effect.gates {
                self.is_lit = gates != GateWord::DARK;
                went_dark |= !self.is_lit;
            }
            if place.saturating_add(1) < slot.edges.len() {
                continue;
            }
            let on_us = slot.gate_off_us.saturating_sub(slot.gate_on_us);
            report(SlotDone {
                slot_number: slot.number,
                slot_index: u8::try_from(slot.index).unwrap_or(u8::MAX),
                gates: slot.gates,
                timing_generation: slot.generation,
                trigger_time_us: slot.trigger_on_us,
                on_time_us: u32::try_from(on_us).unwrap_or(u32::MAX),
                usb_sof: slot.usb_sof,
            });
            self.committed.pop_front();
            if self.committed.is_empty()
                && self.run.is_some_and(|run| run.end.is_some_and(|end| run.next_number >= end))
            {
                self.run = None;
            }
        }
        went_dark
    }

    /// Takes the last committed slot back where it has not begun. True where that worked.
    fn retract_next(&mut self, queue: &mut impl EdgeQueue) -> bool {
        let (Some(slot), Some(run)) = (self.committed.back(), &mut self.run) else { return false };
        // The first slot of a run is under way from the start request on.
        if slot.number == 0 || queue.now_us() >= slot.start_us {
            return false;
        }
        if queue.retract(slot.first_event).is_err() {
            return false;
        }
        run.next_number = slot.number;
        run.next_index = slot.index;
        run.next_start_us = slot.start_us;
        self.committed.pop_back();
        true
    }

    /// Hands the next slot's edges to the queue.
    fn commit(&mut self, queue: &mut impl EdgeQueue) {
        let Some(run) = &mut self.run else { return };
        if run.end.is_some_and(|end| run.next_number >= end) {
            return;
        }
        if run.next_index == 0
            && let Some(pending) = self.pending.take()
        {
            self.plan = Some(pending);
        }
        let Some(plan) = &self.plan else { return };
        let Some(&gates) = plan.gates().get(run.next_index) else { return };
        let us = |ticks: u32| {
            let ticks = u64::from(ticks);
            run.next_start_us
                .saturating_add(ticks.checked_div(u64::from(plan.ticks_per_us())).unwrap_or(ticks))
        };
        let mut slot = Slot {
            number: run.next_number,
            index: run.next_index,
            gates,
            generation: plan.timing_generation(),
            start_us: run.next_start_us,
            gate_on_us: us(plan.gate_on_ticks()),
            trigger_on_us: us(plan.trigger_on_ticks()),
            gate_off_us: us(plan.gate_off_ticks()),
            first_event: 0,
            edges: Vec::new(),
            usb_sof: None,
        };
        let effects = [
            (slot.gate_on_us, Effect { gates: Some(gates), triggers: None }),
            (slot.trigger_on_us, Effect { gates: None, triggers: Some(true) }),
            (us(plan.trigger_off_ticks()), Effect { gates: None, triggers: Some(false) }),
            (slot.gate_off_us, Effect { gates: Some(GateWord::DARK), triggers: None }),
        ];
        for (at_us, effect) in effects {
            match slot.edges.last_mut() {
                // Without lead or lag two of them are one write to the port.
                Some(last) if last.at_us == at_us => {
                    last.effect.gates = last.effect.gates.or(effect.gates);
                    last.effect.triggers = last.effect.triggers.or(effect.triggers);
                }
                _ => {
                    // There is room for all four.
                    let _ = slot.edges.push(Edge { at_us, effect });
                }
            }
        }
        let period_us = us(plan.period_ticks());
        let slots = plan.gates().len();
        // Refused (too late): the run starves, and the controller's supervision ends it.
        let Ok(first_event) = queue.queue(&slot.edges) else { return };
        slot.first_event = first_event;
        run.next_number = run.next_number.saturating_add(1);
        run.next_start_us = period_us;
        run.next_index = run.next_index.saturating_add(1);
        if run.next_index >= slots {
            run.next_index = 0;
        }
        let _ = self.committed.push_back(slot);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec as StdVec;
    use stspp_protocol::timing::{Limits, ProjectionTiming, Slot as TimingSlot};

    extern crate std;

    const MARGIN_US: u64 = 20;

    /// A queue of edges in virtual time, as the chip's timer and DMA do it.
    #[derive(Default)]
    struct Port {
        now_us: u64,
        queued: StdVec<Edge>,
        happened: u32,
        trace: StdVec<Edge>,
        interrupt_at_us: Option<u64>,
    }

    impl EdgeQueue for Port {
        fn now_us(&self) -> u64 {
            self.now_us
        }

        fn restart(&mut self) {
            self.queued.clear();
            self.happened = 0;
        }

        fn queue(&mut self, edges: &[Edge]) -> Result<u32, Refused> {
            let last = self.queued.last().map_or(0, |edge| edge.at_us);
            let earliest = last.max(self.now_us + MARGIN_US - 1);
            let mut before = earliest;
            for edge in edges {
                if edge.at_us <= before {
                    return Err(Refused);
                }
                before = edge.at_us;
            }
            let first = self.queued.len() as u32;
            self.queued.extend(edges);
            Ok(first)
        }

        fn retract(&mut self, first: u32) -> Result<(), Refused> {
            let at_us = self.queued[first as usize].at_us;
            if at_us < self.now_us + MARGIN_US {
                return Err(Refused);
            }
            self.queued.truncate(first as usize);
            Ok(())
        }
    }

    /// Lets time pass; the interrupt runs `latency_us` after each edge.
    fn pass(
        runner: &mut Runner,
        port: &mut Port,
        until_us: u64,
        latency_us: u64,
        done: &mut StdVec<SlotDone>,
    ) {
        while port.now_us < until_us {
            port.now_us += 1;
            while let Some(edge) = port.queued.get(port.happened as usize)
                && edge.at_us == port.now_us
            {
                port.trace.push(*edge);
                port.happened += 1;
                port.interrupt_at_us.get_or_insert(port.now_us.saturating_add(latency_us));
            }
            if port.interrupt_at_us == Some(port.now_us) {
                port.interrupt_at_us = None;
                let happened = port.happened;
                runner.on_events(happened, || Some(7), |slot| done.push(slot), port);
            }
        }
    }

    fn plan(timing: &ProjectionTiming, generation: u16) -> SlotPlan {
        SlotPlan::compile(timing, &Limits::F330, 1, generation).unwrap()
    }

    fn timing(period_us: u32, exposure_us: u32, lead_us: u32, lag_us: u32) -> ProjectionTiming {
        ProjectionTiming {
            slots: (0..4).map(TimingSlot::projector).collect(),
            frame_period_us: period_us,
            exposure_us,
            trigger_delay_us: lead_us + 5,
            gate_lead_us: lead_us,
            gate_lag_us: lag_us,
        }
    }

    /// The edges of a run, straight from the timing's definition.
    fn expected(timing: &ProjectionTiming, start_us: u64, slots: u32) -> StdVec<(u64, Effect)> {
        let mut edges = StdVec::new();
        for number in 0..slots {
            let at = |us: u32| {
                start_us + u64::from(number) * u64::from(timing.frame_period_us) + u64::from(us)
            };
            let slot = timing.slots[number as usize % timing.slots.len()];
            let gates = |word| Effect { gates: Some(word), triggers: None };
            let triggers = |high| Effect { gates: None, triggers: Some(high) };
            edges.push((at(timing.gate_on_us()), gates(GateWord::from_slot(slot))));
            edges.push((at(timing.trigger_on_us()), triggers(true)));
            edges.push((at(timing.trigger_off_us()), triggers(false)));
            edges.push((at(timing.gate_off_us()), gates(GateWord::DARK)));
        }
        edges
    }

    /// A trace with merged edges taken apart again.
    fn apart(trace: &[Edge]) -> StdVec<(u64, Effect)> {
        let mut edges = StdVec::new();
        for edge in trace {
            let gates = edge.effect.gates.map(|w| Effect { gates: Some(w), triggers: None });
            let triggers =
                edge.effect.triggers.map(|high| Effect { gates: None, triggers: Some(high) });
            // On a shared tick: light first on rising, trigger first on falling.
            let (first, second) = match edge.effect.triggers {
                Some(false) => (triggers, gates),
                _ => (gates, triggers),
            };
            edges.extend([first, second].into_iter().flatten().map(|e| (edge.at_us, e)));
        }
        edges
    }

    proptest! {
        #[test]
        fn edges_and_reports_are_the_timings(
            period_us in 1_000u32..4_000, exposure_us in 10u32..980, lead_us in 0u32..200,
            lag_us in 0u32..200, slots in 1u32..12, latency_us in 0u64..400,
        ) {
            let timing = timing(period_us, exposure_us, lead_us, lag_us);
            prop_assume!(timing.validate(&Limits::F330).is_ok());
            let (mut runner, mut port, mut done) = (Runner::new(), Port::default(), StdVec::new());
            runner.load(&plan(&timing, 3), &mut port);
            let start_us = runner.start(Some(slots), &mut port);
            let end_us = start_us + u64::from(period_us) * u64::from(slots + 2);
            pass(&mut runner, &mut port, end_us, latency_us, &mut done);
            prop_assert_eq!(apart(&port.trace), expected(&timing, start_us, slots));
            prop_assert!(!runner.is_running());
            prop_assert_eq!(done.len(), slots as usize);
            for (number, slot) in done.iter().enumerate() {
                let at_us = start_us
                    + number as u64 * u64::from(period_us)
                    + u64::from(timing.trigger_on_us());
                prop_assert_eq!(slot.slot_number, number as u32);
                prop_assert_eq!(usize::from(slot.slot_index), number % 4);
                prop_assert_eq!(slot.trigger_time_us, at_us);
                prop_assert_eq!(slot.on_time_us, timing.on_time_us());
                prop_assert_eq!(slot.timing_generation, 3);
                prop_assert_eq!(slot.usb_sof, Some(7));
            }
        }

        #[test]
        fn a_stop_at_any_time_ends_the_run_after_the_slot_under_way_or_the_next(
            stop_us in 1u64..9_000,
        ) {
            let timing = timing(1_000, 500, 50, 50);
            let (mut runner, mut port, mut done) = (Runner::new(), Port::default(), StdVec::new());
            runner.load(&plan(&timing, 1), &mut port);
            let start_us = runner.start(None, &mut port);
            pass(&mut runner, &mut port, start_us + stop_us, 3, &mut done);
            let slots = runner.stop(&mut port);
            let under_way = (stop_us / 1_000) as u32;
            prop_assert!(slots == under_way + 1 || slots == under_way + 2);
            // Only when it is too late to hold the next slot.
            let left_us = u64::from(under_way + 1) * 1_000 + 5 - stop_us;
            prop_assert_eq!(slots == under_way + 2, left_us < MARGIN_US);
            pass(&mut runner, &mut port, start_us + 12_000, 3, &mut done);
            prop_assert_eq!(apart(&port.trace), expected(&timing, start_us, slots));
            prop_assert_eq!(done.len(), slots as usize);
            prop_assert!(!runner.is_running());
        }

        #[test]
        fn another_plan_takes_over_at_the_next_cycle_boundary(load_us in 1u64..9_000) {
            let (old, new) = (timing(1_000, 500, 50, 50), timing(1_300, 300, 0, 0));
            let (mut runner, mut port, mut done) = (Runner::new(), Port::default(), StdVec::new());
            runner.load(&plan(&old, 1), &mut port);
            let start_us = runner.start(None, &mut port);
            pass(&mut runner, &mut port, start_us + load_us, 3, &mut done);
            runner.load(&plan(&new, 2), &mut port);
            pass(&mut runner, &mut port, start_us + 16_000, 3, &mut done);
            let first_new = done.iter().position(|slot| slot.timing_generation == 2).unwrap();
            prop_assert_eq!(first_new % 4, 0);
            let boundary = (load_us / 4_000 + 1) * 4;
            let left_us = boundary * 1_000 + 5 - load_us;
            let late = if left_us < MARGIN_US { 4 } else { 0 };
            prop_assert_eq!(first_new as u64, boundary + late);
            let cut_us = start_us + first_new as u64 * 1_000;
            let mut edges = expected(&old, start_us, first_new as u32);
            edges.extend(expected(&new, cut_us, 20));
            let seen = apart(&port.trace);
            prop_assert_eq!(&seen[..], &edges[..seen.len()]);
            prop_assert!(seen.len() > 4 * first_new + 8);
        }

        #[test]
        fn an_abort_tells_what_was_lit(abort_us in 1u64..6_000) {
            let timing = timing(1_000, 500, 50, 60);
            let (mut runner, mut port, mut done) = (Runner::new(), Port::default(), StdVec::new());
            runner.load(&plan(&timing, 1), &mut port);
            let start_us = runner.start(None, &mut port);
            pass(&mut runner, &mut port, start_us + abort_us, 3, &mut done);
            let aborted = runner.abort(port.happened, port.now_us);
            let edges = expected(&timing, start_us, 8);
            let before = edges.iter().filter(|(at_us, _)| *at_us <= port.now_us);
            let triggered =
                before.clone().filter(|(_, effect)| effect.triggers == Some(true)).count();
            let last_gate = before.filter_map(|(at, effect)| effect.gates.map(|w| (*at, w))).next_back();
            prop_assert_eq!(aborted.slots_triggered, triggered as u32);
            match last_gate {
                Some((at_us, gates)) if gates != GateWord::DARK => {
                    prop_assert_eq!(aborted.gates, gates);
                    prop_assert_eq!(u64::from(aborted.on_time_us), port.now_us - at_us + 1);
                }
                _ => prop_assert_eq!(aborted.on_time_us, 0),
            }
            prop_assert!(!runner.is_running());
        }
    }

    #[test]
    fn light_is_told_to_the_guard() {
        let timing = timing(1_000, 500, 50, 50);
        let (mut runner, mut port) = (Runner::new(), Port::default());
        runner.load(&plan(&timing, 1), &mut port);
        runner.start(Some(2), &mut port);
        let mut step = |happened: u32| runner.on_events(happened, || None, |_| {}, &mut port);
        assert_eq!(step(1), Light { was_dark: true, is_lit: true });
        assert_eq!(step(2), Light { was_dark: false, is_lit: true });
        // Both the fall and the next rise at once: it was dark in between.
        assert_eq!(step(5), Light { was_dark: true, is_lit: true });
        assert_eq!(step(8), Light { was_dark: true, is_lit: false });
    }

    #[test]
    fn a_dead_interrupt_ends_the_light() {
        let timing = timing(1_000, 500, 50, 50);
        let (mut runner, mut port) = (Runner::new(), Port::default());
        runner.load(&plan(&timing, 1), &mut port);
        let start_us = runner.start(None, &mut port);
        // No interrupt is ever taken: the one committed slot ends, nothing follows.
        pass(&mut runner, &mut port, start_us + 20_000, u64::MAX, &mut StdVec::new());
        assert_eq!(apart(&port.trace), expected(&timing, start_us, 1));
    }
}
