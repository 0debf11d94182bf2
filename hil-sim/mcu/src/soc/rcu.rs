//! Reset and clock unit (user manual chapter 4): oscillators with start-up time, PLL, prescalers,
//! clock gates, peripheral resets, reset flags.

use super::peripheral::{Cx, Peripheral, PeripheralId, ResetCause, Signal, TimerId};
use crate::clock::{Clocks, IRC8M_HZ};

/// Start-up times in nanoseconds (datasheet, typical).
mod startup_ns {
    pub const IRC8M: u64 = 2_000;
    pub const HXTAL: u64 = 1_800_000;
    pub const PLL: u64 = 100_000;
    pub const IRC28M: u64 = 2_000;
    pub const IRC48M: u64 = 3_000;
    pub const IRC40K: u64 = 80_000;
}

/// Frequency of the board's crystal.
pub const HXTAL_HZ: u32 = 8_000_000;

/// An oscillator: on since some time, stable once its start-up time is over.
#[derive(Debug, Clone, Copy)]
struct Oscillator {
    on_since_ns: Option<u64>,
    startup_ns: u64,
}

impl Oscillator {
    const fn off(startup_ns: u64) -> Self {
        Self { on_since_ns: None, startup_ns }
    }

    fn enable(&mut self, on: bool, now_ns: u64) {
        match (on, self.on_since_ns) {
            (true, None) => self.on_since_ns = Some(now_ns),
            (false, _) => self.on_since_ns = None,
            _ => {}
        }
    }

    fn stable(&self, now_ns: u64) -> bool {
        self.on_since_ns.is_some_and(|since| now_ns >= since + self.startup_ns)
    }
}

/// The reset and clock unit.
#[derive(Debug)]
pub struct Rcu {
    cfg: [u32; 3],
    addctl: u32,
    irc8m_adj: u32,
    irc28m_adj: u32,
    int_enable: u32,
    ahben: u32,
    apb1en: u32,
    apb2en: u32,
    addapb1en: u32,
    ahbrst: u32,
    apb1rst: u32,
    apb2rst: u32,
    addapb1rst: u32,
    bdctl: u32,
    reset_flags: u32,
    irc8m: Oscillator,
    hxtal: Oscillator,
    pll: Oscillator,
    irc28m: Oscillator,
    irc48m: Oscillator,
    irc40k: Oscillator,
    /// `SCSS`: the source that clocks the core now.
    switched_to: u32,
    /// Whether the board carries a crystal; without one HXTAL never becomes stable.
    pub crystal_fitted: bool,
    /// Whether this chip has the USB core (and its clock gate).
    has_usb: bool,
    /// `CKMEN`: the crystal is watched.
    monitor: bool,
    /// `CKMIF`: the monitor has found it stopped.
    stuck: bool,
}

impl Rcu {
    /// The unit after a reset by `cause`; flags of earlier resets since power-on stay.
    #[must_use]
    pub fn new(has_usb: bool, crystal_fitted: bool, earlier_flags: u32, cause: ResetCause) -> Self {
        let flag = match cause {
            ResetCause::Power => 1 << 27,
            ResetCause::Pin => 1 << 26,
            ResetCause::Software => 1 << 28,
            ResetCause::Watchdog => 1 << 29,
        };
        // Every reset also pulls the reset pin low (user manual 4.1), which sets EPRSTF.
        let reset_flags = if cause == ResetCause::Power {
            flag | 1 << 26
        } else {
            earlier_flags | flag | 1 << 26
        };
        let mut irc8m = Oscillator::off(startup_ns::IRC8M);
        irc8m.on_since_ns = Some(0);
        irc8m.startup_ns = 0;
        Self {
            cfg: [0; 3],
            addctl: 0x8000_0000,
            irc8m_adj: 0x80,
            irc28m_adj: 0x80,
            int_enable: 0,
            ahben: 0x14,
            apb1en: 0,
            apb2en: 0,
            addapb1en: 0,
            ahbrst: 0,
            apb1rst: 0,
            apb2rst: 0,
            addapb1rst: 0,
            bdctl: 0x18,
            reset_flags,
            irc8m,
            hxtal: Oscillator::off(startup_ns::HXTAL),
            pll: Oscillator::off(startup_ns::PLL),
            irc28m: Oscillator::off(startup_ns::IRC28M),
            irc48m: Oscillator::off(startup_ns::IRC48M),
            irc40k: Oscillator::off(startup_ns::IRC40K),
            switched_to: 0,
            crystal_fitted,
            has_usb,
            monitor: false,
            stuck: false,
        }
    }

    /// The reset flags (`RSTSCK`), which outlive every reset but a power-on.
    #[must_use]
    pub fn reset_flags(&self) -> u32 {
        self.reset_flags
    }

