//! The projection timing, the board's limits, and the one validator that both sides use.
//!
//! # Exact semantics
//!
//! The device cycles through the slots. Slot `n` of a run (counting on over cycles) starts at
//! `t_n = start_time_us + n * frame_period_us`; its entry in the table is `n` modulo the number of
//! slots. All slots share the same four offsets from `t_n`, whole microseconds:
//!
//! ```text
//!        t_n                                                            t_n + frame_period
//!         |-- trigger_delay ------>|------ exposure ------>|                  |
//! trigger ________________________/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\_________________|
//!              |<-- gate_lead ---->|                       |<- gate_lag ->|   |
//! gates   _____/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\___|
//!         |--->| gate_on                                                  | gate_off
//! ```
//!
//! * `trigger_on  = trigger_delay_us`
//! * `trigger_off = trigger_delay_us + exposure_us`
//! * `gate_on     = trigger_delay_us - gate_lead_us`
//! * `gate_off    = trigger_delay_us + exposure_us + gate_lag_us`
//!
//! Cameras integrate while the trigger is high (trigger-width exposure), so light is on throughout an
//! exposure. Between a gate's fall and the next slot's rise lie
//! `frame_period_us - (gate_lead_us + exposure_us + gate_lag_us)` microseconds: the dead time, which is
//! all the switching time there is. Both ends of a slot keep [`SLOT_GUARD_US`] free of edges, so that
//! every edge is a compare match of one timer that counts `0..frame_period_us`.

use core::fmt;

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::units::permille_ceil;

/// Most slots in a timing.
pub const MAX_SLOTS: usize = 16;

/// Most projectors that the masks have room for.
pub const MAX_PROJECTORS: usize = 16;

/// Projectors of the sensor.
pub const PROJECTOR_COUNT: u8 = 10;

/// Time at either end of a slot in which there is no edge.
pub const SLOT_GUARD_US: u32 = 1;

/// What is lit during one camera frame. Both may be off: a frame of the ambient light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Slot {
    /// Bit `p` lights projector `p`.
    pub projector_mask: u16,
    /// Whether the floodlight is on.
    pub floodlight: bool,
}

impl Slot {
    /// A slot that lights one projector.
    #[must_use]
    pub const fn projector(index: u8) -> Self {
        Self { projector_mask: 1 << index, floodlight: false }
    }

    /// A slot that lights the floodlight alone.
    #[must_use]
    pub const fn floodlight() -> Self {
        Self { projector_mask: 0, floodlight: true }
    }

    /// A slot without light.
    #[must_use]
    pub const fn dark() -> Self {
        Self { projector_mask: 0, floodlight: false }
    }
}

/// When which light is on and when the cameras expose; see the module's diagram.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProjectionTiming {
    /// The slot cycle, 1 to 16 slots; one camera frame each.
    pub slots: Vec<Slot, MAX_SLOTS>,
    /// From slot to slot.
    pub frame_period_us: u32,
    /// Width of the camera trigger.
    pub exposure_us: u32,
    /// From slot start to the rise of the trigger.
    pub trigger_delay_us: u32,
    /// Gate on before the rise of the trigger.
    pub gate_lead_us: u32,
    /// Gate off after the fall of the trigger.
    pub gate_lag_us: u32,
}

impl Default for ProjectionTiming {
    /// The paper's sensor: ten slots with one projector each, 30 Hz, 32 ms exposure.
    fn default() -> Self {
        Self {
            slots: (0..PROJECTOR_COUNT).map(Slot::projector).collect(),
            frame_period_us: 33_333,
            exposure_us: 32_000,
            trigger_delay_us: 100,
            gate_lead_us: 50,
            gate_lag_us: 50,
        }
    }
}

impl ProjectionTiming {
    /// Rise of the gates after slot start (0 for a timing that does not validate).
    #[must_use]
    pub const fn gate_on_us(&self) -> u32 {
        self.trigger_delay_us.saturating_sub(self.gate_lead_us)
    }

