//! Settings of the camera: stream negotiation, exposure time, gain (UVC 1.1 section 4).

use super::Settings;
use super::descriptors::{
    CAMERA_TERMINAL, CONTROL_INTERFACE, Description, PROCESSING_UNIT, STREAM_INTERFACE,
};
use super::payload::CLOCK_HZ;
use crate::front::usb::Setup;

const SET_CUR: u8 = 0x01;
const GET_CUR: u8 = 0x81;
const GET_MIN: u8 = 0x82;
const GET_MAX: u8 = 0x83;
const GET_RES: u8 = 0x84;
const GET_LEN: u8 = 0x85;
const GET_INFO: u8 = 0x86;
const GET_DEF: u8 = 0x87;

const STREAM_PROBE: u8 = 1;
const STREAM_COMMIT: u8 = 2;
const STREAM_LENGTH: usize = 34;

/// What came of a class request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// These bytes go to the host, if any.
    Answer(Vec<u8>),
    /// The host has committed the stream's parameters: pictures flow from now on.
    Committed,
}

/// One numeric setting.
#[derive(Debug, Clone)]
struct Number {
    unit: u8,
    selector: u8,
    bytes: usize,
    min: u32,
    max: u32,
    step: u32,
    default: u32,
    now: u32,
}

/// All settings.
#[derive(Debug, Clone)]
pub struct Controls {
    auto_exposure_mode: Number,
    exposure_100us: Number,
    gain_percent: Number,
    interval_100ns: u32,
    frame_bytes: u32,
    payload_bytes: u32,
}

impl Controls {
    /// Defaults: manual exposure up to 100 ms (the trigger ends it), gain 1.
    pub fn new(description: &Description) -> Self {
        let number = |unit, selector, bytes, [min, max, step, default]: [u32; 4]| Number {
            unit,
            selector,
            bytes,
            min,
            max,
            step,
            default,
            now: default,
        };
        Self {
            // Bit 0 is manual, the only mode; GET_RES answers with the modes there are.
            auto_exposure_mode: number(CAMERA_TERMINAL, 2, 1, [1, 1, 1, 1]),
            exposure_100us: number(CAMERA_TERMINAL, 4, 4, [1, 1000, 1, 1000]),
            gain_percent: number(PROCESSING_UNIT, 4, 2, [100, 800, 1, 100]),
            interval_100ns: description.interval_100ns,
            frame_bytes: description.frame_bytes(),
            payload_bytes: description.payload_bytes(),
        }
    }

    /// What the settings mean for the picture.
    pub fn settings(&self) -> Settings {
        Settings { exposure_us: self.exposure_100us.now * 100, gain_percent: self.gain_percent.now }
    }

    /// Handles a class request; `None` is a stall.
    pub fn request(&mut self, setup: Setup, data: &[u8]) -> Option<Outcome> {
        let [interface, unit] = setup.index.to_le_bytes();
        let selector = setup.value.to_be_bytes()[0];
        match (interface, unit) {
            (STREAM_INTERFACE, 0) => self.negotiate(setup.request, selector, data),
            (CONTROL_INTERFACE, _) => {
                let numbers = [
                    &mut self.auto_exposure_mode,
                    &mut self.exposure_100us,
                    &mut self.gain_percent,
                ];
                let number =
                    numbers.into_iter().find(|n| n.unit == unit && n.selector == selector)?;
                number.request(setup.request, data).map(Outcome::Answer)
            }
            _ => None,
        }
    }

    fn negotiate(&mut self, request: u8, selector: u8, data: &[u8]) -> Option<Outcome> {
        if !matches!(selector, STREAM_PROBE | STREAM_COMMIT) {
            return None;
        }
        match request {
            GET_CUR | GET_MIN | GET_MAX | GET_DEF => Some(Outcome::Answer(self.stream())),
            GET_LEN => Some(Outcome::Answer((STREAM_LENGTH as u16).to_le_bytes().to_vec())),
            GET_INFO => Some(Outcome::Answer(vec![3])),
            // There is one format, one size and one rate: whatever is asked for, this is the offer.
            SET_CUR if data.len() >= 26 => Some(if selector == STREAM_COMMIT {
                Outcome::Committed
            } else {
                Outcome::Answer(vec![])
            }),
            _ => None,
        }
    }

    /// The video probe and commit controls (UVC 1.1 table 4-47).
    fn stream(&self) -> Vec<u8> {
        let mut bytes = vec![1, 0, 1, 1];
        bytes.extend(self.interval_100ns.to_le_bytes());
        bytes.extend([0; 10]);
        bytes.extend(self.frame_bytes.to_le_bytes());
        bytes.extend(self.payload_bytes.to_le_bytes());
        bytes.extend(CLOCK_HZ.to_le_bytes());
        bytes.extend([0; STREAM_LENGTH - 30]);
        bytes
    }
}

impl Number {
    fn request(&mut self, request: u8, data: &[u8]) -> Option<Vec<u8>> {
        let value = match request {
            GET_CUR => self.now,
            GET_MIN => self.min,
            GET_MAX => self.max,
            GET_RES => self.step,
            GET_DEF => self.default,
            GET_LEN => return Some((self.bytes as u16).to_le_bytes().to_vec()),
            GET_INFO => return Some(vec![3]),
            SET_CUR => {
                let mut bytes = [0; 4];
                bytes[..self.bytes].copy_from_slice(data.get(..self.bytes)?);
                let wanted = u32::from_le_bytes(bytes);
                if !(self.min..=self.max).contains(&wanted) {
                    return None;
                }
                self.now = wanted;
                return Some(vec![]);
            }
            _ => return None,
        };
        Some(value.to_le_bytes()[..self.bytes].to_vec())
    }
}
