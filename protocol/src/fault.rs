//! Faults: what switches the light off and keeps it off.
//!
//! A fault latches: it stays in the set after its cause is gone, until the host clears it. While any
//! fault is latched the device refuses to arm.

use serde::{Deserialize, Serialize};

/// Why the light was switched off. The number is the bit in [`FaultSet`] and never changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum FaultReason {
    /// The interlock input opened. Value: none.
    Interlock = 0,
    /// No valid request arrived in time while armed or running. Value and limit: microseconds.
    HeartbeatLost = 1,
    /// The projectors are too hot. Value and limit: tenths of a degree Celsius.
    OverTemperature = 2,
    /// The temperature sensor is open or shorted. Value: its reading in tenths of a degree Celsius.
    TemperatureSensor = 3,
    /// A gate was on for longer than the board allows. Value and limit: microseconds.
    OnTime = 4,
    /// An emitter's duty passed the limit. Value and limit: microseconds of accumulated on-time.
    Duty = 5,
    /// The control link went down (USB suspend, cable pulled) while armed or running.
    LinkLost = 6,
    /// The gate engine reported other than what was planned. Value and limit: seen and planned.
    Engine = 7,
    /// The watchdog ended a hang.
    Watchdog = 8,
    /// The firmware panicked.
    Panic = 9,
    /// The processor faulted.
    HardFault = 10,
    /// A debugger halted the processor while armed or running.
    DebugHalt = 11,
    /// The DMA that makes the edges of gates and triggers stopped during a run. Value and limit: edges
    /// made and edges planned. Since 1.1.
    EdgeDma = 12,
    /// The firmware is for another board than it runs on. Value and limit: 1 where there is, 1 where
    /// there should be a USB device core. Since 1.1.
    WrongBoard = 13,
    /// The crystal stopped while the firmware ran. Since 1.1.
    Clock = 14,
}

impl FaultReason {
    /// All reasons, in bit order.
    pub const ALL: [FaultReason; 15] = [
        FaultReason::Interlock,
        FaultReason::HeartbeatLost,
        FaultReason::OverTemperature,
        FaultReason::TemperatureSensor,
        FaultReason::OnTime,
        FaultReason::Duty,
        FaultReason::LinkLost,
        FaultReason::Engine,
        FaultReason::Watchdog,
        FaultReason::Panic,
        FaultReason::HardFault,
        FaultReason::DebugHalt,
        FaultReason::EdgeDma,
        FaultReason::WrongBoard,
        FaultReason::Clock,
    ];

    /// The first minor of protocol 1 that has this reason.
    #[must_use]
    pub const fn since_minor(self) -> u16 {
        match self {
            FaultReason::EdgeDma | FaultReason::WrongBoard | FaultReason::Clock => 1,
            _ => 0,
        }
    }

    /// The reason as a host of protocol 1.`minor` knows it: what came later is to it the engine's.
    #[must_use]
    pub const fn as_of(self, minor: u16) -> Self {
        if self.since_minor() > minor { FaultReason::Engine } else { self }
    }

    /// What happened, in words.
    #[must_use]
    pub const fn describe(self) -> &'static str {
        match self {
            FaultReason::Interlock => "interlock opened",
            FaultReason::HeartbeatLost => "host heartbeat lost",
            FaultReason::OverTemperature => "projectors too hot",
            FaultReason::TemperatureSensor => "temperature sensor open or shorted",
            FaultReason::OnTime => "gate on for too long",
            FaultReason::Duty => "emitter duty limit passed",
            FaultReason::LinkLost => "control link lost",
            FaultReason::Engine => "gate engine off its plan",
            FaultReason::Watchdog => "watchdog reset",
            FaultReason::Panic => "firmware panic",
            FaultReason::HardFault => "processor fault",
            FaultReason::DebugHalt => "halted by a debugger",
            FaultReason::EdgeDma => "edge DMA stopped",
            FaultReason::WrongBoard => "firmware of another board",
            FaultReason::Clock => "crystal stopped",
        }
    }
}

impl core::fmt::Display for FaultReason {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.describe())
    }
}

/// A set of faults, one bit per [`FaultReason`]; bits of a newer peer are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FaultSet(pub u32);

impl FaultSet {
    /// No fault.
    pub const EMPTY: Self = Self(0);

    /// Whether no fault is in the set.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Whether `reason` is in the set.
    #[must_use]
    pub const fn contains(self, reason: FaultReason) -> bool {
        self.0 & (1 << reason as u8) != 0
    }

    /// Adds `reason`.
    pub const fn insert(&mut self, reason: FaultReason) {
        self.0 |= 1 << reason as u8;
    }

    /// Takes `reason` out.
    pub const fn remove(&mut self, reason: FaultReason) {
        self.0 &= !(1 << reason as u8);
    }

    /// The known reasons in the set, in bit order.
    pub fn iter(self) -> impl Iterator<Item = FaultReason> {
        FaultReason::ALL.into_iter().filter(move |&reason| self.contains(reason))
    }
}

impl FromIterator<FaultReason> for FaultSet {
    fn from_iter<I: IntoIterator<Item = FaultReason>>(reasons: I) -> Self {
        let mut set = Self::EMPTY;
        for reason in reasons {
            set.insert(reason);
        }
        set
    }
}

impl core::fmt::Display for FaultSet {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        if self.is_empty() {
            return f.write_str("none");
        }
        let mut rest = *self;
        let mut separator = "";
        for reason in self.iter() {
            write!(f, "{separator}{reason}")?;
            rest.remove(reason);
            separator = ", ";
        }
        if rest.is_empty() { Ok(()) } else { write!(f, "{separator}unknown {:#x}", rest.0) }
    }
}

/// One fault as it happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FaultRecord {
    /// What happened.
    pub reason: FaultReason,
    /// Device time at which it was seen; zero where it was carried over a reset.
    pub time_us: u64,
    /// The offending value; its unit is the reason's.
    pub value: i32,
    /// What the value was held against.
    pub limit: i32,
}

/// Answer to [`GetFaults`](crate::request::GetFaults) and
/// [`ClearFaults`](crate::request::ClearFaults).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FaultReport {
    /// Faults that keep the light off.
    pub latched: FaultSet,
    /// Those whose cause persists: clearing would latch them again at once.
    pub active: FaultSet,
    /// The fault that came first since the last clearing: usually the cause of the rest.
    pub first: Option<FaultRecord>,
    /// The latest.
    pub last: Option<FaultRecord>,
}
