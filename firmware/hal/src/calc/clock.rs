//! Clock tree arithmetic (GD32F3x0 user manual, "Reset and clock unit (RCU)": clock tree,
//! registers RCU_CFG0, RCU_CFG1, RCU_CFG2).

/// What feeds the PLL.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PllInput {
    /// The internal 8 MHz oscillator, halved (no predivider on this path).
    Irc8mHalf,
    /// The crystal, through the predivider.
    Hxtal {
        /// Crystal frequency in hertz.
        hz: u32,
    },
    /// The internal 48 MHz oscillator, through the predivider.
    Irc48m,
}

impl PllInput {
    /// Frequency before the predivider, in hertz.
    pub const fn hz(self) -> u32 {
        match self {
            Self::Irc8mHalf => 4_000_000,
            Self::Hxtal { hz } => hz,
            Self::Irc48m => 48_000_000,
        }
    }

    const fn has_predivider(self) -> bool {
        !matches!(self, Self::Irc8mHalf)
    }
}

/// A PLL setting.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pll {
    /// What feeds it.
    pub input: PllInput,
    /// Predivider, 1..=16.
    pub predivider: u8,
    /// Multiplier, 2..=64.
    pub multiplier: u8,
}

/// Why a clock cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ClockError {
    /// The system clock is above what this chip may run at.
    TooFast,
    /// No predivider and multiplier give the frequency exactly.
    Unreachable,
    /// USB is asked for, but the PLL's frequency is not 48 MHz times 1, 1.5, 2, 2.5, 3 or 3.5.
    No48MHz,
}

/// Slowest input of the PLL's phase comparator, after the predivider, in hertz (data sheet, "PLL
/// characteristics").
const PLL_INPUT_MIN_HZ: u32 = 1_000_000;
/// Fastest such input, in hertz.
const PLL_INPUT_MAX_HZ: u32 = 25_000_000;

impl Pll {
    /// The setting that gives exactly `target_hz`, with the highest comparator frequency (least
    /// jitter) that does.
    pub fn solve(input: PllInput, target_hz: u32) -> Result<Self, ClockError> {
        let prediv_max = if input.has_predivider() { 16 } else { 1 };
        for predivider in 1..=prediv_max {
            if !input.hz().is_multiple_of(predivider) {
                continue;
            }
            let comparator_hz = input.hz() / predivider;
            if !(PLL_INPUT_MIN_HZ..=PLL_INPUT_MAX_HZ).contains(&comparator_hz) {
                continue;
            }
            if target_hz.is_multiple_of(comparator_hz) {
                let multiplier = target_hz / comparator_hz;
                if (2..=64).contains(&multiplier) {
                    return Ok(Self {
                        input,
                        predivider: predivider as u8,
                        multiplier: multiplier as u8,
                    });
                }
            }
        }
        Err(ClockError::Unreachable)
    }

    /// Output frequency in hertz.
    pub const fn output_hz(self) -> u32 {
        self.input.hz() / self.predivider as u32 * self.multiplier as u32
    }

    /// The six bits of PLLMF: 0..=14 is x2..=x16, 15 repeats x16, 16..=63 is x17..=x64 (RCU_CFG0,
    /// PLLMF[3:0] and PLLMF[4]; RCU_CFG1, PLLMF[5]).
    pub const fn multiplier_bits(self) -> u8 {
        if self.multiplier <= 16 { self.multiplier - 2 } else { self.multiplier - 1 }
    }
}

/// Bits of USBFSPSC[2:0] that make 48 MHz of `pll_hz` (RCU_CFG0 bits 23:22 and RCU_CFG2 bit 30).
pub const fn usb_prescaler_bits(pll_hz: u32) -> Result<u8, ClockError> {
    match pll_hz {
        72_000_000 => Ok(0b000),
        48_000_000 => Ok(0b001),
        120_000_000 => Ok(0b010),
        96_000_000 => Ok(0b011),
        144_000_000 => Ok(0b100),
        168_000_000 => Ok(0b101),
        _ => Err(ClockError::No48MHz),
    }
}

