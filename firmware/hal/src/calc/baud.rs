//! Baud rate divisor (GD32F3x0 user manual, "USART": "Baud rate generation", register USART_BAUD).

/// Why a baud rate cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum BaudError {
    /// Even the smallest divisor is too slow.
    TooFast,
    /// The 16-bit divisor overflows.
    TooSlow,
    /// The nearest divisor misses the rate by more than 1.5 %.
    Inexact,
}

/// Largest deviation that two ends which both have it still receive with: 1.5 %, in 1/1000.
const MAX_ERROR_PERMILLE: u64 = 15;

/// USART_BAUD and whether 8-fold oversampling (OVSMOD) is needed, for a peripheral clock and a
/// rate.
///
/// With 16-fold oversampling the register is simply clock / rate (a 12.4 fixed-point number of
/// sixteenths). With 8-fold it is 2 * clock / rate, its lowest four bits shifted right by one.
pub fn divisor(clock_hz: u32, baud: u32) -> Result<(u16, bool), BaudError> {
    if baud == 0 {
        return Err(BaudError::TooSlow);
    }
    let rounded = (u64::from(clock_hz) + u64::from(baud) / 2) / u64::from(baud);
    if rounded > 0xffff {
        return Err(BaudError::TooSlow);
    }
    if rounded < 8 {
        return Err(BaudError::TooFast);
    }
    let made = u64::from(clock_hz) / rounded;
    let error = made.abs_diff(u64::from(baud));
    if error * 1000 > u64::from(baud) * MAX_ERROR_PERMILLE {
        return Err(BaudError::Inexact);
    }
    if rounded >= 16 {
        return Ok((rounded as u16, false));
    }
    let doubled = rounded * 2;
    Ok(((doubled & !0xf | (doubled & 0xf) >> 1) as u16, true))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The rate that the hardware makes of the register, from the manual's formulas.
    fn rate(clock_hz: u32, register: u16, over8: bool) -> f64 {
        let integer = f64::from(register >> 4);
        if over8 {
            f64::from(clock_hz) / (8.0 * (integer + f64::from(register & 7) / 8.0))
        } else {
            f64::from(clock_hz) / (16.0 * (integer + f64::from(register & 15) / 16.0))
        }
    }

    #[test]
    fn two_megabaud_is_exact_on_both_chips() {
        assert_eq!(divisor(42_000_000, 2_000_000), Ok((21, false)));
        assert_eq!(divisor(48_000_000, 2_000_000), Ok((24, false)));
    }

    #[test]
    fn what_is_accepted_is_within_tolerance() {
        let mut over8_seen = false;
        for clock_hz in [8_000_000, 42_000_000, 48_000_000, 54_000_000] {
            for baud in (1_000..6_000_000).step_by(7_919) {
                if let Ok((register, over8)) = divisor(clock_hz, baud) {
                    let made = rate(clock_hz, register, over8);
                    let off = (made / f64::from(baud) - 1.0).abs();
                    assert!(off < 0.0151, "{clock_hz} {baud} -> {register:#x} {over8}: {made}");
                    over8_seen |= over8;
                }
            }
        }
        assert!(over8_seen);
    }

    #[test]
    fn extremes_are_errors() {
        assert_eq!(divisor(42_000_000, 0), Err(BaudError::TooSlow));
        assert_eq!(divisor(42_000_000, 300), Err(BaudError::TooSlow));
        assert_eq!(divisor(8_000_000, 2_000_000), Err(BaudError::TooFast));
        assert_eq!(divisor(42_000_000, 2_750_000), Err(BaudError::Inexact));
    }
}
