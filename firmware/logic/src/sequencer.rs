//! Runs of the gate engine: frame numbers, timing generations, and whether the engine keeps its plan.

use stspp_protocol::event::{TimingEvent, TriggerEvent};
use stspp_protocol::timing::{Limits, ProjectionTiming};

use crate::hardware::SlotDone;
use crate::timing::GateWord;

/// A slot is overdue when it is this late.
pub const SUPERVISION_MARGIN_US: u64 = 5_000;

/// How the engine strayed from its plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Strayed {
    /// A slot was reported out of order, or more projectors were lit than allowed. Seen and expected.
    Slot {
        /// What was reported.
        seen: u32,
        /// What was due.
        expected: u32,
    },
    /// Gates were on for too long. Seen and allowed, microseconds.
    OnTime {
        /// What was reported.
        seen_us: u32,
        /// The limit.
        limit_us: u32,
    },
}

/// What a finished slot means to the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Set where this slot is the first lit under another timing.
    pub timing: Option<TimingEvent>,
    /// The label of the frame.
    pub trigger: TriggerEvent,
    /// Whether the run is over.
    pub run_ended: bool,
}

#[derive(Debug, Clone, Copy)]
struct Run {
    slots_done: u32,
    end: Option<u32>,
    /// Longest period of the timings that this run may be under.
    slowest_period_us: u32,
    deadline_us: u64,
    /// Slots start by edges at trigger-in: between them nothing is due.
    external: bool,
}

/// The accepted timing and the run under way.
#[derive(Debug, Clone)]
pub struct Sequencer {
    timing: ProjectionTiming,
    generation: u16,
    lit_generation: u16,
    first_frame_sequence: u32,
    next_frame_sequence: u32,
    run: Option<Run>,
}

impl Sequencer {
    /// Stopped, with a timing of generation 1.
    #[must_use]
    pub const fn new(timing: ProjectionTiming) -> Self {
        Self {
            timing,
            generation: 1,
            lit_generation: 0,
            first_frame_sequence: 0,
            next_frame_sequence: 0,
            run: None,
        }
    }

    /// The timing accepted last.
    #[must_use]
    pub const fn timing(&self) -> &ProjectionTiming {
        &self.timing
    }

    /// Its generation.
    #[must_use]
    pub const fn generation(&self) -> u16 {
        self.generation
    }

    /// The generation that the next accepted timing gets.
    #[must_use]
    pub const fn next_generation(&self) -> u16 {
        self.generation.wrapping_add(1)
    }

    /// Whether the accepted timing waits for a cycle boundary.
    #[must_use]
    pub const fn is_pending(&self) -> bool {
        self.run.is_some() && self.lit_generation != self.generation
    }

    /// Number of the next frame.
    #[must_use]
    pub const fn next_frame_sequence(&self) -> u32 {
        self.next_frame_sequence
    }

    /// Everything that a cycle of the timing lights.
    #[must_use]
    pub fn gates_used(&self) -> [GateWord; stspp_protocol::timing::MAX_SLOTS] {
        let mut words = [GateWord::DARK; stspp_protocol::timing::MAX_SLOTS];
        for (word, &slot) in words.iter_mut().zip(&self.timing.slots) {
            *word = GateWord::from_slot(slot);
        }
        words
    }

    /// Takes a timing that the engine has been loaded with.
    pub fn accept(&mut self, timing: ProjectionTiming) {
        if let Some(run) = &mut self.run {
            // The slot that is due may be the first of the new timing already.
            let slower_by_us = timing.frame_period_us.saturating_sub(run.slowest_period_us);
            run.slowest_period_us = run.slowest_period_us.saturating_add(slower_by_us);
            run.deadline_us =
                run.deadline_us.saturating_add(u64::from(slower_by_us).saturating_mul(2));
        }
        self.timing = timing;
        self.generation = self.next_generation();
    }

