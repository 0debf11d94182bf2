//! From ports and timers to pins, and from pins to inputs.

use super::Soc;
use super::gpio::PinMode;
use super::peripheral::{PeripheralId, TimerId};
use super::pins::{Alternate, Level, Pin, PinChange, alternate};

impl Soc {
    /// Drives an input pin from outside at `now`, or lets go of it.
    pub fn drive_pin(&mut self, pin: Pin, level: Option<bool>, now: u64) {
        self.advance(now);
        self.gpio[usize::from(pin.port)].drive_external(pin.number, level);
        self.sense(pin, now);
        self.route(now);
        self.publish();
    }

    /// Works out the levels of a port's pins after a change of its registers.
    pub(super) fn refresh_port(&mut self, port: u8, now: u64) {
        for number in 0..16 {
            let pin = Pin { port, number };
            self.refresh_pin(pin, now);
            self.sense(pin, now);
        }
    }

    /// Works out the levels of the pins that show a timer's output.
    pub(super) fn refresh_timer_pins(&mut self, timer: TimerId, output: u8, now: u64) {
        for port in 0..6 {
            for number in 0..16 {
                let pin = Pin { port, number };
                if let PinMode::Alternate(af) = self.gpio[usize::from(port)].mode(number)
                    && alternate(pin, af) == Some(Alternate::TimerChannel(timer, output))
                {
                    self.refresh_pin(pin, now);
                }
            }
        }
    }

    fn refresh_pin(&mut self, pin: Pin, now: u64) {
        let port = &self.gpio[usize::from(pin.port)];
        let driven = match port.mode(pin.number) {
            PinMode::Output => port.driven(pin.number),
            PinMode::Alternate(af) => match alternate(pin, af) {
                Some(Alternate::TimerChannel(timer, output)) => {
                    let level = self.timer_outputs[timer.index()][usize::from(output)];
                    level.filter(|high| !(*high && port.open_drain(pin.number)))
                }
                Some(Alternate::UsartTx(_)) => Some(true),
                _ => None,
            },
            PinMode::Input | PinMode::Analog => None,
        };
        if let PinMode::Alternate(af) = port.mode(pin.number)
            && alternate(pin, af).is_none()
        {
            self.log.note(now, format!("{pin} set to alternate function {af}: not modelled"));
        }
        let level = match driven {
            None => Level::Floating,
            Some(false) => Level::Low,
            Some(true) => Level::High,
        };
        let before = &mut self.pin_levels[usize::from(pin.port)][usize::from(pin.number)];
        if *before != level {
            *before = level;
            let time_ns = self.clocks.ns_at(now);
            self.pin_changes.push(PinChange { cycle: now, time_ns, pin, level });
        }
    }

    /// Passes a pin's level to the inputs behind it.
    fn sense(&mut self, pin: Pin, now: u64) {
        let port = &self.gpio[usize::from(pin.port)];
        let high = port.input(pin.number);
        let mode = port.mode(pin.number);
        if self.syscfg.exti_port(pin.number) == pin.port {
            self.with(now, |soc, cx| soc.exti.set_level(pin.number, high, cx));
        }
        if let PinMode::Alternate(af) = mode {
            match alternate(pin, af) {
                Some(Alternate::TimerBreak(timer)) => {
                    self.with(now, |soc, cx| soc.timers[timer.index()].set_break_input(high, cx));
                }
                Some(Alternate::TimerChannel(timer, channel)) if channel < 4 => {
                    // The pin is an input only where the channel is one; the timer knows.
                    self.with(now, |soc, cx| {
                        soc.timers[timer.index()].channel_input(channel, high, cx)
                    });
                }
                _ => {}
            }
        }
    }

    /// Whether a USART's receive wire is connected to a pin, and likewise its transmit wire.
    #[must_use]
    pub fn usart_wired(&self, usart: u8) -> bool {
        let wired = |wanted: Alternate| {
            (0..6u8).flat_map(|port| (0..16u8).map(move |number| Pin { port, number })).any(|pin| {
                matches!(self.gpio[usize::from(pin.port)].mode(pin.number),
                    PinMode::Alternate(af) if alternate(pin, af) == Some(wanted))
            })
        };
        wired(Alternate::UsartRx(usart))
            && wired(Alternate::UsartTx(usart))
            && self.rcu.clock_gate(PeripheralId::Usart(usart)).0
    }
}
