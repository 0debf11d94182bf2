//! Virtual time: cycles of the core clock (HCLK), and their place in nanoseconds.
//!
//! Every model counts in HCLK cycles, so timers are exact to a cycle. The cycle count never runs
//! backwards; when the firmware changes the clock tree, [`Clocks::rebase`] starts a new segment with
//! another cycle length.

/// Frequencies that the reset and clock unit produces, and the segment of virtual time in which they
/// hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Clocks {
    /// Core and AHB clock in hertz.
    pub hclk_hz: u32,
    /// HCLK cycles per APB1 cycle.
    pub apb1_div: u32,
    /// HCLK cycles per APB2 cycle.
    pub apb2_div: u32,
    /// HCLK cycles per clock of the timers on APB1 (user manual 4.2.1: twice APB1 unless its divider
    /// is 1).
    pub timer_apb1_div: u32,
    /// HCLK cycles per clock of the timers on APB2.
    pub timer_apb2_div: u32,
    /// ADC clock in hertz.
    pub adc_hz: u32,
    /// USART0's kernel clock in hertz.
    pub usart0_hz: u32,
    /// Clock of the USB core in hertz: 0 where none is running.
    pub usb_hz: u32,
    base_cycle: u64,
    base_ns: u64,
}

/// IRC8M, which clocks the chip after reset.
pub const IRC8M_HZ: u32 = 8_000_000;

impl Clocks {
    /// The clocks after reset: everything from the 8 MHz internal oscillator.
    #[must_use]
    pub const fn after_reset() -> Self {
        Self {
            hclk_hz: IRC8M_HZ,
            apb1_div: 1,
            apb2_div: 1,
            timer_apb1_div: 1,
            timer_apb2_div: 1,
            adc_hz: IRC8M_HZ / 2,
            usart0_hz: IRC8M_HZ,
            usb_hz: 0,
            base_cycle: 0,
            base_ns: 0,
        }
    }

    /// Nanoseconds since power-on at `cycle`, rounded down.
    #[must_use]
    pub fn ns_at(&self, cycle: u64) -> u64 {
        let cycles = cycle.saturating_sub(self.base_cycle);
        self.base_ns + (u128::from(cycles) * 1_000_000_000 / u128::from(self.hclk_hz)) as u64
    }

    /// The first cycle that is not before `ns`.
    #[must_use]
    pub fn cycle_at(&self, ns: u64) -> u64 {
        let ns = ns.saturating_sub(self.base_ns);
        let cycles = (u128::from(ns) * u128::from(self.hclk_hz)).div_ceil(1_000_000_000);
        self.base_cycle + u64::try_from(cycles).unwrap_or(u64::MAX / 2)
    }

    /// HCLK cycles in `ns` nanoseconds, rounded up.
    #[must_use]
    pub fn cycles_in(&self, ns: u64) -> u64 {
        (u128::from(ns) * u128::from(self.hclk_hz)).div_ceil(1_000_000_000) as u64
    }

    /// The same instant of virtual time, from which on `self`'s frequencies are replaced by `next`'s.
    #[must_use]
    pub fn rebase(&self, cycle: u64, next: Clocks) -> Clocks {
        Clocks { base_cycle: cycle, base_ns: self.ns_at(cycle), ..next }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_change_keeps_time_continuous() {
        let slow = Clocks::after_reset();
        let fast = slow.rebase(8_000, Clocks { hclk_hz: 84_000_000, ..slow });
        assert_eq!(fast.ns_at(8_000), 1_000_000);
        assert_eq!(fast.ns_at(8_000 + 84_000), 2_000_000);
        assert_eq!(fast.cycle_at(2_000_000), 8_000 + 84_000);
    }

    #[test]
    fn the_cycle_of_a_time_is_never_before_it() {
        let clocks = Clocks::after_reset()
            .rebase(17, Clocks { hclk_hz: 84_000_000, ..Clocks::after_reset() });
        for ns in 3_000..3_400 {
            assert!(clocks.ns_at(clocks.cycle_at(ns) + 1) >= ns);
            assert!(clocks.cycle_at(ns) == 17 || clocks.ns_at(clocks.cycle_at(ns) - 1) <= ns);
        }
    }
}
