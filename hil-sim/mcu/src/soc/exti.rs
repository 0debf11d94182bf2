//! External interrupts (user manual chapter 6.5), and the system configuration that selects their
//! pins and the DMA remaps (chapter 1.4).

use super::peripheral::{Cx, Peripheral, Signal};

/// Lines with a configurable edge: the sixteen pins, LVD (16) and the USB wake-up (18).
const EDGE_LINES: u32 = 0x0007_ffff;

/// The external interrupt controller.
#[derive(Debug, Default)]
pub struct Exti {
    inten: u32,
    even: u32,
    rten: u32,
    ften: u32,
    swiev: u32,
    pending: u32,
    levels: u32,
}

impl Exti {
    /// The controller after reset.
    #[must_use]
    pub fn new() -> Self {
        Self { inten: 0x0f94_0000, ..Self::default() }
    }

    /// The level at the source of `line`.
    pub fn set_level(&mut self, line: u8, high: bool, cx: &mut Cx<'_>) {
        let bit = 1 << line;
        let before = self.levels & bit != 0;
        self.levels = self.levels & !bit | if high { bit } else { 0 };
        let edge = match (before, high) {
            (false, true) => self.rten,
            (true, false) => self.ften,
            _ => 0,
        };
        if edge & bit != 0 && (self.inten | self.even) & bit != 0 {
            self.pending |= bit;
            self.raise(cx);
        }
    }

    /// Takes `level` as the line's state without an edge (its source was switched).
    pub fn preset_level(&mut self, line: u8, high: bool) {
        self.levels = self.levels & !(1 << line) | u32::from(high) << line;
    }

    fn raise(&self, cx: &mut Cx<'_>) {
        let active = self.pending & self.inten;
        for (irq, mask) in [(5, 0x3), (6, 0xc), (7, 0xfff0), (1, 1 << 16), (42, 1 << 18)] {
            cx.out.push(Signal::Irq(irq, active & mask != 0));
        }
    }
}

impl Peripheral for Exti {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.inten,
            0x04 => self.even,
            0x08 => self.rten,
            0x0c => self.ften,
            0x10 => self.swiev,
            0x14 => self.pending,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        match offset {
            0x00 => self.inten = value,
            0x04 => self.even = value,
            0x08 => self.rten = value & EDGE_LINES,
            0x0c => self.ften = value & EDGE_LINES,
            0x10 => {
                self.pending |= value & !self.swiev & self.inten & EDGE_LINES;
                self.swiev = value & EDGE_LINES;
            }
            0x14 => {
                self.pending &= !value;
                self.swiev &= !value;
            }
            _ => return,
        }
        self.raise(cx);
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        // Lines 17 and 19..=27 (RTC, comparators, wake-ups) have no source here.
        const SOURCES: u32 = 0x0005_ffff;
        match offset {
            0x00 | 0x08 | 0x0c | 0x10 => Some(SOURCES),
            // Events would wake the core from WFE without an interrupt.
            0x04 => Some(0),
            0x14 => Some(u32::MAX),
            _ => None,
        }
    }
}

/// System configuration.
#[derive(Debug, Default)]
pub struct Syscfg {
    cfg0: u32,
    cfg2: u32,
    extiss: [u32; 4],
}

impl Syscfg {
    /// The port (A=0, B=1, ...) that feeds EXTI line `line`.
    #[must_use]
    pub fn exti_port(&self, line: u8) -> u8 {
        (self.extiss[usize::from(line >> 2)] >> (4 * (line & 3)) & 0xf) as u8
    }

    /// Whether a locked-up core trips the timers' break inputs.
    #[must_use]
    pub fn lockup_breaks_timers(&self) -> bool {
        self.cfg2 & 1 != 0
    }
}

impl Peripheral for Syscfg {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.cfg0,
            0x08..=0x14 => self.extiss[(offset as usize - 8) / 4],
            0x18 => self.cfg2,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        match offset {
            0x00 => {
                self.cfg0 = value;
                cx.out.push(Signal::DmaRemap(value));
            }
            0x08..=0x14 => {
                self.extiss[(offset as usize - 8) / 4] = value & 0xffff;
                cx.out.push(Signal::ExtiRouting);
            }
            // The locks can be set only once (user manual SYSCFG_CFG2).
            0x18 => self.cfg2 |= value & 7,
            _ => {}
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            0x00 => Some(0x1f00),
            0x08..=0x14 => Some(0xffff),
            0x18 => Some(1),
            _ => None,
        }
    }
}