    /// Rise of the trigger after slot start.
    #[must_use]
    pub const fn trigger_on_us(&self) -> u32 {
        self.trigger_delay_us
    }

    /// Fall of the trigger after slot start.
    #[must_use]
    pub const fn trigger_off_us(&self) -> u32 {
        self.trigger_delay_us.saturating_add(self.exposure_us)
    }

    /// Fall of the gates after slot start.
    #[must_use]
    pub const fn gate_off_us(&self) -> u32 {
        self.trigger_off_us().saturating_add(self.gate_lag_us)
    }

    /// How long the gates of one slot are on.
    #[must_use]
    pub const fn on_time_us(&self) -> u32 {
        self.gate_lead_us.saturating_add(self.exposure_us).saturating_add(self.gate_lag_us)
    }

    /// From a gate's fall to the next slot's rise.
    #[must_use]
    pub const fn dead_time_us(&self) -> u32 {
        self.frame_period_us.saturating_sub(self.on_time_us())
    }

    /// Length of a slot cycle.
    #[must_use]
    pub fn cycle_us(&self) -> u64 {
        self.slots.len() as u64 * u64::from(self.frame_period_us)
    }

    /// Number of slots in a cycle that light `projector`.
    #[must_use]
    pub fn slots_lighting(&self, projector: u8) -> u32 {
        let bit = 1u16.checked_shl(u32::from(projector)).unwrap_or(0);
        self.slots.iter().filter(|slot| slot.projector_mask & bit != 0).count() as u32
    }

    /// Number of slots in a cycle that light the floodlight.
    #[must_use]
    pub fn slots_floodlit(&self) -> u32 {
        self.slots.iter().filter(|slot| slot.floodlight).count() as u32
    }

    /// Holds the timing against a board's limits. The host calls it before sending, the device before
    /// accepting; there is no second set of rules.
    ///
    /// # Errors
    ///
    /// The first rule that is broken, in the order of the fields; see [`TimingField`].
    pub fn validate(&self, limits: &Limits) -> Result<(), TimingError> {
        let max_slots = u32::from(limits.max_slots).min(MAX_SLOTS as u32);
        check(TimingField::SlotCount, None, self.slots.len() as u32, 1, max_slots)?;
        self.validate_slots(limits)?;
        check(
            TimingField::FramePeriodUs,
            None,
            self.frame_period_us,
            limits.min_frame_period_us,
            limits.max_frame_period_us,
        )?;
        let margin = limits.max_gate_margin_us;
        check(TimingField::GateLeadUs, None, self.gate_lead_us, 0, margin)?;
        check(TimingField::GateLagUs, None, self.gate_lag_us, 0, margin)?;
        let longest_exposure_us = limits
            .max_on_time_us
            .saturating_sub(self.gate_lead_us.saturating_add(self.gate_lag_us));
        check(
            TimingField::ExposureUs,
            None,
            self.exposure_us,
            limits.min_exposure_us,
            longest_exposure_us,
        )?;
        check(
            TimingField::TriggerDelayUs,
            None,
            self.trigger_delay_us,
            self.gate_lead_us.saturating_add(SLOT_GUARD_US),
            self.frame_period_us,
        )?;
        let shortest_period_us = self
            .gate_off_us()
            .saturating_add(SLOT_GUARD_US)
            .max(self.on_time_us().saturating_add(limits.min_dead_time_us));
        check(
            TimingField::FramePeriodUs,
            None,
            self.frame_period_us,
            shortest_period_us,
            limits.max_frame_period_us,
        )?;
        self.validate_duty(limits)
    }

