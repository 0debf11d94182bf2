//! Units of the protocol.
//!
//! Every number carries its unit in its name: `_us` microseconds, `_permille` thousandths, `_dc` tenths
//! of a degree Celsius. There are no floating-point numbers on the wire.
//!
//! Device time is a `u64` count of microseconds since the controller's reset; it never wraps.

/// Microseconds in a second.
pub const US_PER_S: u64 = 1_000_000;

/// Microseconds in a millisecond.
pub const US_PER_MS: u64 = 1_000;

/// Thousandths in a whole.
pub const PERMILLE: u32 = 1_000;

/// Share of `part` in `whole` in thousandths, rounded up, so that a limit is never passed by rounding.
///
/// Returns `u32::MAX` where `whole` is zero.
#[must_use]
pub const fn permille_ceil(part: u64, whole: u64) -> u32 {
    if whole == 0 {
        return u32::MAX;
    }
    let share = (part as u128 * PERMILLE as u128).div_ceil(whole as u128);
    if share > u32::MAX as u128 { u32::MAX } else { share as u32 }
}

/// Degrees Celsius from the tenths of a degree that the wire carries.
#[must_use]
pub fn celsius_from_dc(temperature_dc: i16) -> f32 {
    f32::from(temperature_dc) / 10.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn permille_rounds_up() {
        assert_eq!(permille_ceil(1, 1000), 1);
        assert_eq!(permille_ceil(1, 1001), 1);
        assert_eq!(permille_ceil(400_001, 1_000_000), 401);
        assert_eq!(permille_ceil(0, 7), 0);
        assert_eq!(permille_ceil(1, 0), u32::MAX);
        assert_eq!(permille_ceil(u64::MAX, 1), u32::MAX);
    }
}
