//! 64-bit time from a 32-bit counter, without a lock.
//!
//! The counter runs at 1 MHz and overflows every 71.6 minutes. Reading it and a software overflow
//! count is a race: between the two reads the counter may wrap, and the interrupt that counts the
//! wrap may be masked. The cure (as in embassy-stm32's and embassy-nrf's drivers): count *half*
//! periods of 2^31 ticks, in two interrupts, one at the overflow (makes the count even) and one at
//! 2^31 (makes it odd). A reader takes the count first and the counter after it. Whichever side of
//! an edge the interrupt is on, at most one half period is missing, and the counter's top bit
//! together with the count's parity tells that exactly:
//!
//! ```text
//!   counter   0 ......... 2^31 ......... 2^32=0 ......... 2^31
//!   count      2n            2n+1            2n+2           2n+3
//!   late:      2n-1 seen     2n seen         2n+1 seen            (interrupt not taken yet)
//! ```
//!
//! Even count: the counter belongs to `[n * 2^32, n * 2^32 + 2^32)`, whatever its top bit (a set
//! one means the odd interrupt is late). Odd count: a set top bit means the upper half of period
//! n; a clear one means that the overflow interrupt is late, so it is the lower half of n + 1.
//! Precondition: no interrupt is late by half a period (35 minutes).

/// Ticks since start, from the half-period count, read *before* the counter.
pub const fn ticks(half_periods: u32, counter: u32) -> u64 {
    let base = ((half_periods >> 1) as u64) << 32;
    // With an odd count the counter's lower half is read as belonging to the next period.
    let late_overflow = half_periods & 1 == 1 && counter < 0x8000_0000;
    base + counter as u64 + if late_overflow { 1 << 32 } else { 0 }
}

/// Low 32 bits of `ticks` to put into the alarm's compare register, or `None` while the alarm is
/// more than a half period away (a half-period interrupt will look again).
pub const fn alarm(now: u64, at: u64) -> Option<u32> {
    if at.saturating_sub(now) < 0xC000_0000 { Some(at as u32) } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The half-period count that a driver has which took its last interrupt `late` ticks late.
    fn count_seen(true_ticks: u64, late: u64) -> u32 {
        (true_ticks.saturating_sub(late) >> 31) as u32
    }

    #[test]
    fn right_at_every_edge_however_late_the_interrupt() {
        for edge in 1..9u64 {
            for offset in -3i64..=3 {
                let now = (edge << 31).checked_add_signed(offset).unwrap();
                for late in [0, 1, 2, 3, 100, 1_000_000, (1 << 31) - 4] {
                    assert_eq!(
                        ticks(count_seen(now, late), now as u32),
                        now,
                        "edge {edge} offset {offset} late {late}"
                    );
                }
            }
        }
    }

    #[test]
    fn right_when_the_counter_moves_between_the_two_reads() {
        // The count is read, then up to 1000 ticks pass before the counter is read.
        for edge in 1..9u64 {
            for before in 0..20 {
                for gap in [0, 1, 5, 19, 21, 1000] {
                    let at_count = (edge << 31) - before;
                    let at_counter = at_count + gap;
                    assert_eq!(ticks((at_count >> 31) as u32, at_counter as u32), at_counter);
                }
            }
        }
    }

    #[test]
    fn the_other_order_would_be_wrong() {
        // Counter first, count after an interrupt in between: this is why the order matters.
        let at_counter = (2u64 << 31) - 1;
        let count_after = 2;
        assert_ne!(ticks(count_after, at_counter as u32), at_counter);
    }

    #[test]
    fn alarms_beyond_three_quarters_of_a_period_wait() {
        assert_eq!(alarm(0, 5), Some(5));
        assert_eq!(alarm((1 << 32) - 2, (1 << 32) + 3), Some(3));
        assert_eq!(alarm(0, u64::MAX), None);
        assert_eq!(alarm(10, 5), Some(5), "past alarms are the caller's to notice");
    }
}
