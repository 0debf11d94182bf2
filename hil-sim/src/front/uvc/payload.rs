//! One frame as one bulk payload: header with both clocks, then the pixels (UVC 1.1 section 2.4.3.3).

use super::Frame;

/// Rate of the camera's clock in descriptors and headers.
pub const CLOCK_HZ: u32 = 48_000_000;

/// Bytes of the header: length, flags, presentation time, source clock with USB frame number.
pub const HEADER_LENGTH: usize = 12;

/// A frame on its way to the host.
#[derive(Debug)]
pub struct Payload {
    header: [u8; HEADER_LENGTH],
    pixels: Vec<u8>,
    sent: usize,
}

impl Payload {
    /// The payload of `frame`; `toggle` changes from frame to frame, `clock` is the time of sending.
    pub fn new(frame: Frame, toggle: bool, clock: (u32, u16)) -> Self {
        const END_OF_FRAME: u8 = 1 << 1;
        const HAS_PRESENTATION_TIME: u8 = 1 << 2;
        const HAS_SOURCE_CLOCK: u8 = 1 << 3;
        const ERROR: u8 = 1 << 6;
        const END_OF_HEADER: u8 = 1 << 7;
        let mut header = [0; HEADER_LENGTH];
        header[0] = HEADER_LENGTH as u8;
        header[1] = u8::from(toggle)
            | END_OF_FRAME
            | HAS_PRESENTATION_TIME
            | HAS_SOURCE_CLOCK
            | if frame.is_damaged { ERROR } else { 0 }
            | END_OF_HEADER;
        header[2..6].copy_from_slice(&frame.exposure_ticks.to_le_bytes());
        header[6..10].copy_from_slice(&clock.0.to_le_bytes());
        header[10..12].copy_from_slice(&(clock.1 & 0x7ff).to_le_bytes());
        Self { header, pixels: frame.pixels, sent: 0 }
    }

    /// The next at most `length` bytes; empty at the end.
    pub fn take(&mut self, length: usize) -> Vec<u8> {
        let mut part = Vec::with_capacity(length);
        if self.sent < HEADER_LENGTH {
            let end = HEADER_LENGTH.min(self.sent + length);
            part.extend(&self.header[self.sent..end]);
        }
        let from = (self.sent + part.len()).max(HEADER_LENGTH) - HEADER_LENGTH;
        let end = self.pixels.len().min(from + length - part.len());
        part.extend(&self.pixels[from..end]);
        self.sent += part.len();
        part
    }
}
