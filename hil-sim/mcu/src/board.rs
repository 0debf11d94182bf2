//! What the sensor's board connects to the chip's pins. The firmware's own pin map is in
//! `firmware/app/src/board`; a test holds the two against each other by driving the real binary.

use stspp_hil_sim::device::Line;

use crate::soc::Variant;
use crate::soc::pins::Pin;

/// Thermistor at the projectors: 10 kOhm at 25 degrees, to ground, under a 10 kOhm pull-up.
const NTC_OHM_25: f64 = 10_000.0;
const NTC_BETA_K: f64 = 3_435.0;
const NTC_PULL_UP_OHM: f64 = 10_000.0;

/// A board.
#[derive(Debug, Clone, Copy)]
pub struct Board {
    /// Gates of projectors 0..=9, active high.
    pub projectors: [Pin; 10],
    /// Gate of the floodlight, active high.
    pub floodlight: Pin,
    /// Triggers of camera 0 and 1.
    pub camera_triggers: [Pin; 2],
    /// Interlock input.
    pub interlock: Pin,
    /// Level of the interlock input when the loop is closed.
    pub interlock_closed_level: bool,
    /// Trigger-in, from outside.
    pub trigger_in: Pin,
    /// Status LED.
    pub led: Pin,
    /// ADC channel of the thermistor.
    pub thermistor_channel: u8,
}

const fn pin(port: u8, number: u8) -> Pin {
    Pin { port, number }
}

/// Both boards route their light the same way; only the link differs.
const COMMON: Board = Board {
    projectors: [
        pin(1, 0),
        pin(1, 1),
        pin(1, 2),
        pin(1, 3),
        pin(1, 4),
        pin(1, 5),
        pin(1, 6),
        pin(1, 7),
        pin(1, 8),
        pin(1, 9),
    ],
    floodlight: pin(1, 10),
    camera_triggers: [pin(1, 12), pin(1, 13)],
    interlock: pin(0, 0),
    interlock_closed_level: true,
    trigger_in: pin(0, 1),
    led: pin(2, 13),
    thermistor_channel: 4,
};

impl Board {
    /// The board that carries this chip.
    #[must_use]
    pub const fn of(_variant: Variant) -> Self {
        COMMON
    }

    /// What an output pin is.
    #[must_use]
    pub fn line_of(&self, pin: Pin) -> Option<Line> {
        if let Some(index) = self.projectors.iter().position(|p| *p == pin) {
            return Some(Line::Projector(index as u8));
        }
        if let Some(index) = self.camera_triggers.iter().position(|p| *p == pin) {
            return Some(Line::CameraTrigger(index as u8));
        }
        (pin == self.floodlight).then_some(Line::Floodlight)
    }
}

/// Voltage at the thermistor's divider.
#[must_use]
pub fn thermistor_volts(temperature_c: f32) -> f32 {
    let kelvin = f64::from(temperature_c) + 273.15;
    let ohm = NTC_OHM_25 * (NTC_BETA_K * (1.0 / kelvin - 1.0 / 298.15)).exp();
    (f64::from(crate::soc::adc::VDDA_V) * ohm / (ohm + NTC_PULL_UP_OHM)) as f32
}
