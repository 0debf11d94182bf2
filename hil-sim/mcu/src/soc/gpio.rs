//! General purpose ports (user manual chapter 7), seen from the pins: what a pin is driven to by its
//! port, by an alternate function, or by nothing.

use super::peripheral::{Cx, Peripheral, Signal};

/// What a pin is connected to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PinMode {
    /// Digital input.
    Input,
    /// Push-pull or open-drain output of the port's register.
    Output,
    /// Alternate function with this number.
    Alternate(u8),
    /// Analog, or floating.
    Analog,
}

/// One port.
#[derive(Debug)]
pub struct Gpio {
    index: u8,
    ctl: u32,
    omode: u32,
    ospd: [u32; 2],
    pud: u32,
    octl: u32,
    afsel: [u32; 2],
    /// Pins whose configuration is locked until reset.
    locked: u32,
    lock_step: u8,
    lock_mask: u32,
    /// Levels that the world outside drives: `None` leaves the pin to its pull resistor.
    external: [Option<bool>; 16],
}

impl Gpio {
    /// Port A=0, B=1, C=2, D=3, F=5 after reset.
    #[must_use]
    pub fn new(index: u8) -> Self {
        // SWDIO and SWCLK are alternate functions with pulls after reset (PA13, PA14).
        let (ctl, ospd, pud) =
            if index == 0 { (0x2800_0000, 0x0c00_0000, 0x2400_0000) } else { (0, 0, 0) };
        Self {
            index,
            ctl,
            omode: 0,
            ospd: [ospd, 0],
            pud,
            octl: 0,
            afsel: [0; 2],
            locked: 0,
            lock_step: 0,
            lock_mask: 0,
            external: [None; 16],
        }
    }

    /// Takes over what is connected outside from the model before a reset.
    #[must_use]
    pub fn wired_as(mut self, before: &Gpio) -> Self {
        self.external = before.external;
        self
    }

    /// Position of the port in the address map.
    #[must_use]
    pub fn index(&self) -> u8 {
        self.index
    }

    /// What pin `pin` is connected to.
    #[must_use]
    pub fn mode(&self, pin: u8) -> PinMode {
        match self.ctl >> (2 * pin) & 3 {
            0 => PinMode::Input,
            1 => PinMode::Output,
            2 => PinMode::Alternate(
                (self.afsel[usize::from(pin >> 3)] >> (4 * (pin & 7)) & 0xf) as u8,
            ),
            _ => PinMode::Analog,
        }
    }

    /// Level that the port's own register drives on `pin`: `None` where it drives none.
    #[must_use]
    pub fn driven(&self, pin: u8) -> Option<bool> {
        let high = self.octl >> pin & 1 != 0;
        (self.mode(pin) == PinMode::Output && !(high && self.open_drain(pin))).then_some(high)
    }

    /// Whether the output stage of `pin` only pulls low.
    #[must_use]
    pub fn open_drain(&self, pin: u8) -> bool {
        self.omode >> pin & 1 != 0
    }

    /// Level that the pin's input stage reads.
    #[must_use]
    pub fn input(&self, pin: u8) -> bool {
        match self.mode(pin) {
            PinMode::Analog => false,
            _ => self
                .driven(pin)
                .or(self.external[usize::from(pin)])
                .unwrap_or(self.pud >> (2 * pin) & 3 == 1),
        }
    }

    /// Connects an outside level to a pin, or lets go of it.
    pub fn drive_external(&mut self, pin: u8, level: Option<bool>) {
        self.external[usize::from(pin)] = level;
    }

    /// Keeps the locked pins' fields of a register with `width` bits a pin.
    fn guarded(&self, old: u32, new: u32, width: u32) -> u32 {
        let mut mask = 0u32;
        for pin in 0..32 / width {
            if self.locked >> pin & 1 != 0 {
                mask |= ((1 << width) - 1) << (pin * width);
            }
        }
        old & mask | new & !mask
    }

