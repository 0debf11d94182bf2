//! Small units: power management, clock trim, CRC, debug.

use super::peripheral::{Cx, Peripheral, TimerId};

/// Power management (user manual chapter 3): registers without an effect in this model, except the
/// high-driver handshake that precedes the highest clocks.
#[derive(Debug, Default)]
pub struct Pmu {
    ctl: u32,
}

impl Peripheral for Pmu {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.ctl,
            // LDO output ready; high-driver ready and switched as asked.
            0x04 => 1 << 15 | (self.ctl >> 16 & 3) << 16,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, _cx: &mut Cx<'_>) {
        if offset == 0 {
            self.ctl = value;
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            // Core voltage, high driver, backup write enable.
            0x00 => Some(0x0003_c100),
            0x04 => Some(0),
            _ => None,
        }
    }
}

/// Clock trim controller (user manual chapter 5): the trim follows the reference at once.
#[derive(Debug)]
pub struct Ctc {
    ctl: [u32; 2],
}

impl Default for Ctc {
    fn default() -> Self {
        Self { ctl: [0x2000, 0x2022_bb7f] }
    }
}

impl Peripheral for Ctc {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 | 0x04 => self.ctl[offset as usize / 4],
            // CKOK while the counter runs.
            0x08 => self.ctl[0] >> 5 & 1,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, _cx: &mut Cx<'_>) {
        if offset <= 4 {
            self.ctl[offset as usize / 4] = value;
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            // Trimming on, automatic; its interrupts are not.
            0x00 => Some(0x3f60),
            0x04 => Some(0xb7ff_ffff),
            0x08 => Some(0),
            0x0c => Some(0xf),
            _ => None,
        }
    }
}

/// CRC unit (user manual chapter 10): 32-bit, polynomial 0x04c11db7, no reversal.
#[derive(Debug)]
pub struct Crc {
    data: u32,
    free: u32,
}

impl Default for Crc {
    fn default() -> Self {
        Self { data: u32::MAX, free: 0 }
    }
}

impl Peripheral for Crc {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.data,
            0x04 => self.free,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, _cx: &mut Cx<'_>) {
        match offset {
            0x00 => {
                self.data = (0..32).rev().fold(self.data, |crc, bit| {
                    let top = (crc >> 31) ^ (value >> bit & 1);
                    crc << 1 ^ if top != 0 { 0x04c1_1db7 } else { 0 }
                });
            }
            0x04 => self.free = value & 0xff,
            0x08 if value & 1 != 0 => self.data = u32::MAX,
            _ => {}
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            0x00 => Some(u32::MAX),
            0x04 => Some(0xff),
            0x08 => Some(1),
            _ => None,
        }
    }
}

/// Debug unit (user manual chapter 8): what is held while a debugger halts the core. Its registers
/// outlive every reset but a power-on.
#[derive(Debug, Default)]
pub struct Dbg {
    ctl: [u32; 2],
}

impl Dbg {
    /// Whether the watchdog is held at a halt.
    #[must_use]
    pub fn holds_watchdog(&self) -> bool {
        self.ctl[0] >> 8 & 1 != 0
    }

    /// Whether a timer is held at a halt.
    #[must_use]
    pub fn holds(&self, timer: TimerId) -> bool {
        let (word, bit) = match timer {
            TimerId::T0 => (0, 10),
            TimerId::T1 => (0, 11),
            TimerId::T2 => (0, 12),
            TimerId::T13 => (0, 27),
            TimerId::T14 => (1, 16),
            TimerId::T15 => (1, 17),
            TimerId::T16 => (1, 18),
        };
        self.ctl[word] >> bit & 1 != 0
    }
}

impl Peripheral for Dbg {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => 0x1704_0410,
            0x04 | 0x08 => self.ctl[offset as usize / 4 - 1],
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, _cx: &mut Cx<'_>) {
        if offset == 4 || offset == 8 {
            self.ctl[offset as usize / 4 - 1] = value;
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            0x00 => Some(0),
            // Sleep modes and peripherals without a model make no difference.
            0x04 => Some(0x0800_1f07),
            0x08 => Some(0x0007_0000),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clocks;

    #[test]
    fn the_crc_unit_computes_the_mpeg_2_crc() {
        let clocks = Clocks::after_reset();
        let mut out = Vec::new();
        let mut cx = Cx { now: 0, clocks: &clocks, out: &mut out };
        let mut crc = Crc::default();
        for word in [0x3132_3334, 0x3536_3738] {
            crc.write(0, word, &mut cx);
        }
        // CRC-32/MPEG-2 of "12345678".
        let reference = b"12345678".iter().fold(u32::MAX, |crc, byte| {
            (0..8).fold(crc ^ u32::from(*byte) << 24, |c, _| {
                c << 1 ^ if c >> 31 != 0 { 0x04c1_1db7 } else { 0 }
            })
        });
        assert_eq!(crc.read(0, &mut cx), reference);
    }
}
