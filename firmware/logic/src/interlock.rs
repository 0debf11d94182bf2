//! Faults: what latches, when, and what clears it.
//!
//! Over-temperature, a broken temperature sensor and engine, duty and on-time faults latch whenever
//! they are seen. Interlock, heartbeat and link latch only while light is allowed (armed or running):
//! opening the enclosure of a sensor at rest is no fault, but arming is refused until it is closed.

use stspp_protocol::fault::{FaultReason, FaultRecord, FaultReport, FaultSet};
use stspp_protocol::timing::Limits;

/// Readings outside of this are a sensor that is open or shorted, tenths of a degree Celsius.
pub const PLAUSIBLE_TEMPERATURE_DC: core::ops::RangeInclusive<i16> = -400..=1250;

/// An over-temperature is over when it is this much cooler than the limit.
pub const TEMPERATURE_HYSTERESIS_DC: i16 = 50;

/// Latched faults and the conditions behind them.
#[derive(Debug, Clone)]
pub struct Interlock {
    latched: FaultSet,
    active: FaultSet,
    first: Option<FaultRecord>,
    last: Option<FaultRecord>,
    temperature_dc: i16,
    max_temperature_dc: i16,
}

impl Interlock {
    /// Starts with the faults that survived the reset.
    #[must_use]
    pub fn new(limits: &Limits, carried: FaultSet) -> Self {
        let carried_record = carried.iter().next().map(|reason| FaultRecord {
            reason,
            time_us: 0,
            value: 0,
            limit: 0,
        });
        Self {
            latched: carried,
            active: FaultSet::EMPTY,
            first: carried_record,
            last: carried_record,
            temperature_dc: 250,
            max_temperature_dc: limits.max_temperature_dc,
        }
    }

    /// Latches a fault. Returns its record where it was not latched before.
    pub fn latch(&mut self, record: FaultRecord) -> Option<FaultRecord> {
        let is_new = !self.latched.contains(record.reason);
        self.latched.insert(record.reason);
        self.last = Some(record);
        self.first.get_or_insert(record);
        is_new.then_some(record)
    }

    /// Notes whether the cause of a fault is there now.
    pub const fn set_active(&mut self, reason: FaultReason, active: bool) {
        if active { self.active.insert(reason) } else { self.active.remove(reason) }
    }

    /// Takes a temperature reading; returns the fault that it is.
    pub fn read_temperature(&mut self, now_us: u64, temperature_dc: i16) -> Option<FaultRecord> {
        self.temperature_dc = temperature_dc;
        let record = |reason, limit: i16| FaultRecord {
            reason,
            time_us: now_us,
            value: i32::from(temperature_dc),
            limit: i32::from(limit),
        };
        let plausible = PLAUSIBLE_TEMPERATURE_DC.contains(&temperature_dc);
        self.set_active(FaultReason::TemperatureSensor, !plausible);
        if !plausible {
            let (low, high) = PLAUSIBLE_TEMPERATURE_DC.into_inner();
            let limit = if temperature_dc < low { low } else { high };
            return Some(record(FaultReason::TemperatureSensor, limit));
        }
        let limit = self.max_temperature_dc;
        if temperature_dc > limit {
            self.set_active(FaultReason::OverTemperature, true);
            return Some(record(FaultReason::OverTemperature, limit));
        }
        if temperature_dc <= limit.saturating_sub(TEMPERATURE_HYSTERESIS_DC) {
            self.set_active(FaultReason::OverTemperature, false);
        }
        None
    }

    /// Unlatches what is not active any more. Returns whether nothing is latched now.
    pub fn clear(&mut self) -> bool {
        self.latched = FaultSet(self.latched.0 & self.active.0);
        let still = |record: &FaultRecord| self.latched.contains(record.reason);
        self.last = self.last.filter(still);
        self.first = self.first.filter(still).or(self.last);
        self.latched.is_empty()
    }

    /// Faults that keep the light off.
    #[must_use]
    pub const fn latched(&self) -> FaultSet {
        self.latched
    }

    /// Whether the interlock input is closed.
    #[must_use]
    pub const fn is_closed(&self) -> bool {
        !self.active.contains(FaultReason::Interlock)
    }

    /// Last reading, tenths of a degree Celsius.
    #[must_use]
    pub const fn temperature_dc(&self) -> i16 {
        self.temperature_dc
    }

    /// What a host of protocol 1.`minor` gets.
    #[must_use]
    pub fn report(&self, minor: u16) -> FaultReport {
        let known =
            |record: FaultRecord| FaultRecord { reason: record.reason.as_of(minor), ..record };
        FaultReport {
            latched: self.latched,
            active: self.active,
            first: self.first.map(known),
            last: self.last.map(known),
        }
    }
}