    /// The crystal stops, or starts again. Where the monitor watches it, the core goes on from IRC8M
    /// and gets an NMI (user manual, "HXTAL clock monitor"); what an unwatched clock that stops does
    /// to the core is not modelled.
    pub fn set_crystal(&mut self, works: bool, out: &mut Vec<Signal>) {
        self.crystal_fitted = works;
        if works || !self.monitor || self.hxtal.on_since_ns.is_none() {
            return;
        }
        let from_crystal = self.cfg[0] >> 16 & 1 != 0 && self.cfg[1] >> 30 & 1 == 0;
        self.hxtal.on_since_ns = None;
        self.monitor = false;
        self.stuck = true;
        if self.switched_to == 1 || self.switched_to == 2 && from_crystal {
            self.switched_to = 0;
            self.cfg[0] &= !3;
        }
        if from_crystal {
            self.pll.on_since_ns = None;
        }
        out.push(Signal::ClocksChanged);
        out.push(Signal::Nmi);
    }

    /// Whether the clock of a peripheral is on, and the gate's name.
    #[must_use]
    pub fn clock_gate(&self, id: PeripheralId) -> (bool, &'static str) {
        let (register, bit, name) = match id {
            PeripheralId::Dma => (self.ahben, 0, "RCU.AHBEN.DMAEN"),
            PeripheralId::Crc => (self.ahben, 6, "RCU.AHBEN.CRCEN"),
            PeripheralId::Usbfs => (self.ahben, 12, "RCU.AHBEN.USBFSEN"),
            PeripheralId::Gpio(0) => (self.ahben, 17, "RCU.AHBEN.PAEN"),
            PeripheralId::Gpio(1) => (self.ahben, 18, "RCU.AHBEN.PBEN"),
            PeripheralId::Gpio(2) => (self.ahben, 19, "RCU.AHBEN.PCEN"),
            PeripheralId::Gpio(3) => (self.ahben, 20, "RCU.AHBEN.PDEN"),
            PeripheralId::Gpio(_) => (self.ahben, 22, "RCU.AHBEN.PFEN"),
            // EXTI has no gate of its own; its line selection is SYSCFG's.
            PeripheralId::Syscfg => (self.apb2en, 0, "RCU.APB2EN.CFGCMPEN"),
            PeripheralId::Adc => (self.apb2en, 9, "RCU.APB2EN.ADCEN"),
            PeripheralId::Timer(TimerId::T0) => (self.apb2en, 11, "RCU.APB2EN.TIMER0EN"),
            PeripheralId::Usart(0) => (self.apb2en, 14, "RCU.APB2EN.USART0EN"),
            PeripheralId::Timer(TimerId::T14) => (self.apb2en, 16, "RCU.APB2EN.TIMER14EN"),
            PeripheralId::Timer(TimerId::T15) => (self.apb2en, 17, "RCU.APB2EN.TIMER15EN"),
            PeripheralId::Timer(TimerId::T16) => (self.apb2en, 18, "RCU.APB2EN.TIMER16EN"),
            PeripheralId::Timer(TimerId::T1) => (self.apb1en, 0, "RCU.APB1EN.TIMER1EN"),
            PeripheralId::Timer(TimerId::T2) => (self.apb1en, 1, "RCU.APB1EN.TIMER2EN"),
            PeripheralId::Timer(TimerId::T13) => (self.apb1en, 8, "RCU.APB1EN.TIMER13EN"),
            PeripheralId::Usart(_) => (self.apb1en, 17, "RCU.APB1EN.USART1EN"),
            PeripheralId::Pmu => (self.apb1en, 28, "RCU.APB1EN.PMUEN"),
            PeripheralId::Ctc => (self.addapb1en, 27, "RCU.ADDAPB1EN.CTCEN"),
            PeripheralId::Rcu
            | PeripheralId::Fmc
            | PeripheralId::Fwdgt
            | PeripheralId::Dbg
            | PeripheralId::Exti => return (true, ""),
        };
        (register >> bit & 1 != 0, name)
    }

    fn pll_hz(&self) -> u32 {
        let [cfg0, cfg1, _] = self.cfg;
        let source = if cfg0 >> 16 & 1 == 0 {
            IRC8M_HZ / 2
        } else {
            // CFG1.PLLPRESEL: the crystal or IRC48M, through PREDV.
            let input = if cfg1 >> 30 & 1 == 0 { HXTAL_HZ } else { 48_000_000 };
            input / ((cfg1 & 0xf) + 1)
        };
        let field = (cfg0 >> 18 & 0xf) | (cfg0 >> 27 & 1) << 4 | (cfg1 >> 31) << 5;
        let factor = match field {
            0..=14 => field + 2,
            15 => 16,
            _ => field + 1,
        };
        source * factor
    }

