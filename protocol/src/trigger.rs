//! What starts a slot: the gate timer, or an edge at the board's trigger-in pin. Since protocol 1.1,
//! on devices with [`Capabilities::TRIGGER_IN`](crate::version::Capabilities::TRIGGER_IN).
//!
//! # Exact semantics
//!
//! With [`TriggerSource::FreeRunning`], slot `n` of a run starts at `start_time_us + n *
//! frame_period_us` (see [`timing`](crate::timing)). With [`TriggerSource::External`] a run starts
//! nothing by itself: an edge seen at `e` starts the next slot at `t_n = e + delay_us`. Within the slot
//! all offsets are the timing's; the cycle goes on from slot to slot, and so do frame numbers.
//!
//! ```text
//! trigger-in  ______/‾‾‾\__________________________/‾‾‾\_______
//!                   e                              e'
//!                   |<- delay_us ->| t_n           |<- delay_us ->| t_n+1
//! slot        _____________________|===== n =======|______________|===== n+1 ...
//!                                  |<-- frame_period_us at least->|
//! ```
//!
//! `frame_period_us` is the shortest time between the starts of two slots: an edge that would start one
//! sooner is ignored and counted. What holds for duty and dead time of a free-running timing therefore
//! holds for any train of edges.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::reply::{RequestError, RequestField};

/// Which change of level at trigger-in counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum TriggerEdge {
    /// Low to high.
    #[default]
    Rising,
    /// High to low.
    Falling,
}

/// How edges at trigger-in start slots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ExternalTrigger {
    /// Which edge.
    pub edge: TriggerEdge,
    /// From the edge to the start of the slot.
    pub delay_us: u32,
}

impl ExternalTrigger {
    /// Shortest delay: the time in which the firmware has seen the edge and filled its tables, so that
    /// the slot starts on the timer's tick and not when software gets to it.
    pub const MIN_DELAY_US: u32 = 60;
    /// Longest delay: shorter than any slot, so that one edge at most waits for its slot.
    pub const MAX_DELAY_US: u32 = 900;
}

impl Default for ExternalTrigger {
    fn default() -> Self {
        Self { edge: TriggerEdge::Rising, delay_us: Self::MIN_DELAY_US }
    }
}

/// What starts the slots of a run. A device comes up free-running, and each
/// [`Hello`](crate::request::Hello) makes it so again: a host that knows nothing of this finds what it
/// knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum TriggerSource {
    /// The gate timer, one slot after the other.
    #[default]
    FreeRunning,
    /// Edges at trigger-in.
    External(ExternalTrigger),
}

impl TriggerSource {
    /// The one check of a trigger source, on both sides.
    ///
    /// # Errors
    /// [`RequestError::OutOfRange`] for a delay that no device keeps.
    pub const fn validate(&self) -> Result<(), RequestError> {
        let TriggerSource::External(external) = self else { return Ok(()) };
        let (min, max) = (ExternalTrigger::MIN_DELAY_US, ExternalTrigger::MAX_DELAY_US);
        let value = external.delay_us;
        if value < min || value > max {
            return Err(RequestError::OutOfRange {
                field: RequestField::TriggerDelayUs,
                value,
                min,
                max,
            });
        }
        Ok(())
    }
}

impl fmt::Display for TriggerSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            TriggerSource::FreeRunning => f.write_str("free-running"),
            TriggerSource::External(external) => {
                let edge = match external.edge {
                    TriggerEdge::Rising => "rising",
                    TriggerEdge::Falling => "falling",
                };
                write!(f, "external, {edge} edge, slot {} us after it", external.delay_us)
            }
        }
    }
}

/// Answer to [`GetTriggerSource`](crate::request::GetTriggerSource).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TriggerInput {
    /// What starts slots.
    pub source: TriggerSource,
    /// Edges that started a slot, since reset; wraps.
    pub edges_taken: u32,
    /// Edges during a run that came too soon after another, since reset; wraps. A burst of edges within
    /// one slot may count less than it has.
    pub edges_ignored: u32,
}
