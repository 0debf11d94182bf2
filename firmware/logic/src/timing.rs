//! A timing as the gate engine takes it: timer ticks, and one word per slot.
//!
//! A [`SlotPlan`] can only be had from a timing that validates, so an engine never sees one that does
//! not.

use heapless::Vec;
use stspp_protocol::timing::{Limits, MAX_SLOTS, ProjectionTiming, Slot, TimingError};

/// Which gates are on: bits 0..=15 projectors, bit 16 the floodlight.
///
/// A board maps it to its ports' set and reset words when a plan is loaded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GateWord(u32);

impl GateWord {
    /// No light.
    pub const DARK: Self = Self(0);

    /// The floodlight alone.
    pub const FLOODLIGHT_ONLY: Self = Self(Self::FLOODLIGHT);

    const FLOODLIGHT: u32 = 1 << 16;

    /// The word of a slot.
    #[must_use]
    pub const fn from_slot(slot: Slot) -> Self {
        Self(slot.projector_mask as u32 | if slot.floodlight { Self::FLOODLIGHT } else { 0 })
    }

    /// Projectors, bit `p` for projector `p`.
    #[must_use]
    pub const fn projector_mask(self) -> u16 {
        (self.0 & 0xFFFF) as u16
    }

    /// Whether the floodlight is on.
    #[must_use]
    pub const fn floodlight(self) -> bool {
        self.0 & Self::FLOODLIGHT != 0
    }

    /// All seventeen bits.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }
}

/// Compare values shared by all slots, and the gate word of each.
///
/// The gate timer counts `0..period_ticks`. A compare value `c` means: the edge lies `c` ticks after
/// the slot's start. `0 < gate_on <= trigger_on < trigger_off <= gate_off < period` always holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SlotPlan {
    timing_generation: u16,
    ticks_per_us: u32,
    period_ticks: u32,
    gate_on_ticks: u32,
    trigger_on_ticks: u32,
    trigger_off_ticks: u32,
    gate_off_ticks: u32,
    gates: Vec<GateWord, MAX_SLOTS>,
}

impl SlotPlan {
    /// Compiles a timing.
    ///
    /// # Errors
    ///
    /// What [`ProjectionTiming::validate`] finds.
    pub fn compile(
        timing: &ProjectionTiming,
        limits: &Limits,
        ticks_per_us: u32,
        timing_generation: u16,
    ) -> Result<Self, TimingError> {
        timing.validate(limits)?;
        // Validated times are below 2^24 us; the product fits for any timer below 256 MHz.
        let ticks = |us: u32| us.saturating_mul(ticks_per_us);
        Ok(Self {
            timing_generation,
            ticks_per_us,
            period_ticks: ticks(timing.frame_period_us),
            gate_on_ticks: ticks(timing.gate_on_us()),
            trigger_on_ticks: ticks(timing.trigger_on_us()),
            trigger_off_ticks: ticks(timing.trigger_off_us()),
            gate_off_ticks: ticks(timing.gate_off_us()),
            gates: timing.slots.iter().copied().map(GateWord::from_slot).collect(),
        })
    }

    /// Generation that events of this plan carry.
    #[must_use]
    pub const fn timing_generation(&self) -> u16 {
        self.timing_generation
    }

    /// Ticks in a microsecond.
    #[must_use]
    pub const fn ticks_per_us(&self) -> u32 {
        self.ticks_per_us
    }

    /// Slot length; the timer's reload value is one less.
    #[must_use]
    pub const fn period_ticks(&self) -> u32 {
        self.period_ticks
    }

    /// Rise of the gates.
    #[must_use]
    pub const fn gate_on_ticks(&self) -> u32 {
        self.gate_on_ticks
    }

    /// Rise of the camera triggers.
    #[must_use]
    pub const fn trigger_on_ticks(&self) -> u32 {
        self.trigger_on_ticks
    }

    /// Fall of the camera triggers.
    #[must_use]
    pub const fn trigger_off_ticks(&self) -> u32 {
        self.trigger_off_ticks
    }

    /// Fall of the gates.
    #[must_use]
    pub const fn gate_off_ticks(&self) -> u32 {
        self.gate_off_ticks
    }

    /// What each slot lights; never empty.
    #[must_use]
    pub fn gates(&self) -> &[GateWord] {
        &self.gates
    }

    /// How long the gates of a slot are on.
    #[must_use]
    pub const fn on_time_ticks(&self) -> u32 {
        self.gate_off_ticks.saturating_sub(self.gate_on_ticks)
    }
}
