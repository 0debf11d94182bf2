//! The clock that heartbeats, timeouts and latencies run on: the machine's, or the simulation's.
//!
//! Every time field of this crate names its clock: `device` is the controller's microsecond counter,
//! `camera` is a camera's own timestamp, `host` is the [`Clock`] here, in nanoseconds since the source
//! was opened.

use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Host time in nanoseconds since the source was opened.
pub trait Clock: Send + Sync + fmt::Debug {
    /// The time now. Never decreases.
    fn now_ns(&self) -> u64;

    /// Whether the time is simulated: it then stands still unless the source is asked for data.
    fn is_virtual(&self) -> bool {
        false
    }
}

/// The machine's monotonic clock.
#[derive(Debug)]
pub struct MonotonicClock {
    origin: Instant,
}

impl MonotonicClock {
    /// A clock that starts at 0 now.
    pub fn new() -> Self {
        Self { origin: Instant::now() }
    }
}

impl Default for MonotonicClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for MonotonicClock {
    fn now_ns(&self) -> u64 {
        duration_ns(self.origin.elapsed())
    }
}

/// A clock that stands still until it is advanced.
#[derive(Debug, Default)]
pub struct VirtualClock {
    now_ns: AtomicU64,
}

impl VirtualClock {
    /// A clock that stands at 0.
    pub fn new() -> Self {
        Self::default()
    }

    /// Moves the clock to `time_ns`; a time in the past changes nothing.
    pub fn advance_to_ns(&self, time_ns: u64) {
        self.now_ns.fetch_max(time_ns, Ordering::AcqRel);
    }
}

impl Clock for VirtualClock {
    fn now_ns(&self) -> u64 {
        self.now_ns.load(Ordering::Acquire)
    }

    fn is_virtual(&self) -> bool {
        true
    }
}

/// `duration` in nanoseconds, at most `u64::MAX` (584 years).
pub fn duration_ns(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_virtual_clock_moves_only_when_told_and_never_back() {
        let clock = VirtualClock::new();
        assert_eq!(clock.now_ns(), 0);
        clock.advance_to_ns(50);
        clock.advance_to_ns(20);
        assert_eq!(clock.now_ns(), 50);
        assert!(clock.is_virtual());
    }

    #[test]
    fn the_machine_clock_moves_by_itself() {
        let clock = MonotonicClock::new();
        let first_ns = clock.now_ns();
        while clock.now_ns() == first_ns {}
        assert!(clock.now_ns() > first_ns);
        assert!(!clock.is_virtual());
    }
}
