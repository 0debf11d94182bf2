//! The device's clock against virtual time.

/// Device time: microseconds since the last reset, by a crystal that is off by a few millionths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceClock {
    reset_ns: u64,
    /// Device microseconds in a second of virtual time.
    rate: u64,
}

impl DeviceClock {
    /// A clock that was reset at `reset_ns` and is `error_ppm` fast.
    pub fn new(reset_ns: u64, error_ppm: i32) -> Self {
        let rate = 1_000_000_i64.saturating_add(i64::from(error_ppm)).max(1);
        Self { reset_ns, rate: rate.unsigned_abs() }
    }

    /// Device time at `time_ns`: whole microseconds that have passed.
    pub fn us_from_ns(&self, time_ns: u64) -> u64 {
        let since_ns = time_ns.saturating_sub(self.reset_ns);
        if self.rate == 1_000_000 {
            return since_ns / 1_000;
        }
        (u128::from(since_ns) * u128::from(self.rate) / 1_000_000_000) as u64
    }

    /// First nanosecond at which the device's clock shows `time_us`.
    pub fn ns_from_us(&self, time_us: u64) -> u64 {
        let since_ns = if self.rate == 1_000_000 {
            time_us.saturating_mul(1_000)
        } else {
            (u128::from(time_us) * 1_000_000_000).div_ceil(u128::from(self.rate)) as u64
        };
        self.reset_ns.saturating_add(since_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_microsecond_begins_where_it_is_first_shown(
            reset_ns in 0u64..1 << 50, error_ppm in -200i32..200, time_us in 0u64..1 << 45,
        ) {
            let clock = DeviceClock::new(reset_ns, error_ppm);
            let begins_ns = clock.ns_from_us(time_us);
            prop_assert_eq!(clock.us_from_ns(begins_ns), time_us);
            if time_us > 0 {
                prop_assert_eq!(clock.us_from_ns(begins_ns - 1), time_us - 1);
            }
        }
    }
}
