//! Ports and pins (user manual, "General-purpose and alternate-function I/Os (GPIO and AFIO)").
//!
//! [`Flex`] is the pin driver; [`Input`] and [`Output`] are thin faces of it. Dropping a driver
//! leaves its pin a floating input, the reset state.

use crate::regs::{self, RegExt};
use core::convert::Infallible;
use embassy_hal_internal::{Peri, PeripheralType};

/// A digital level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Level {
    /// Ground.
    Low,
    /// Supply.
    High,
}

impl From<bool> for Level {
    fn from(high: bool) -> Self {
        if high { Self::High } else { Self::Low }
    }
}

/// Pull resistor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Pull {
    /// None.
    None = 0b00,
    /// To the supply.
    Up = 0b01,
    /// To ground.
    Down = 0b10,
}

/// Slew rate (GPIOx_OSPD0).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Speed {
    /// Up to 2 MHz.
    Low = 0b00,
    /// Up to 10 MHz.
    Medium = 0b01,
    /// Up to 50 MHz.
    High = 0b11,
}

mod sealed {
    pub trait Pin {
        fn pin_port(&self) -> u8;
    }
}

/// A pin, known at compile time or not.
pub trait Pin: PeripheralType + Into<AnyPin> + sealed::Pin + 'static {
    /// Number in the port, 0..=15.
    fn number(&self) -> u8 {
        self.pin_port() & 15
    }

    /// Port: A = 0, B = 1, C = 2, D = 3, F = 5.
    fn port(&self) -> u8 {
        self.pin_port() >> 4
    }
}

/// A pin whose identity is a value.
#[derive(Debug, Clone, Copy)]
pub struct AnyPin {
    pin_port: u8,
}
// The macro implements Copy and Clone itself; AnyPin already derives them.
impl PeripheralType for AnyPin {}
impl sealed::Pin for AnyPin {
    fn pin_port(&self) -> u8 {
        self.pin_port
    }
}
impl Pin for AnyPin {}

macro_rules! pins {
    ($($name:ident = $port:literal, $number:literal;)*) => {
        $(
            impl sealed::Pin for crate::peripherals::$name {
                #[inline]
                fn pin_port(&self) -> u8 {
                    $port * 16 + $number
                }
            }
            impl Pin for crate::peripherals::$name {}
            impl From<crate::peripherals::$name> for AnyPin {
                fn from(pin: crate::peripherals::$name) -> Self {
                    Self { pin_port: sealed::Pin::pin_port(&pin) }
                }
            }
        )*
    };
}

pins! {
    PA0 = 0, 0; PA1 = 0, 1; PA2 = 0, 2; PA3 = 0, 3; PA4 = 0, 4; PA5 = 0, 5; PA6 = 0, 6; PA7 = 0, 7;
    PA8 = 0, 8; PA9 = 0, 9; PA10 = 0, 10; PA11 = 0, 11; PA12 = 0, 12; PA13 = 0, 13; PA14 = 0, 14;
    PA15 = 0, 15;
    PB0 = 1, 0; PB1 = 1, 1; PB2 = 1, 2; PB3 = 1, 3; PB4 = 1, 4; PB5 = 1, 5; PB6 = 1, 6; PB7 = 1, 7;
    PB8 = 1, 8; PB9 = 1, 9; PB10 = 1, 10; PB11 = 1, 11; PB12 = 1, 12; PB13 = 1, 13; PB14 = 1, 14;
    PB15 = 1, 15;
    PC0 = 2, 0; PC1 = 2, 1; PC2 = 2, 2; PC3 = 2, 3; PC4 = 2, 4; PC5 = 2, 5; PC6 = 2, 6; PC7 = 2, 7;
    PC8 = 2, 8; PC9 = 2, 9; PC10 = 2, 10; PC11 = 2, 11; PC12 = 2, 12; PC13 = 2, 13; PC14 = 2, 14;
    PC15 = 2, 15;
    PD2 = 3, 2; PF0 = 5, 0; PF1 = 5, 1; PF4 = 5, 4; PF5 = 5, 5; PF6 = 5, 6; PF7 = 5, 7;
}

fn field2(register: u32, pin: u8, value: u8) -> u32 {
    register & !(0b11 << (2 * pin)) | u32::from(value) << (2 * pin)
}

/// Writes a pin's mode: 0 input, 1 output, 2 alternate function, 3 analog. Not inlined: a board has
/// two dozen pins.
#[inline(never)]
fn set_mode(port: u8, pin: u8, mode: u8, pull: Pull, speed: Speed, open_drain: bool) {
    critical_section::with(|_| {
        let block = regs::gpio(port);
        block.pud.update(|bits| field2(bits, pin, pull as u8));
        block.ospd0.update(|bits| field2(bits, pin, speed as u8));
        block.omode.update(|bits| bits & !(1 << pin) | u32::from(open_drain) << pin);
        block.ctl.update(|bits| field2(bits, pin, mode));
    });
}

/// Gives a pin to a peripheral: alternate function `function` (data sheet, "Alternate functions").
pub(crate) fn set_alternate(pin: &impl Pin, function: u8, pull: Pull, speed: Speed) {
    alternate(pin.port(), pin.number(), function, pull, speed);
}