    fn guarded_af(&self, half: usize, new: u32) -> u32 {
        let mut mask = 0u32;
        for pin in 0..8 {
            if self.locked >> (pin + 8 * half as u32) & 1 != 0 {
                mask |= 0xf << (4 * pin);
            }
        }
        self.afsel[half] & mask | new & !mask
    }

    /// The lock sequence of the user manual: key+mask, mask, key+mask, then a read.
    fn write_lock(&mut self, value: u32) {
        let key = value >> 16 & 1 != 0;
        let mask = value & 0xffff;
        self.lock_step = match (self.lock_step, key) {
            (0, true) => {
                self.lock_mask = mask;
                1
            }
            (1, false) if mask == self.lock_mask => 2,
            (2, true) if mask == self.lock_mask => 3,
            _ => 0,
        };
    }
}

impl Peripheral for Gpio {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.ctl,
            0x04 => self.omode,
            0x08 => self.ospd[0],
            0x0c => self.pud,
            0x10 => (0..16).fold(0, |word, pin| word | u32::from(self.input(pin)) << pin),
            0x14 => self.octl,
            0x1c => {
                if self.lock_step == 3 && self.locked == 0 {
                    self.locked = self.lock_mask;
                }
                if self.locked == 0 { self.lock_mask } else { self.locked | 1 << 16 }
            }
            0x20 => self.afsel[0],
            0x24 => self.afsel[1],
            0x3c => self.ospd[1],
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        match offset {
            0x00 => self.ctl = self.guarded(self.ctl, value, 2),
            0x04 => self.omode = self.guarded(self.omode, value & 0xffff, 1),
            0x08 => self.ospd[0] = self.guarded(self.ospd[0], value, 2),
            0x0c => self.pud = self.guarded(self.pud, value, 2),
            0x14 => self.octl = value & 0xffff,
            // Bit set wins over bit clear (user manual 7.4).
            0x18 => self.octl = self.octl & !(value >> 16) | value & 0xffff,
            0x1c if self.locked == 0 => self.write_lock(value),
            0x20 => self.afsel[0] = self.guarded_af(0, value),
            0x24 => self.afsel[1] = self.guarded_af(1, value),
            0x28 => self.octl &= !value,
            0x2c => self.octl ^= value & 0xffff,
            0x3c => self.ospd[1] = value & 0xffff,
            _ => return,
        }
        cx.out.push(Signal::PortChanged(self.index));
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            0x00 | 0x0c | 0x18 | 0x20 | 0x24 => Some(u32::MAX),
            // Slew rates have no meaning here.
            0x08 => Some(u32::MAX),
            0x04 | 0x14 | 0x28 | 0x2c | 0x3c => Some(0xffff),
            0x10 => Some(0),
            0x1c => Some(0x1_ffff),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clocks;

    fn write(port: &mut Gpio, offset: u32, value: u32) {
        let clocks = Clocks::after_reset();
        port.write(offset, value, &mut Cx { now: 0, clocks: &clocks, out: &mut Vec::new() });
    }

    #[test]
    fn bop_sets_and_clears_at_once_and_set_wins() {
        let mut port = Gpio::new(1);
        write(&mut port, 0x00, 0x5555_5555);
        write(&mut port, 0x18, 0x0000_00f0);
        write(&mut port, 0x18, 0x00f0_0030);
        assert_eq!((0..8).filter(|&p| port.driven(p) == Some(true)).collect::<Vec<_>>(), [4, 5]);
    }

    #[test]
    fn a_locked_pin_keeps_its_mode() {
        let mut port = Gpio::new(1);
        write(&mut port, 0x00, 0x1);
        for value in [0x1_0001, 0x0_0001, 0x1_0001] {
            write(&mut port, 0x1c, value);
        }
        let clocks = Clocks::after_reset();
        let lock = port.read(0x1c, &mut Cx { now: 0, clocks: &clocks, out: &mut Vec::new() });
        assert_eq!(lock, 0x1_0001);
        write(&mut port, 0x00, 0xf);
        assert_eq!((port.mode(0), port.mode(1)), (PinMode::Output, PinMode::Analog));
    }
}