/// Smallest APB prescaler that keeps the bus at or below `max_hz`: divisor and the bits of
/// APBxPSC.
pub const fn apb_prescaler(ahb_hz: u32, max_hz: u32) -> (u32, u8) {
    let mut divisor = 1;
    let mut bits = 0b000;
    while ahb_hz / divisor > max_hz && divisor < 16 {
        divisor *= 2;
        bits = if bits == 0 { 0b100 } else { bits + 1 };
    }
    (divisor, bits)
}

/// Clock of a timer on a bus: the bus clock, doubled where the bus is divided (clock tree).
pub const fn timer_hz(ahb_hz: u32, apb_divisor: u32) -> u32 {
    let apb_hz = ahb_hz / apb_divisor;
    if apb_divisor == 1 { apb_hz } else { 2 * apb_hz }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_solution_gives_its_target() {
        for input in [PllInput::Irc8mHalf, PllInput::Hxtal { hz: 8_000_000 }, PllInput::Irc48m] {
            let mut found = 0;
            for mhz in 16..=108 {
                if let Ok(pll) = Pll::solve(input, mhz * 1_000_000) {
                    assert_eq!(pll.output_hz(), mhz * 1_000_000, "{pll:?}");
                    assert!((1..=16).contains(&pll.predivider));
                    found += 1;
                }
            }
            assert!(found > 20, "{input:?} reaches only {found} frequencies");
        }
    }

    #[test]
    fn the_boards_clocks() {
        let f330 = Pll::solve(PllInput::Hxtal { hz: 8_000_000 }, 84_000_000).unwrap();
        assert_eq!((f330.predivider, f330.multiplier, f330.multiplier_bits()), (2, 21, 20));
        let f350 = Pll::solve(PllInput::Hxtal { hz: 8_000_000 }, 96_000_000).unwrap();
        assert_eq!((f350.predivider, f350.multiplier, f350.multiplier_bits()), (1, 12, 10));
        let internal = Pll::solve(PllInput::Irc8mHalf, 84_000_000).unwrap();
        assert_eq!((internal.predivider, internal.multiplier), (1, 21));
    }

    #[test]
    fn multiplier_code_is_one_to_one_but_for_16() {
        // Read back as the manual's table prints it.
        for code in 0u8..64 {
            let multiplier = match code {
                0..=14 => code + 2,
                15 => 16,
                _ => code + 1,
            };
            let pll = Pll { input: PllInput::Irc8mHalf, predivider: 1, multiplier };
            let expected = if code == 15 { 14 } else { code };
            assert_eq!(pll.multiplier_bits(), expected);
        }
    }

    #[test]
    fn what_cannot_be_made_is_refused() {
        assert_eq!(
            Pll::solve(PllInput::Irc8mHalf, 85_000_000),
            Err(ClockError::Unreachable),
            "4 MHz steps only"
        );
        assert_eq!(
            Pll::solve(PllInput::Hxtal { hz: 40_000_000 }, 7_000_000),
            Err(ClockError::Unreachable)
        );
        assert_eq!(usb_prescaler_bits(84_000_000), Err(ClockError::No48MHz));
    }

    #[test]
    fn apb_stays_below_its_limit() {
        assert_eq!(apb_prescaler(84_000_000, 42_000_000), (2, 0b100));
        assert_eq!(apb_prescaler(96_000_000, 54_000_000), (2, 0b100));
        assert_eq!(apb_prescaler(8_000_000, 42_000_000), (1, 0b000));
        assert_eq!(apb_prescaler(108_000_000, 20_000_000), (8, 0b110));
        assert_eq!(timer_hz(84_000_000, 2), 84_000_000);
        assert_eq!(timer_hz(84_000_000, 1), 84_000_000);
        assert_eq!(timer_hz(84_000_000, 4), 42_000_000);
    }
}