    /// Notes that the engine was started.
    pub fn started(&mut self, start_time_us: u64, slots: Option<u32>, external: bool) {
        self.first_frame_sequence = self.next_frame_sequence;
        self.lit_generation = self.generation;
        let period_us = self.timing.frame_period_us;
        self.run = Some(Run {
            slots_done: 0,
            end: slots,
            slowest_period_us: period_us,
            deadline_us: start_time_us
                .saturating_add(u64::from(period_us))
                .saturating_add(SUPERVISION_MARGIN_US),
            external,
        });
    }

    /// Notes how many slots the run will have had in all. Returns whether it is over already.
    pub fn stopping(&mut self, slots: u32) -> bool {
        let Some(run) = &mut self.run else { return true };
        run.end = Some(slots);
        let over = run.slots_done >= slots;
        if over {
            self.run = None;
        }
        over
    }

    /// One more than the last frame of a run that has `slots` slots.
    #[must_use]
    pub const fn end_frame_sequence(&self, slots: u32) -> u32 {
        self.first_frame_sequence.wrapping_add(slots)
    }

    /// Notes that the outputs were forced off after `slots_triggered` triggers.
    pub fn aborted(&mut self, slots_triggered: u32) {
        if self.run.take().is_some() {
            self.next_frame_sequence = self.first_frame_sequence.wrapping_add(slots_triggered);
        }
    }

    /// Takes the engine's report of a slot.
    ///
    /// # Errors
    ///
    /// [`Strayed`] where the report is not what the plan says.
    pub fn slot_done(&mut self, done: &SlotDone, limits: &Limits) -> Result<Progress, Strayed> {
        let frame_sequence = self.first_frame_sequence.wrapping_add(done.slot_number);
        let mut run_ended = false;
        if let Some(run) = &mut self.run {
            if done.slot_number != run.slots_done {
                let (seen, expected) = (done.slot_number, run.slots_done);
                return Err(Strayed::Slot { seen, expected });
            }
            run.slots_done = run.slots_done.saturating_add(1);
            run.deadline_us = done
                .trigger_time_us
                .saturating_add(u64::from(run.slowest_period_us).saturating_mul(2))
                .saturating_add(SUPERVISION_MARGIN_US);
            run_ended = run.end.is_some_and(|end| run.slots_done >= end);
            self.next_frame_sequence = frame_sequence.wrapping_add(1);
        }
        if run_ended {
            self.run = None;
        }
        let lit = done.gates.projector_mask().count_ones();
        let most = u32::from(limits.max_simultaneous_projectors);
        if lit > most {
            return Err(Strayed::Slot { seen: lit, expected: most });
        }
        if done.on_time_us > limits.max_on_time_us {
            let (seen_us, limit_us) = (done.on_time_us, limits.max_on_time_us);
            return Err(Strayed::OnTime { seen_us, limit_us });
        }
        let timing = (done.timing_generation != self.lit_generation).then_some(TimingEvent {
            timing_generation: done.timing_generation,
            first_frame_sequence: frame_sequence,
        });
        self.lit_generation = done.timing_generation;
        let trigger = TriggerEvent {
            frame_sequence,
            slot_index: done.slot_index,
            projector_mask: done.gates.projector_mask(),
            floodlight: done.gates.floodlight(),
            trigger_time_us: done.trigger_time_us,
            usb_sof: done.usb_sof,
            timing_generation: done.timing_generation,
        };
        Ok(Progress { timing, trigger, run_ended })
    }

    /// Whether a run is under way.
    #[must_use]
    pub const fn is_running(&self) -> bool {
        self.run.is_some()
    }

    /// Device time at which the slot under way is overdue. `external_start_us` is the start of the
    /// slot that an edge at trigger-in began and that is not reported yet.
    #[must_use]
    pub fn deadline_us(&self, external_start_us: Option<u64>) -> Option<u64> {
        let run = self.run.as_ref()?;
        if !run.external {
            return Some(run.deadline_us);
        }
        let late_us = u64::from(run.slowest_period_us).saturating_add(SUPERVISION_MARGIN_US);
        external_start_us.map(|start_us| start_us.saturating_add(late_us))
    }

    /// Slots of the run that are done.
    #[must_use]
    pub const fn slots_done(&self) -> u32 {
        match &self.run {
            Some(run) => run.slots_done,
            None => 0,
        }
    }
}
