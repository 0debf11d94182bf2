//! What happens when matching takes longer than the camera: first the rate is lowered, then quality.
//!
//! While a match fits the time between two windows, each window is matched. Beyond, every second one
//! is, every third, and so on: evenly, so that depth frames keep a steady beat and each is as good as
//! ever. Only where the rate would fall below a floor, matching goes over to the first-order shape
//! function, whose noise is the same or less and which costs less, but which rounds off curved surfaces.
//! From time to time a match at full quality is tried again. All of it is counted in
//! [`super::StreamStats`].

use std::time::Duration;

/// The floor of the rate, and whether there is a budget at all.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BudgetPolicy {
    /// Below this many depth frames a second, quality is lowered; zero never does.
    pub rate_min_hz: f64,
}

impl Default for BudgetPolicy {
    fn default() -> Self {
        Self { rate_min_hz: 5.0 }
    }
}

/// Part of the time between windows that a match may take: the rest is rectification's.
const SHARE: f64 = 0.9;
/// A longer time counts by this part at once...
const RISE: f64 = 0.5;
/// ...and a shorter one by this.
const FALL: f64 = 0.1;
/// The rate rises when the time would fit the higher one with this part to spare.
const SPARE: f64 = 0.85;
/// Depth frames of lower quality after which a full one is tried.
const RETRY_FRAMES: u32 = 100;

/// Decides which windows are matched, and how well.
#[derive(Debug, Clone)]
pub(crate) struct Budget {
    policy: BudgetPolicy,
    period_s: f64,
    /// Expected time of a match; zero before the first.
    expected_s: f64,
    /// Every how manyth window is matched.
    every: u32,
    /// Trigger of the newest pair of the window that was matched last.
    matched: Option<u32>,
    reduced: bool,
    reduced_frames: u32,
}

impl Budget {
    pub fn new(policy: BudgetPolicy) -> Self {
        Self {
            policy,
            period_s: 0.0,
            expected_s: 0.0,
            every: 1,
            matched: None,
            reduced: false,
            reduced_frames: 0,
        }
    }

    /// Sets the time between two windows.
    pub fn set_period(&mut self, period: Duration) {
        self.period_s = period.as_secs_f64();
        self.every = 1;
        self.matched = None;
    }

    /// Whether the complete window that ends with trigger `sequence` is matched. What counts is how many
    /// triggers ago the last match was: a machine that loses pairs while it matches has waited long
    /// enough when it has the next window together.
    pub fn admit(&mut self, sequence: u32) -> bool {
        let since = self.matched.map(|matched| sequence.wrapping_sub(matched));
        if since.is_some_and(|since| since < self.every) {
            return false;
        }
        self.matched = Some(sequence);
        true
    }

    /// Whether matches are of lower quality.
    pub fn is_reduced(&self) -> bool {
        self.reduced
    }

    /// Every how manyth window is matched.
    pub fn every(&self) -> u32 {
        self.every
    }

    /// Whether a match took longer than the camera's own rate allows.
    pub fn is_over(&self, took: Duration) -> bool {
        self.period_s > 0.0 && took.as_secs_f64() > self.limit_s()
    }

    fn limit_s(&self) -> f64 {
        SHARE * self.period_s
    }

    /// Learns how long a match took.
    pub fn record(&mut self, took: Duration) {
        let took_s = took.as_secs_f64();
        if self.expected_s == 0.0 {
            self.expected_s = took_s;
        } else {
            let part = if took_s > self.expected_s { RISE } else { FALL };
            self.expected_s += part * (took_s - self.expected_s);
        }
        if self.period_s <= 0.0 {
            return;
        }
        let needed = (self.expected_s / self.limit_s()).ceil().clamp(1.0, 1e6) as u32;
        if needed > self.every {
            self.every = needed;
        } else {
            let relaxed = (self.expected_s / (SPARE * self.limit_s())).ceil().max(1.0) as u32;
            self.every = self.every.min(relaxed.max(needed));
        }
        self.weigh_quality();
    }

