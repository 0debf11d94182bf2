//! The camera's own clock out of the metadata node of the stock UVC driver.
//!
//! A metadata buffer (format `UVCH`) holds records: host time in nanoseconds (8 bytes), USB frame
//! number of the host (2), then the payload header as the camera sent it: length, flags, and where the
//! flags say so the presentation time (4 bytes, camera ticks: the start of exposure), the source clock
//! (4 bytes, camera ticks) with the USB frame number at which it was sampled (2).

/// The `UVCH` format code.
pub const UVC_HEADERS: u32 = u32::from_le_bytes(*b"UVCH");

/// What a payload header says of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HeaderTimes {
    /// Start of exposure, camera ticks modulo 2^32.
    pub presentation_ticks: u32,
    /// Camera ticks and USB frame number (11 bits) of the same instant, where given.
    pub source_clock: Option<(u32, u16)>,
}

impl HeaderTimes {
    /// USB frame number (11 bits) at the start of exposure, carried back from the sample of the source
    /// clock. `None` where there is no sample, or it is more than a second away from the exposure.
    pub fn presentation_sof(&self, clock_hz: u32) -> Option<u16> {
        let (sampled_ticks, sof) = self.source_clock?;
        let ahead = i64::from(sampled_ticks.wrapping_sub(self.presentation_ticks) as i32);
        if ahead.unsigned_abs() > u64::from(clock_hz) || clock_hz == 0 {
            return None;
        }
        let frames = (ahead * 1000 + i64::from(clock_hz) / 2).div_euclid(i64::from(clock_hz));
        Some((i64::from(sof) - frames).rem_euclid(2048) as u16)
    }
}

/// Reads the first record of a metadata buffer that has a presentation time.
pub fn parse(mut bytes: &[u8]) -> Option<HeaderTimes> {
    const PREFIX: usize = 10;
    const HAS_PRESENTATION_TIME: u8 = 1 << 2;
    const HAS_SOURCE_CLOCK: u8 = 1 << 3;
    while bytes.len() >= PREFIX + 2 {
        let header = &bytes[PREFIX..];
        let length = usize::from(header[0]);
        if length < 2 || length > header.len() {
            return None;
        }
        let flags = header[1];
        let ticks = |at: usize| Some(u32::from_le_bytes(header.get(at..at + 4)?.try_into().ok()?));
        if flags & HAS_PRESENTATION_TIME != 0 && length >= 6 {
            let source_clock = (flags & HAS_SOURCE_CLOCK != 0 && length >= 12)
                .then(|| Some((ticks(6)?, u16::from_le_bytes([header[10], header[11]]) & 0x7ff)))
                .flatten();
            return Some(HeaderTimes { presentation_ticks: ticks(2)?, source_clock });
        }
        bytes = &bytes[PREFIX + length..];
    }
    None
}

/// Camera ticks that wrap at 2^32 as nanoseconds that do not.
#[derive(Debug, Clone)]
pub struct TickClock {
    clock_hz: u32,
    last: Option<(u32, u64)>,
}

impl TickClock {
    /// A clock of the given rate.
    pub fn new(clock_hz: u32) -> Self {
        Self { clock_hz: clock_hz.max(1), last: None }
    }

    /// Nanoseconds since some fixed time. Successive ticks may be at most half a wrap apart, forward
    /// or back.
    pub fn nanoseconds(&mut self, ticks: u32) -> u64 {
        const START: u64 = 1 << 32;
        let unwrapped = match self.last {
            None => START + u64::from(ticks),
            Some((last, unwrapped)) => {
                unwrapped.wrapping_add_signed(i64::from(ticks.wrapping_sub(last) as i32))
            }
        };
        self.last = Some((ticks, unwrapped));
        (u128::from(unwrapped) * 1_000_000_000 / u128::from(self.clock_hz)) as u64
    }
}

/// The rate of a camera's clock from its USB descriptors (UVC 1.1 table 3-3), Hz.
pub fn clock_hz(descriptors: &[u8]) -> Option<u32> {
    let mut rest = descriptors;
    while let [length, _, ..] = rest {
        // Shorter than its own head: broken.
        if *length < 2 {
            return None;
        }
        let (descriptor, after) = rest.split_at_checked(usize::from(*length))?;
        // Class-specific interface, VideoControl header: 24h, 01h; bcdUVC follows.
        if let [_, 0x24, 0x01, _, 0x01, _, _, a, b, c, d, ..] = descriptor {
            return Some(u32::from_le_bytes([*a, *b, *c, *d])).filter(|hz| *hz > 0);
        }
        rest = after;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(flags: u8, tail: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0; 10];
        bytes.extend([2 + tail.len() as u8, flags]);
        bytes.extend(tail);
        bytes
    }

    #[test]
    fn times_are_read_from_the_first_header_that_has_them() {
        let mut bytes = record(0x80, &[]);
        bytes.extend(record(0x8c, &[1, 0, 0, 0, 9, 0, 0, 0, 0xff, 0xff]));
        let times = parse(&bytes).unwrap();
        assert_eq!(times.presentation_ticks, 1);
        assert_eq!(times.source_clock, Some((9, 0x7ff)));
        assert_eq!(parse(&bytes[..20]), None);
        assert_eq!(parse(&[]), None);
    }

    #[test]
    fn the_frame_number_is_carried_back_to_the_exposure() {
        let times =
            |presentation_ticks, source_clock| HeaderTimes { presentation_ticks, source_clock };
        // Sampled 40 ms after the exposure's start, over both wraps.
        let late = times(u32::MAX - 9_999, Some((30_000, 15)));
        assert_eq!(late.presentation_sof(1_000_000), Some(2048 + 15 - 40));
        assert_eq!(times(48_000_000, Some((48_047_000, 7))).presentation_sof(48_000_000), Some(6));
        assert_eq!(times(0, Some((3_000_000, 7))).presentation_sof(1_000_000), None);
        assert_eq!(times(0, None).presentation_sof(1_000_000), None);
    }

    #[test]
    fn ticks_go_on_over_the_wrap_and_back() {
        let mut clock = TickClock::new(1_000_000_000);
        let first = clock.nanoseconds(u32::MAX - 10);
        assert_eq!(clock.nanoseconds(5) - first, 16);
        assert_eq!(clock.nanoseconds(u32::MAX), first + 10);
    }

    #[test]
    fn broken_descriptors_have_no_clock() {
        assert_eq!(clock_hz(&[9, 4, 0]), None);
        assert_eq!(clock_hz(&[0, 0, 0]), None);
        let header = [13, 0x24, 1, 0x10, 1, 50, 0, 0, 0x6c, 0xdc, 2, 1, 1];
        assert_eq!(clock_hz(&header), Some(48_000_000));
    }
}
