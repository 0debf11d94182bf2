//! How long each emitter may still be on: a leaky bucket each.
//!
//! A bucket rises by the time that its emitter was on and leaks at the limit's duty. Light that would
//! make a bucket rise above its capacity is refused; a bucket that does is a fault. So over any time `t`
//! an emitter is on for at most `duty * t + capacity`, with `capacity = duty * duty_window_us`.
//!
//! A run is admitted while the buckets of the emitters that it lights are at most half full. That is
//! enough: within a run every full slot cycle adds at most what leaks meanwhile (the validator sees to
//! it), and no part of a cycle adds more than `duty *` the longest cycle, which is half the capacity.
//!
//! Only power-on starts with empty buckets. After any other reset they are full, because nobody knows
//! what was lit before: else a host could pass the limit by asking for resets.

use stspp_protocol::timing::{Limits, MAX_PROJECTORS};
use stspp_protocol::units::PERMILLE;

use crate::timing::GateWord;

/// Emitters: as many projectors as masks have bits, and the floodlight.
const EMITTERS: usize = MAX_PROJECTORS + 1;

/// An emitter that must rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exhausted {
    /// Projector, or the number of projectors for the floodlight.
    pub emitter: u8,
    /// How long until its bucket is half empty.
    pub retry_after_us: u32,
    /// What is in its bucket, microseconds of on-time.
    pub level_us: u32,
    /// What fits.
    pub capacity_us: u32,
}

#[derive(Debug, Clone, Copy)]
struct Bucket {
    /// Thousandths of a microsecond.
    level: u64,
    leak_permille: u32,
    capacity: u64,
}

impl Bucket {
    const fn new(duty_permille: u16, window_us: u32, rested: bool) -> Self {
        let leak_permille = duty_permille as u32;
        let capacity = (leak_permille as u64).saturating_mul(window_us as u64);
        Self { level: if rested { 0 } else { capacity }, leak_permille, capacity }
    }

    const fn half(&self) -> u64 {
        self.capacity / 2
    }
}

/// The buckets of all emitters.
#[derive(Debug, Clone)]
pub struct DutyBudget {
    projectors: [Bucket; MAX_PROJECTORS],
    floodlight: Bucket,
    projector_count: u8,
    updated_us: u64,
}

impl DutyBudget {
    /// The buckets at device time 0: empty where the emitters are known to be rested, else full.
    #[must_use]
    pub fn new(limits: &Limits, rested: bool) -> Self {
        let bucket = |duty_permille| Bucket::new(duty_permille, limits.duty_window_us, rested);
        Self {
            projectors: [bucket(limits.max_projector_duty_permille); MAX_PROJECTORS],
            floodlight: bucket(limits.max_floodlight_duty_permille),
            projector_count: limits.projector_count,
            updated_us: 0,
        }
    }

    fn lit(&mut self, gates: GateWord) -> impl Iterator<Item = (u8, &mut Bucket)> {
        let mask = gates.projector_mask();
        let count = self.projector_count;
        self.projectors
            .iter_mut()
            .chain(core::iter::once(&mut self.floodlight))
            .enumerate()
            .take(EMITTERS)
            .filter_map(move |(index, bucket)| {
                let is_floodlight = index == MAX_PROJECTORS;
                let is_lit = if is_floodlight {
                    gates.floodlight()
                } else {
                    mask.checked_shr(index as u32).is_some_and(|bits| bits & 1 != 0)
                };
                let emitter = if is_floodlight { count } else { index as u8 };
                is_lit.then_some((emitter, bucket))
            })
    }

    /// Lets the buckets leak up to `now_us`.
    pub fn advance(&mut self, now_us: u64) {
        let elapsed_us = now_us.saturating_sub(self.updated_us);
        self.updated_us = self.updated_us.max(now_us);
        for bucket in self.projectors.iter_mut().chain(core::iter::once(&mut self.floodlight)) {
            let leak = elapsed_us.saturating_mul(u64::from(bucket.leak_permille));
            bucket.level = bucket.level.saturating_sub(leak);
        }
    }

    /// Whether the emitters in `gates` are rested enough for a run.
    ///
    /// # Errors
    ///
    /// The first that is not.
    pub fn admit(&mut self, gates: GateWord) -> Result<(), Exhausted> {
        for (emitter, bucket) in self.lit(gates) {
            if bucket.level > bucket.half() {
                return Err(exhausted(emitter, bucket));
            }
        }
        Ok(())
    }

    /// Notes that the emitters in `gates` were on for `on_time_us`, ending now.
    ///
    /// # Errors
    ///
    /// The last emitter whose bucket runs over; all are charged.
    pub fn charge(&mut self, gates: GateWord, on_time_us: u32) -> Result<(), Exhausted> {
        let charge = u64::from(on_time_us).saturating_mul(u64::from(PERMILLE));
        let mut result = Ok(());
        for (emitter, bucket) in self.lit(gates) {
            bucket.level = bucket.level.saturating_add(charge);
            if bucket.level > bucket.capacity {
                result = Err(exhausted(emitter, bucket));
            }
        }
        result
    }
}

fn exhausted(emitter: u8, bucket: &Bucket) -> Exhausted {
    let microseconds =
        |level: u64| u32::try_from(level.div_ceil(u64::from(PERMILLE))).unwrap_or(u32::MAX);
    let excess = bucket.level.saturating_sub(bucket.half());
    let rest_us = excess.div_ceil(u64::from(bucket.leak_permille.max(1)));
    Exhausted {
        emitter,
        retry_after_us: u32::try_from(rest_us).unwrap_or(u32::MAX),
        level_us: microseconds(bucket.level),
        capacity_us: microseconds(bucket.capacity),
    }
}