    fn weigh_quality(&mut self) {
        let rate_hz = 1.0 / (self.period_s * f64::from(self.every));
        if self.reduced {
            self.reduced_frames += 1;
            if self.reduced_frames >= RETRY_FRAMES {
                (self.reduced, self.reduced_frames) = (false, 0);
                self.expected_s = 0.0;
            }
        } else if rate_hz < self.policy.rate_min_hz {
            (self.reduced, self.reduced_frames) = (true, 0);
            self.expected_s = 0.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Windows come every `period_ms`, and a match takes `cost_ms` (full, reduced): matched windows and
    /// those at lower quality among `windows`.
    fn simulate(budget: &mut Budget, windows: u32, cost_ms: impl Fn(bool) -> f64) -> (u32, u32) {
        let (mut matched, mut reduced) = (0, 0);
        let first = budget.matched.map_or(0, |matched| matched + 1);
        for sequence in first..first + windows {
            if budget.admit(sequence) {
                matched += 1;
                reduced += u32::from(budget.is_reduced());
                budget.record(Duration::from_secs_f64(cost_ms(budget.is_reduced()) * 1e-3));
            }
        }
        (matched, reduced)
    }

    fn budget(rate_min_hz: f64) -> Budget {
        let mut budget = Budget::new(BudgetPolicy { rate_min_hz });
        budget.set_period(Duration::from_micros(33_333));
        budget
    }

    #[test]
    fn a_machine_that_keeps_up_matches_every_window() {
        assert_eq!(simulate(&mut budget(5.0), 100, |_| 28.0), (100, 0));
    }

    #[test]
    fn the_rate_is_lowered_evenly_before_quality() {
        let mut slow = budget(5.0);
        let (matched, reduced) = simulate(&mut slow, 100, |_| 70.0);
        // 70 ms fit into three periods of 30 ms.
        assert!((33..=36).contains(&matched) && reduced == 0, "{matched} {reduced}");
        assert_eq!(slow.every(), 3);
        let beats: Vec<bool> = (1000..1009).map(|sequence| slow.admit(sequence)).collect();
        assert_eq!(beats.iter().filter(|b| **b).count(), 3);
        assert!((0..6).all(|k| beats[k] == beats[k + 3]));
    }

    #[test]
    fn quality_is_lowered_below_the_floor_of_the_rate_only_and_full_quality_tried_again() {
        let mut slow = budget(5.0);
        let cost = |reduced| if reduced { 100.0 } else { 400.0 };
        let (matched, reduced) = simulate(&mut slow, 3000, cost);
        assert!(reduced * 10 > matched * 9, "{reduced} of {matched}");
        assert!(reduced < matched, "full quality is tried again");
        // A floor of zero never gives quality up.
        assert_eq!(simulate(&mut budget(0.0), 3000, cost).1, 0);
    }

    #[test]
    fn pairs_that_were_lost_meanwhile_count_as_waiting() {
        let mut slow = budget(0.0);
        assert!(slow.admit(9));
        slow.record(Duration::from_secs(7));
        assert!(slow.every() > 200);
        // A few windows fill, and many triggers pass without one.
        assert!(!slow.admit(20) && !slow.admit(150));
        assert!(slow.admit(9 + slow.every()));
    }

    #[test]
    fn a_passing_load_is_recovered_from() {
        let mut busy = budget(5.0);
        simulate(&mut busy, 60, |_| 90.0);
        assert!(busy.every() >= 3);
        simulate(&mut busy, 200, |_| 15.0);
        assert_eq!(busy.every(), 1);
    }

    #[test]
    fn without_a_period_everything_is_matched() {
        let mut budget = Budget::new(BudgetPolicy::default());
        assert_eq!(simulate(&mut budget, 50, |_| 1000.0), (50, 0));
    }
}
