//! Timer prescaler, reload and watchdog arithmetic (user manual, "TIMER": prescaler and
//! auto-reload; "Free watchdog timer (FWDGT)").

/// Prescaler register for an exact tick rate, or `None` where the clock is no multiple of it or
/// the 16-bit prescaler is too small.
pub const fn prescaler(timer_hz: u32, tick_hz: u32) -> Option<u16> {
    if tick_hz == 0 || !timer_hz.is_multiple_of(tick_hz) {
        return None;
    }
    let divisor = timer_hz / tick_hz;
    if divisor == 0 || divisor > 0x1_0000 { None } else { Some((divisor - 1) as u16) }
}

/// Prescaler and reload registers of a 16-bit timer for a frequency: the smallest prescaler, so
/// the finest duty steps. `None` below one step in 2^32 or above half the clock.
pub const fn pwm(timer_hz: u32, frequency_hz: u32) -> Option<(u16, u16)> {
    if frequency_hz == 0 || frequency_hz > timer_hz / 2 {
        return None;
    }
    let period = timer_hz / frequency_hz;
    let divisor = period.div_ceil(0x1_0000);
    if divisor > 0x1_0000 {
        return None;
    }
    Some(((divisor - 1) as u16, (period / divisor - 1) as u16))
}

/// Nominal frequency of IRC40K in hertz, which clocks the watchdog.
pub const IRC40K_HZ: u32 = 40_000;
/// Its fastest, in hertz (data sheet, "IRC40K characteristics": 20 to 60 kHz).
pub const IRC40K_MAX_HZ: u32 = 60_000;
/// Its slowest, in hertz.
pub const IRC40K_MIN_HZ: u32 = 20_000;

/// FWDGT_PSC and FWDGT_RLD that let at least `timeout_us` pass, even from the fastest IRC40K of
/// the data sheet; `None` where the longest is too short.
pub const fn watchdog(timeout_us: u32) -> Option<(u8, u16)> {
    let cycles = (timeout_us as u64 * IRC40K_MAX_HZ as u64).div_ceil(1_000_000);
    let mut code = 0;
    while code <= 6 {
        let reload = cycles.div_ceil(4 << code);
        if reload <= 0x1000 {
            return Some((code, if reload == 0 { 0 } else { (reload - 1) as u16 }));
        }
        code += 1;
    }
    None
}

/// Longest time in microseconds after which that watchdog bites, on the slowest IRC40K.
pub const fn watchdog_longest_us(code: u8, reload: u16) -> u64 {
    (reload as u64 + 1) * (4 << code) * 1_000_000 / IRC40K_MIN_HZ as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn microsecond_ticks() {
        assert_eq!(prescaler(84_000_000, 1_000_000), Some(83));
        assert_eq!(prescaler(96_000_000, 1_000_000), Some(95));
        assert_eq!(prescaler(84_000_000, 1_000), None, "84 000 does not fit 16 bits");
        assert_eq!(prescaler(84_500_000, 1_000_000), None, "not a whole number");
    }

    #[test]
    fn pwm_is_near_the_frequency() {
        for frequency_hz in [1, 10, 333, 1_000, 20_000, 1_000_000] {
            let (prescaler, reload) = pwm(84_000_000, frequency_hz).unwrap();
            let made = 84e6 / (f64::from(prescaler) + 1.0) / (f64::from(reload) + 1.0);
            assert!((made / f64::from(frequency_hz) - 1.0).abs() < 1e-3, "{frequency_hz}: {made}");
        }
        assert_eq!(pwm(84_000_000, 0), None);
        assert_eq!(pwm(84_000_000, 50_000_000), None);
    }

    #[test]
    fn watchdog_never_bites_early() {
        for timeout_us in [100, 1_000, 50_000, 100_000, 1_000_000, 4_000_000] {
            let (code, reload) = watchdog(timeout_us).unwrap();
            let cycles = (u64::from(reload) + 1) * (4 << code);
            let shortest_us = cycles * 1_000_000 / u64::from(IRC40K_MAX_HZ);
            assert!(shortest_us >= u64::from(timeout_us), "{timeout_us}: {shortest_us}");
            assert!(watchdog_longest_us(code, reload) <= 4 * u64::from(timeout_us) + 1_000);
        }
        assert_eq!(watchdog(60_000_000), None);
    }
}