    /// Frequencies that the registers ask for now.
    #[must_use]
    pub fn clocks(&self, now_ns: u64) -> Clocks {
        let [cfg0, _, cfg2] = self.cfg;
        let system = match self.switched_to {
            1 => HXTAL_HZ,
            2 => self.pll_hz(),
            _ => IRC8M_HZ,
        };
        let ahb_div = match cfg0 >> 4 & 0xf {
            0..=7 => 1,
            n @ 8..=11 => 2 << (n - 8),
            n => 64 << (n - 12),
        };
        let apb_div = |field: u32| if field & 4 == 0 { 1 } else { 2 << (field & 3) };
        let (apb1_div, apb2_div) = (apb_div(cfg0 >> 8 & 7), apb_div(cfg0 >> 11 & 7));
        let hclk_hz = system / ahb_div;
        let timer_div = |apb: u32| if apb == 1 { 1 } else { apb / 2 };
        let adc_hz = if cfg2 >> 8 & 1 == 0 {
            if cfg2 >> 16 & 1 == 0 { 14_000_000 } else { 28_000_000 }
        } else {
            let field = (cfg0 >> 14 & 3) | (cfg2 >> 31) << 2;
            match field {
                0..=3 => hclk_hz / apb2_div / (2 * (field + 1)),
                _ => hclk_hz / (3 + 2 * (field & 3)),
            }
        };
        let usart0_hz = match cfg2 & 3 {
            0 => hclk_hz / apb2_div,
            1 => system,
            2 => 32_768,
            _ => IRC8M_HZ,
        };
        let usb_hz = if self.addctl & 1 != 0 {
            if self.irc48m.stable(now_ns) { 48_000_000 } else { 0 }
        } else if self.pll.stable(now_ns) {
            // USBFSPSC (user manual CFG0, CFG2): /1.5, /1, /2.5, /2, /3, /3.5.
            let field = (cfg0 >> 22 & 3) | (cfg2 >> 30 & 1) << 2;
            let halves = match field {
                0 => 3,
                1 => 2,
                2 => 5,
                3 => 4,
                4 | 5 => 6,
                _ => 7,
            };
            self.pll_hz() * 2 / halves
        } else {
            0
        };
        let mut clocks = Clocks::after_reset();
        clocks.hclk_hz = hclk_hz;
        clocks.apb1_div = apb1_div;
        clocks.apb2_div = apb2_div;
        clocks.timer_apb1_div = timer_div(apb1_div);
        clocks.timer_apb2_div = timer_div(apb2_div);
        clocks.adc_hz = adc_hz;
        clocks.usart0_hz = usart0_hz;
        clocks.usb_hz = usb_hz;
        clocks
    }

    fn switch(&mut self, now_ns: u64, out: &mut Vec<Signal>) {
        let wanted = self.cfg[0] & 3;
        let ready = match wanted {
            0 => self.irc8m.stable(now_ns),
            1 => self.hxtal_stable(now_ns),
            2 => self.pll.stable(now_ns),
            _ => false,
        };
        if ready {
            self.switched_to = wanted;
        }
        out.push(Signal::ClocksChanged);
    }

    fn hxtal_stable(&self, now_ns: u64) -> bool {
        self.crystal_fitted && self.hxtal.stable(now_ns)
    }

    fn reset_pulse(register: u8, old: u32, new: u32, out: &mut Vec<Signal>) {
        let ids: &[(u32, PeripheralId)] = match register {
            0 => &[
                (0, PeripheralId::Syscfg),
                (9, PeripheralId::Adc),
                (11, PeripheralId::Timer(TimerId::T0)),
                (14, PeripheralId::Usart(0)),
                (16, PeripheralId::Timer(TimerId::T14)),
                (17, PeripheralId::Timer(TimerId::T15)),
                (18, PeripheralId::Timer(TimerId::T16)),
            ],
            1 => &[
                (0, PeripheralId::Timer(TimerId::T1)),
                (1, PeripheralId::Timer(TimerId::T2)),
                (8, PeripheralId::Timer(TimerId::T13)),
                (17, PeripheralId::Usart(1)),
                (28, PeripheralId::Pmu),
            ],
            2 => &[
                (12, PeripheralId::Usbfs),
                (17, PeripheralId::Gpio(0)),
                (18, PeripheralId::Gpio(1)),
                (19, PeripheralId::Gpio(2)),
                (20, PeripheralId::Gpio(3)),
                (22, PeripheralId::Gpio(5)),
            ],
            _ => &[(27, PeripheralId::Ctc)],
        };
        for (bit, id) in ids {
            if (new & !old) >> bit & 1 != 0 {
                out.push(Signal::PeripheralReset(*id));
            }
        }
    }
}

