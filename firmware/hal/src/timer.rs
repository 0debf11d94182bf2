//! PWM on the 16-bit timers (user manual, chapters "Advanced timer" to "General level4 timer":
//! "Channel output compare function").
//!
//! TIMER1 is not here: it is the time driver's and [`crate::sequence`]'s.

use crate::Peri;
use crate::calc::timing;
use crate::gpio::{self, Pin, Pull, Speed};
use crate::regs::{self, RegExt};
use core::convert::Infallible;
use core::marker::PhantomData;
use embassy_hal_internal::PeripheralType;

mod sealed {
    pub trait Instance {
        const NUMBER: u8;
        /// Outputs go through the main output enable (POEN in TIMERx_CCHP).
        const HAS_BREAK: bool;
        fn enable_clock();
    }
}

/// A timer with PWM outputs.
pub trait Instance: PeripheralType + sealed::Instance + 'static {}

macro_rules! timers {
    ($($name:ident = $number:literal, $break:literal, $enable:ident, $bit:ident;)*) => {
        $(
            impl sealed::Instance for crate::peripherals::$name {
                const NUMBER: u8 = $number;
                const HAS_BREAK: bool = $break;
                fn enable_clock() {
                    regs::rcu().$enable.modify(|_, w| w.$bit().set_bit());
                }
            }
            impl Instance for crate::peripherals::$name {}
        )*
    };
}
timers! {
    TIMER0 = 0, true, apb2en, timer0en;
    TIMER2 = 2, false, apb1en, timer2en;
    TIMER13 = 13, false, apb1en, timer13en;
    TIMER14 = 14, true, apb2en, timer14en;
    TIMER15 = 15, true, apb2en, timer15en;
    TIMER16 = 16, true, apb2en, timer16en;
}

/// A pin that carries channel `CHANNEL` of timer `T`.
pub trait OutputPin<T, const CHANNEL: u8>: Pin {
    /// Alternate function number.
    const FUNCTION: u8;
}

macro_rules! outputs {
    ($($pin:ident: $timer:ident channel $channel:literal = AF $function:literal;)*) => {
        $(
            impl OutputPin<crate::peripherals::$timer, $channel> for crate::peripherals::$pin {
                const FUNCTION: u8 = $function;
            }
        )*
    };
}
// Data sheet, "Port A/B/C alternate functions summary".
outputs! {
    PA8: TIMER0 channel 0 = AF 2; PA9: TIMER0 channel 1 = AF 2; PA10: TIMER0 channel 2 = AF 2;
    PA11: TIMER0 channel 3 = AF 2; PA6: TIMER2 channel 0 = AF 1; PA7: TIMER2 channel 1 = AF 1;
    PB0: TIMER2 channel 2 = AF 1; PB1: TIMER2 channel 3 = AF 1; PB4: TIMER2 channel 0 = AF 1;
    PB5: TIMER2 channel 1 = AF 1; PA2: TIMER14 channel 0 = AF 0; PA3: TIMER14 channel 1 = AF 0;
    PB14: TIMER14 channel 0 = AF 1; PB15: TIMER14 channel 1 = AF 1; PB8: TIMER15 channel 0 = AF 2;
    PB9: TIMER16 channel 0 = AF 2;
}

/// One PWM output.
pub struct Pwm<'d, T: Instance, const CHANNEL: u8> {
    reload: u16,
    _timer: Peri<'d, T>,
    _pin: PhantomData<&'d ()>,
}

impl<'d, T: Instance, const CHANNEL: u8> Pwm<'d, T, CHANNEL> {
    /// Starts the timer at `frequency_hz` with the output low.
    ///
    /// # Panics
    /// When the timer cannot make the frequency.
    pub fn new<P: OutputPin<T, CHANNEL>>(
        timer: Peri<'d, T>,
        pin: Peri<'d, P>,
        frequency_hz: u32,
    ) -> Self {
        T::enable_clock();
        let Some((prescaler, reload)) = timing::pwm(crate::rcu::clocks().timer_hz, frequency_hz)
        else {
            panic!("no PWM setting for the frequency")
        };
        let block = regs::timer(T::NUMBER);
        block.psc.set(u32::from(prescaler));
        block.car.set(u32::from(reload));
        // PWM mode 0 with a shadowed compare value (CHxCOMCTL = 110, CHxCOMSEN); two channels a
        // register.
        let shift = 8 * u32::from(CHANNEL % 2);
        let mode = (0b110 << 4 | 1 << 3) << shift;
        let chctl = Self::chctl();
        chctl.update(|bits| bits & !(0xff << shift) | mode);
        block.chctl2.update(|bits| bits | 1 << (4 * CHANNEL));
        if <T as sealed::Instance>::HAS_BREAK {
            block.cchp.update(|bits| bits | 1 << 15);
        }
        block.swevg.write(|w| w.upg().set_bit());
        block.ctl0.modify(|_, w| w.cen().set_bit());
        gpio::set_alternate(&*pin, P::FUNCTION, Pull::None, Speed::Medium);
        Self { reload, _timer: timer, _pin: PhantomData }
    }

    fn chctl() -> &'static crate::pac::generic::Reg<crate::pac::timer0::ctl0::CTL0_SPEC> {
        regs::timer_chctl(T::NUMBER, CHANNEL / 2)
    }
}

impl<T: Instance, const CHANNEL: u8> embedded_hal::pwm::ErrorType for Pwm<'_, T, CHANNEL> {
    type Error = Infallible;
}

impl<T: Instance, const CHANNEL: u8> embedded_hal::pwm::SetDutyCycle for Pwm<'_, T, CHANNEL> {
    fn max_duty_cycle(&self) -> u16 {
        self.reload.saturating_add(1)
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        let block = regs::timer(T::NUMBER);
        let duty = u32::from(duty);
        match CHANNEL {
            0 => block.ch0cv.set(duty),
            1 => block.ch1cv.set(duty),
            2 => block.ch2cv.set(duty),
            _ => block.ch3cv.set(duty),
        }
        Ok(())
    }
}
