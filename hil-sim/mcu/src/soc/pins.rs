//! Pins: alternate functions and what a pin shows to the world.

use super::peripheral::TimerId;

/// A pin by port (A=0, B=1, C=2, D=3, F=5) and number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Pin {
    /// Port index.
    pub port: u8,
    /// Pin number in the port.
    pub number: u8,
}

impl Pin {
    /// The pin with a name like `PA3`.
    #[must_use]
    pub fn named(name: &str) -> Option<Pin> {
        let port = match name.as_bytes().get(1)? {
            letter @ b'A'..=b'F' if name.starts_with('P') => letter - b'A',
            _ => return None,
        };
        let number = name.get(2..)?.parse().ok()?;
        (number < 16).then_some(Pin { port, number })
    }
}

impl std::fmt::Display for Pin {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "P{}{}", (b'A' + self.port) as char, self.number)
    }
}

/// What the chip does to a pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Level {
    /// Nothing: an input, or a disabled output. A gate's pull-down resistor keeps it off.
    Floating,
    /// Driven low.
    Low,
    /// Driven high.
    High,
}

/// A change of what the chip does to a pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PinChange {
    /// HCLK cycle.
    pub cycle: u64,
    /// Nanoseconds since power-on.
    pub time_ns: u64,
    /// Which pin.
    pub pin: Pin,
    /// The level from then on.
    pub level: Level,
}

/// An alternate function with a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alternate {
    /// Output 0..=3 (channels) or 4..=6 (complements) of a timer; channels are also inputs.
    TimerChannel(TimerId, u8),
    /// Break input of a timer.
    TimerBreak(TimerId),
    /// Transmit wire of a USART.
    UsartTx(u8),
    /// Receive wire of a USART.
    UsartRx(u8),
    /// Serial wire debug.
    Debug,
}

/// Alternate function `af` of a pin (datasheet, "alternate functions summary"); `None` where the
/// pin has none of that number, or none with a model.
#[must_use]
pub fn alternate(pin: Pin, af: u8) -> Option<Alternate> {
    use Alternate::{Debug, TimerBreak, TimerChannel, UsartRx, UsartTx};
    use TimerId::{T0, T1, T2, T13, T14, T15, T16};
    Some(match (pin.port, pin.number, af) {
        (0, 0 | 5 | 15, 2) => TimerChannel(T1, 0),
        (0, 1, 2) | (1, 3, 2) => TimerChannel(T1, 1),
        (0, 2, 2) | (1, 10, 2) => TimerChannel(T1, 2),
        (0, 3, 2) | (1, 11, 2) => TimerChannel(T1, 3),
        (0, 6, 1) | (1, 4, 1) | (2, 6, 0) => TimerChannel(T2, 0),
        (0, 7, 1) | (1, 5, 1) | (2, 7, 0) => TimerChannel(T2, 1),
        (1, 0, 1) | (2, 8, 0) => TimerChannel(T2, 2),
        (1, 1, 1) | (2, 9, 0) => TimerChannel(T2, 3),
        (0, 8, 2) => TimerChannel(T0, 0),
        (0, 9, 2) => TimerChannel(T0, 1),
        (0, 10, 2) => TimerChannel(T0, 2),
        (0, 11, 2) => TimerChannel(T0, 3),
        (0, 7, 2) | (1, 13, 2) => TimerChannel(T0, 4),
        (1, 0 | 14, 2) => TimerChannel(T0, 5),
        (1, 1 | 15, 2) => TimerChannel(T0, 6),
        (0, 6, 2) | (1, 12, 2) => TimerBreak(T0),
        (0, 4 | 7, 4) | (1, 1, 0) => TimerChannel(T13, 0),
        (0, 2, 0) | (1, 14, 1) => TimerChannel(T14, 0),
        (0, 3, 0) | (1, 15, 1) => TimerChannel(T14, 1),
        (1, 15, 3) => TimerChannel(T14, 4),
        (0, 9, 0) => TimerBreak(T14),
        (0, 6, 5) | (1, 8, 2) => TimerChannel(T15, 0),
        (1, 6, 2) => TimerChannel(T15, 4),
        (1, 5, 2) => TimerBreak(T15),
        (0, 7, 5) | (1, 9, 2) => TimerChannel(T16, 0),
        (1, 7, 2) => TimerChannel(T16, 4),
        (0, 10, 0) => TimerBreak(T16),
        (0, 9, 1) | (1, 6, 0) => UsartTx(0),
        (0, 10, 1) | (1, 7, 0) => UsartRx(0),
        (0, 2 | 14, 1) => UsartTx(1),
        (0, 3 | 15, 1) => UsartRx(1),
        (0, 13 | 14, 0) => Debug,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pins_are_read_by_name() {
        assert_eq!(Pin::named("PB12"), Some(Pin { port: 1, number: 12 }));
        assert_eq!(Pin::named("PF7").unwrap().to_string(), "PF7");
        assert_eq!(Pin::named("PB16"), None);
        assert_eq!(Pin::named("X1"), None);
    }
}