impl Peripheral for Rcu {
    fn read(&mut self, offset: u32, cx: &mut Cx<'_>) -> u32 {
        let ns = cx.clocks.ns_at(cx.now);
        let osc = |o: &Oscillator, enable: u32, stable: u32| {
            u32::from(o.on_since_ns.is_some()) << enable | u32::from(o.stable(ns)) << stable
        };
        match offset {
            0x00 => {
                self.irc8m_adj
                    | osc(&self.irc8m, 0, 1)
                    | u32::from(self.hxtal.on_since_ns.is_some()) << 16
                    | u32::from(self.hxtal_stable(ns)) << 17
                    | u32::from(self.monitor) << 19
                    | osc(&self.pll, 24, 25)
            }
            0x04 => self.cfg[0] & !0xc | self.switched_to << 2,
            0x08 => self.int_enable | u32::from(self.stuck) << 7,
            0x0c => self.apb2rst,
            0x10 => self.apb1rst,
            0x14 => self.ahben,
            0x18 => self.apb2en,
            0x1c => self.apb1en,
            0x20 => self.bdctl,
            0x24 => self.reset_flags | osc(&self.irc40k, 0, 1),
            0x28 => self.ahbrst,
            0x2c => self.cfg[1],
            0x30 => self.cfg[2],
            0x34 => self.irc28m_adj | osc(&self.irc28m, 0, 1),
            0xc0 => self.addctl & !(3 << 16) | osc(&self.irc48m, 16, 17),
            0xf8 => self.addapb1en,
            0xfc => self.addapb1rst,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        let ns = cx.clocks.ns_at(cx.now);
        match offset {
            0x00 => {
                self.irc8m_adj = value & 0xf8;
                self.irc8m.enable(value & 1 != 0 || self.switched_to == 0, ns);
                self.hxtal.enable(value >> 16 & 1 != 0, ns);
                self.monitor = value >> 19 & 1 != 0;
                self.pll.enable(value >> 24 & 1 != 0 || self.switched_to == 2, ns);
            }
            0x04 => {
                self.cfg[0] = value & !0xc;
                self.switch(ns, cx.out);
            }
            0x0c => {
                Self::reset_pulse(0, self.apb2rst, value, cx.out);
                self.apb2rst = value;
            }
            0x10 => {
                Self::reset_pulse(1, self.apb1rst, value, cx.out);
                self.apb1rst = value;
            }
            // The gate of what is not there cannot be opened (inferred).
            0x14 => self.ahben = value & !(u32::from(!self.has_usb) << 12),
            0x18 => self.apb2en = value,
            0x1c => self.apb1en = value,
            0x24 => {
                self.irc40k.enable(value & 1 != 0, ns);
                if value >> 24 & 1 != 0 {
                    self.reset_flags = 0;
                }
            }
            0x28 => {
                Self::reset_pulse(2, self.ahbrst, value, cx.out);
                self.ahbrst = value;
            }
            0x2c => {
                self.cfg[1] = value;
                cx.out.push(Signal::ClocksChanged);
            }
            0x30 => {
                self.cfg[2] = value;
                cx.out.push(Signal::ClocksChanged);
            }
            0x34 => {
                self.irc28m_adj = value & 0xf8;
                self.irc28m.enable(value & 1 != 0, ns);
            }
            0xc0 => {
                self.addctl = value;
                self.irc48m.enable(value >> 16 & 1 != 0, ns);
                cx.out.push(Signal::ClocksChanged);
            }
            0xf8 => self.addapb1en = value,
            0xfc => {
                Self::reset_pulse(3, self.addapb1rst, value, cx.out);
                self.addapb1rst = value;
            }
            _ => {}
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        let usb = u32::from(self.has_usb) << 12;
        Some(match offset {
            // Bits that hardware sets may be written back.
            0x00 => 0x030b_fffb,
            // CKOUT is not routed to a pin.
            0x04 => 0x08ff_ffff,
            0x08 => 0,
            0x0c => 0x0007_4a01,
            0x10 => 0x1002_0103,
            // Firmware asks for the gate of USBFS to find out which chip it runs on.
            0x14 => 0x005e_1055,
            0x18 => 0x0007_4a01,
            0x1c => 0x1002_0103,
            0x24 => 0xff80_0003,
            0x28 => 0x005e_0000 | usb,
            0x2c => 0xc000_000f,
            0x30 => 0xc001_0103,
            0x34 => 0xfffb,
            0xc0 => 0xff03_0001,
            0xf8 | 0xfc => 1 << 27,
            _ => return None,
        })
    }
}