#[inline(never)]
fn alternate(port: u8, number: u8, function: u8, pull: Pull, speed: Speed) {
    critical_section::with(|_| {
        let block = regs::gpio(port);
        let shift = 4 * u32::from(number % 8);
        let change = |bits: u32| bits & !(0xf << shift) | u32::from(function) << shift;
        if number < 8 { block.afsel0.update(change) } else { block.afsel1.update(change) }
    });
    set_mode(port, number, 2, pull, speed, false);
}

/// Makes a pin an analog input.
pub(crate) fn set_analog(pin: &impl Pin) {
    set_mode(pin.port(), pin.number(), 3, Pull::None, Speed::Low, false);
}

/// A pin that can change between input and output.
pub struct Flex<'d> {
    pin: Peri<'d, AnyPin>,
}

impl<'d> Flex<'d> {
    /// Takes a pin, in whatever mode it is.
    pub fn new(pin: Peri<'d, impl Pin>) -> Self {
        Self { pin: pin.into() }
    }

    fn mask(&self) -> u32 {
        1 << self.pin.number()
    }

    /// Makes it an input.
    pub fn set_as_input(&mut self, pull: Pull) {
        set_mode(self.pin.port(), self.pin.number(), 0, pull, Speed::Low, false);
    }

    /// Makes it a push-pull output, at the level last set.
    pub fn set_as_output(&mut self, speed: Speed) {
        set_mode(self.pin.port(), self.pin.number(), 1, Pull::None, speed, false);
    }

    /// Makes it an open-drain output, at the level last set.
    pub fn set_as_open_drain(&mut self, pull: Pull, speed: Speed) {
        set_mode(self.pin.port(), self.pin.number(), 1, pull, speed, true);
    }

    /// Level at the pin.
    pub fn is_high(&self) -> bool {
        regs::gpio(self.pin.port()).istat.get() & self.mask() != 0
    }

    /// Level that the output register drives.
    pub fn is_set_high(&self) -> bool {
        regs::gpio(self.pin.port()).octl.get() & self.mask() != 0
    }

    /// Sets the output level. Atomic (GPIOx_BOP).
    pub fn set_level(&mut self, level: Level) {
        let word = if level == Level::High { self.mask() } else { self.mask() << 16 };
        regs::gpio(self.pin.port()).bop.set(word);
    }

    pub(crate) fn identity(&self) -> (u8, u8) {
        (self.pin.port(), self.pin.number())
    }
}

impl Drop for Flex<'_> {
    fn drop(&mut self) {
        self.set_as_input(Pull::None);
    }
}

/// An input.
pub struct Input<'d> {
    flex: Flex<'d>,
}

impl<'d> Input<'d> {
    /// Makes `pin` an input.
    pub fn new(pin: Peri<'d, impl Pin>, pull: Pull) -> Self {
        let mut flex = Flex::new(pin);
        flex.set_as_input(pull);
        Self { flex }
    }

    /// Whether the pin is high.
    pub fn is_high(&self) -> bool {
        self.flex.is_high()
    }

    /// Whether the pin is low.
    pub fn is_low(&self) -> bool {
        !self.flex.is_high()
    }

    pub(crate) fn identity(&self) -> (u8, u8) {
        self.flex.identity()
    }
}

/// A push-pull output.
pub struct Output<'d> {
    flex: Flex<'d>,
}

impl<'d> Output<'d> {
    /// Makes `pin` an output that starts at `level` without a glitch.
    pub fn new(pin: Peri<'d, impl Pin>, level: Level, speed: Speed) -> Self {
        let mut flex = Flex::new(pin);
        flex.set_level(level);
        flex.set_as_output(speed);
        Self { flex }
    }

    /// Drives it high.
    pub fn set_high(&mut self) {
        self.flex.set_level(Level::High);
    }

    /// Drives it low.
    pub fn set_low(&mut self) {
        self.flex.set_level(Level::Low);
    }

    /// Drives it to a level.
    pub fn set_level(&mut self, level: Level) {
        self.flex.set_level(level);
    }

    /// Drives it to the other level.
    pub fn toggle(&mut self) {
        let level = Level::from(!self.flex.is_set_high());
        self.flex.set_level(level);
    }

    /// Whether it is driven high.
    pub fn is_set_high(&self) -> bool {
        self.flex.is_set_high()
    }

    pub(crate) fn identity(&self) -> (u8, u8) {
        self.flex.identity()
    }
}

impl embedded_hal::digital::ErrorType for Input<'_> {
    type Error = Infallible;
}

impl embedded_hal::digital::InputPin for Input<'_> {
    fn is_high(&mut self) -> Result<bool, Infallible> {
        Ok(self.flex.is_high())
    }

    fn is_low(&mut self) -> Result<bool, Infallible> {
        Ok(!self.flex.is_high())
    }
}

impl embedded_hal::digital::ErrorType for Output<'_> {
    type Error = Infallible;
}

impl embedded_hal::digital::OutputPin for Output<'_> {
    fn set_low(&mut self) -> Result<(), Infallible> {
        Output::set_low(self);
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        Output::set_high(self);
        Ok(())
    }
}

impl embedded_hal::digital::StatefulOutputPin for Output<'_> {
    fn is_set_high(&mut self) -> Result<bool, Infallible> {
        Ok(Output::is_set_high(self))
    }

    fn is_set_low(&mut self) -> Result<bool, Infallible> {
        Ok(!Output::is_set_high(self))
    }
}
