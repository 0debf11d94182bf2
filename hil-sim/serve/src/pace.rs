//! How fast the sensor's time passes.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use stspp_hil_sim::front::bench::Clock;

/// Longest stretch that is made up for at once: a machine that is too slow to emulate the sensor in
/// real time has its time pass more slowly, instead of falling behind for good.
const CATCH_UP: Duration = Duration::from_millis(20);

/// Where the number of exposures that wait for the host is told, once there is a rig.
pub type Backlog = Arc<OnceLock<Arc<AtomicUsize>>>;

struct State {
    time_ns: u64,
    seen: Instant,
}

/// A clock that begins at `begin_ns` and follows the machine's. With `patient`, it passes the more slowly
/// the more pictures wait for the host, so that a host that is slow loses none; it never stands still,
/// so that requests are answered all the while.
pub fn clock(begin_ns: u64, patient: bool, backlog: Backlog) -> Clock {
    let state = Mutex::new(State { time_ns: begin_ns, seen: Instant::now() });
    Arc::new(move || {
        let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let passed = now.saturating_duration_since(state.seen).min(CATCH_UP);
        state.seen = now;
        let waiting = match backlog.get() {
            Some(backlog) if patient => backlog.load(Ordering::Relaxed),
            _ => 0,
        };
        let slower = match waiting {
            0 | 1 => 1,
            2 => 10,
            _ => 100,
        };
        state.time_ns += passed.as_nanos() as u64 / slower;
        state.time_ns
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_never_goes_back_and_slips_where_the_machine_is_too_slow() {
        let clock = clock(1_000, false, Backlog::default());
        let first = clock();
        assert!(first >= 1_000);
        std::thread::sleep(Duration::from_millis(60));
        let passed_ns = clock() - first;
        assert!(passed_ns <= CATCH_UP.as_nanos() as u64, "{passed_ns}");
        assert!(clock() >= first + passed_ns);
    }

    #[test]
    fn a_patient_clock_waits_for_the_host() {
        let backlog = Backlog::default();
        let waiting = backlog.get_or_init(|| Arc::new(AtomicUsize::new(5)));
        let clock = clock(0, true, Arc::clone(&backlog));
        std::thread::sleep(Duration::from_millis(10));
        let slow_ns = clock();
        assert!((1..=200_000).contains(&slow_ns), "{slow_ns}");
        waiting.store(0, Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(10));
        assert!(clock() - slow_ns >= 10_000_000);
    }
}