    fn validate_slots(&self, limits: &Limits) -> Result<(), TimingError> {
        let known = limits.projector_mask();
        for (index, slot) in self.slots.iter().enumerate() {
            let index = Some(index as u8);
            let mask = slot.projector_mask;
            if mask & !known != 0 {
                return Err(TimingError {
                    field: TimingField::ProjectorMask,
                    index,
                    value: u32::from(mask),
                    min: 0,
                    max: u32::from(known),
                });
            }
            check(
                TimingField::SimultaneousProjectors,
                index,
                mask.count_ones(),
                0,
                u32::from(limits.max_simultaneous_projectors),
            )?;
            if slot.floodlight && !limits.has_floodlight {
                return Err(TimingError {
                    field: TimingField::Floodlight,
                    index,
                    value: 1,
                    min: 0,
                    max: 0,
                });
            }
        }
        Ok(())
    }

    fn validate_duty(&self, limits: &Limits) -> Result<(), TimingError> {
        let duty_permille = |slots: u32| {
            permille_ceil(u64::from(slots) * u64::from(self.on_time_us()), self.cycle_us())
        };
        for projector in 0..limits.projector_count {
            check(
                TimingField::ProjectorDutyPermille,
                Some(projector),
                duty_permille(self.slots_lighting(projector)),
                0,
                u32::from(limits.max_projector_duty_permille),
            )?;
        }
        check(
            TimingField::FloodlightDutyPermille,
            None,
            duty_permille(self.slots_floodlit()),
            0,
            u32::from(limits.max_floodlight_duty_permille),
        )
    }
}

fn check(
    field: TimingField,
    index: Option<u8>,
    value: u32,
    min: u32,
    max: u32,
) -> Result<(), TimingError> {
    if (min..=max).contains(&value) {
        Ok(())
    } else {
        Err(TimingError { field, index, value, min, max })
    }
}

/// What a timing was refused for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum TimingField {
    /// Number of [`ProjectionTiming::slots`].
    SlotCount,
    /// [`Slot::projector_mask`] has a bit for a projector that is not there; index = slot.
    ProjectorMask,
    /// Bits set in [`Slot::projector_mask`]; index = slot.
    SimultaneousProjectors,
    /// [`Slot::floodlight`] on a board without one; index = slot.
    Floodlight,
    /// [`ProjectionTiming::frame_period_us`]; the least allowed includes what exposure, lead, lag,
    /// delay and dead time need.
    FramePeriodUs,
    /// [`ProjectionTiming::gate_lead_us`].
    GateLeadUs,
    /// [`ProjectionTiming::gate_lag_us`].
    GateLagUs,
    /// [`ProjectionTiming::exposure_us`]; the most allowed is the on-time limit less lead and lag.
    ExposureUs,
    /// [`ProjectionTiming::trigger_delay_us`]; it must leave room for the lead.
    TriggerDelayUs,
    /// Share of the cycle that a projector is on, thousandths; index = projector.
    ProjectorDutyPermille,
    /// Share of the cycle that the floodlight is on, thousandths.
    FloodlightDutyPermille,
}

impl TimingField {
    /// Name as in the types, and what the index counts.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            TimingField::SlotCount => "slots",
            TimingField::ProjectorMask => "projector_mask",
            TimingField::SimultaneousProjectors => "projectors lit at once",
            TimingField::Floodlight => "floodlight",
            TimingField::FramePeriodUs => "frame_period_us",
            TimingField::GateLeadUs => "gate_lead_us",
            TimingField::GateLagUs => "gate_lag_us",
            TimingField::ExposureUs => "exposure_us",
            TimingField::TriggerDelayUs => "trigger_delay_us",
            TimingField::ProjectorDutyPermille => "duty_permille",
            TimingField::FloodlightDutyPermille => "floodlight duty_permille",
        }
    }
}

/// A timing that cannot be met: which field, what it was, what is allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TimingError {
    /// Field at fault.
    pub field: TimingField,
    /// Slot or projector at fault, where the field has many.
    pub index: Option<u8>,
    /// What was asked.
    pub value: u32,
    /// Least allowed, the other fields being as they are.
    pub min: u32,
    /// Most allowed, the other fields being as they are; less than `min` where nothing is.
    pub max: u32,
}

impl fmt::Display for TimingError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.field.name();
        match (self.field, self.index) {
            (TimingField::ProjectorDutyPermille, Some(projector)) => {
                write!(f, "timing: projector {projector}: {name} is {}", self.value)?;
            }
            (TimingField::ProjectorMask, Some(slot)) => {
                let (value, max) = (self.value, self.max);
                return write!(
                    f,
                    "timing: slot {slot}: {name} is {value:#06x}; allowed bits are {max:#06x}"
                );
            }
            (_, Some(slot)) => write!(f, "timing: slot {slot}: {name} is {}", self.value)?,
            (_, None) => write!(f, "timing: {name} is {}", self.value)?,
        }
        if self.min > self.max {
            write!(f, "; nothing fits with the other fields as they are")
        } else {
            write!(f, "; allowed is {}..={}", self.min, self.max)
        }
    }
}

impl core::error::Error for TimingError {}

/// Constants of a board. No message changes them; the host reads them from
/// [`DeviceInfo`](crate::version::DeviceInfo).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Limits {
    /// Length of the slot table.
    pub max_slots: u8,
    /// Projectors fitted: bits 0 to this less one of a mask.
    pub projector_count: u8,
    /// Most projectors lit in one slot.
    pub max_simultaneous_projectors: u8,
    /// Whether there is a floodlight.
    pub has_floodlight: bool,
    /// Resolution of the gate timer, nanoseconds.
    pub tick_ns: u32,
    /// Shortest slot.
    pub min_frame_period_us: u32,
    /// Longest slot.
    pub max_frame_period_us: u32,
    /// Shortest exposure.
    pub min_exposure_us: u32,
    /// Longest gate lead and lag.
    pub max_gate_margin_us: u32,
    /// Longest time that a gate may be on within a slot; ended by hardware.
    pub max_on_time_us: u32,
    /// Shortest time from gate off to the next gate on.
    pub min_dead_time_us: u32,
    /// Largest share of a slot cycle that a projector may be on.
    pub max_projector_duty_permille: u16,
    /// Largest share that the floodlight may be on.
    pub max_floodlight_duty_permille: u16,
    /// Longest [`FloodlightOn`](crate::request::FloodlightOn).
    pub max_floodlight_on_us: u32,
    /// Window of the duty budget: over any time `t`, an emitter is on for at most
    /// `duty * (t + duty_window_us)`, whatever is asked.
    pub duty_window_us: u32,
    /// Silence of the host that is a fault while armed or running.
    pub heartbeat_timeout_us: u32,
    /// Temperature at the projectors that is a fault, tenths of a degree Celsius.
    pub max_temperature_dc: i16,
}

impl Limits {
    /// Board with the GD32F330.
    pub const F330: Self = Self {
        max_slots: MAX_SLOTS as u8,
        projector_count: PROJECTOR_COUNT,
        max_simultaneous_projectors: 3,
        has_floodlight: true,
        tick_ns: 1_000,
        min_frame_period_us: 1_000,
        // The gate timer is 16 bits wide and counts microseconds.
        max_frame_period_us: 65_535,
        min_exposure_us: 10,
        max_gate_margin_us: 1_000,
        max_on_time_us: 40_000,
        min_dead_time_us: 2,
        max_projector_duty_permille: 400,
        max_floodlight_duty_permille: 500,
        max_floodlight_on_us: 500_000,
        // Twice the longest slot cycle, 2 * 16 * 65_535 us: see the duty budget in docs/protocol.md.
        duty_window_us: 2_097_120,
        heartbeat_timeout_us: 1_000_000,
        max_temperature_dc: 700,
    };

    /// Board with the GD32F350: the same light, another link.
    pub const F350: Self = Self::F330;

    /// Mask with a bit for every projector fitted.
    #[must_use]
    pub const fn projector_mask(&self) -> u16 {
        let count = if self.projector_count > 16 { 16 } else { self.projector_count };
        ((1u32 << count) - 1) as u16
    }
}
