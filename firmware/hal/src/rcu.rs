//! Clocks (user manual, "Reset and clock unit (RCU)").
//!
//! [`init`] first goes back to IRC8M, so that it can also be called where a bootloader has set up
//! something else, then starts what the configuration names. A crystal that does not start within
//! [`HXTAL_TIMEOUT_LOOPS`] is not waited for: the tree falls back to the internal oscillator at the
//! same frequency, and [`clocks`] says so ([`Clocks::crystal_failed`]), because timestamps are then
//! only as good as IRC8M (1 % over temperature).

use crate::calc::clock::{Pll, PllInput, apb_prescaler, timer_hz, usb_prescaler_bits};
use crate::chip::{AHB_MAX_HZ, APB_MAX_HZ};
use crate::regs::{self, RegExt};
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

/// Polls of HXTALSTB before the crystal is given up: over 100 ms at 8 MHz.
pub const HXTAL_TIMEOUT_LOOPS: u32 = 200_000;

/// Source of the system clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The internal 8 MHz oscillator through the PLL.
    Irc8m,
    /// A crystal through the PLL.
    Hxtal {
        /// Its frequency in hertz, 4 to 32 MHz.
        hz: u32,
    },
}

/// Source of the 48 MHz clock for USB.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UsbClock {
    /// USB is not used.
    Off,
    /// The PLL, divided. Only with a crystal: IRC8M is out of USB's 0.25 %.
    Pll,
    /// IRC48M, trimmed by the CTC unit from the host's start-of-frame packets.
    Irc48mTrimmedBySof,
}

/// Clock tree.
#[non_exhaustive]
#[derive(Clone, Copy, Debug)]
pub struct Config {
    /// Where the system clock comes from.
    pub source: Source,
    /// System clock in hertz.
    pub ahb_hz: u32,
    /// USB clock.
    pub usb: UsbClock,
}

impl Default for Config {
    /// The fastest system clock from an 8 MHz crystal that the chip allows and, on the F350, that
    /// USB's prescaler turns into 48 MHz.
    fn default() -> Self {
        #[cfg(feature = "gd32f330")]
        return Self {
            source: Source::Hxtal { hz: 8_000_000 },
            ahb_hz: 84_000_000,
            usb: UsbClock::Off,
        };
        #[cfg(feature = "gd32f350")]
        Self { source: Source::Hxtal { hz: 8_000_000 }, ahb_hz: 96_000_000, usb: UsbClock::Pll }
    }
}

/// Frequencies in use.
#[derive(Clone, Copy, Debug)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Clocks {
    /// System, AHB and core clock in hertz.
    pub ahb_hz: u32,
    /// APB1 and APB2 clock in hertz (they are set alike).
    pub apb_hz: u32,
    /// Clock of every timer in hertz.
    pub timer_hz: u32,
    /// The configured crystal did not start; IRC8M (and IRC48M for USB) is used instead.
    pub crystal_failed: bool,
}

/// Whether the chip has the USB core: whether the bit of its clock gate can be set. The F330's manual
/// has the bit as reserved (that it reads as 0 there is inferred, not proven on hardware).
pub fn has_usbfs() -> bool {
    let ahben = &regs::rcu().ahben;
    let before = ahben.get();
    ahben.set(before | 1 << 12); // USBFSEN
    let has = ahben.get() & 1 << 12 != 0;
    ahben.set(before);
    has
}

static AHB_HZ: AtomicU32 = AtomicU32::new(8_000_000);
static APB_DIVISOR: AtomicU32 = AtomicU32::new(1);
static CRYSTAL_FAILED: AtomicBool = AtomicBool::new(false);

/// Frequencies that [`crate::init`] set up.
pub fn clocks() -> Clocks {
    let ahb_hz = AHB_HZ.load(Ordering::Relaxed);
    let divisor = APB_DIVISOR.load(Ordering::Relaxed);
    Clocks {
        ahb_hz,
        apb_hz: ahb_hz / divisor,
        timer_hz: timer_hz(ahb_hz, divisor),
        crystal_failed: CRYSTAL_FAILED.load(Ordering::Relaxed),
    }
}

// RCU_CFG0.
const SCS_MASK: u32 = 0b11;
const SCS_PLL: u32 = 0b10;
const SCSS_SHIFT: u32 = 2;
const APB1PSC_SHIFT: u32 = 8;
const APB2PSC_SHIFT: u32 = 11;
const PLLSEL_HXTAL_IRC48M: u32 = 1 << 16;
const PLLMF_LOW_SHIFT: u32 = 18;
const USBFSPSC_LOW_SHIFT: u32 = 22;
const PLLMF_BIT4_SHIFT: u32 = 27;
// RCU_CFG1.
const PLLPRESEL_IRC48M: u32 = 1 << 30;
const PLLMF_BIT5_SHIFT: u32 = 31;
// RCU_CFG2.
const USBFSPSC_BIT2_SHIFT: u32 = 30;

pub(crate) fn init(config: &Config) {
    assert!(config.ahb_hz <= AHB_MAX_HZ, "system clock above the chip's maximum");
    let rcu = regs::rcu();
    run_from_irc8m();

    let crystal = match config.source {
        Source::Irc8m => None,
        Source::Hxtal { hz } => start_crystal().then_some(hz),
    };
    let failed = crystal.is_none() && config.source != Source::Irc8m;
    CRYSTAL_FAILED.store(failed, Ordering::Relaxed);

    let input = crystal.map_or(PllInput::Irc8mHalf, |hz| PllInput::Hxtal { hz });
    let Ok(pll) = Pll::solve(input, config.ahb_hz) else {
        panic!("no PLL setting gives the system clock")
    };
    let usb = match config.usb {
        // Without its crystal the PLL is out of USB's tolerance.
        UsbClock::Pll if failed => UsbClock::Irc48mTrimmedBySof,
        other => other,
    };

    let (apb_divisor, apb_bits) = apb_prescaler(config.ahb_hz, APB_MAX_HZ);
    let mf = u32::from(pll.multiplier_bits());
    let mut cfg0 = u32::from(apb_bits) << APB1PSC_SHIFT
        | u32::from(apb_bits) << APB2PSC_SHIFT
        | (mf & 0xf) << PLLMF_LOW_SHIFT
        | (mf >> 4 & 1) << PLLMF_BIT4_SHIFT;
    let mut cfg1 = u32::from(pll.predivider - 1) | (mf >> 5 & 1) << PLLMF_BIT5_SHIFT;
    match input {
        PllInput::Irc8mHalf => {}
        PllInput::Hxtal { .. } => cfg0 |= PLLSEL_HXTAL_IRC48M,
        PllInput::Irc48m => {
            cfg0 |= PLLSEL_HXTAL_IRC48M;
            cfg1 |= PLLPRESEL_IRC48M;
        }
    }
    let mut usb_bit2 = 0;
    if usb == UsbClock::Pll {
        let Ok(bits) = usb_prescaler_bits(pll.output_hz()) else {
            panic!("no USB prescaler gives 48 MHz of this system clock")
        };
        cfg0 |= u32::from(bits & 0b11) << USBFSPSC_LOW_SHIFT;
        usb_bit2 = u32::from(bits >> 2) << USBFSPSC_BIT2_SHIFT;
    }

    // Two wait states are right at any frequency; the 64 KiB code area ignores them (manual,
    // "Flash memory controller (FMC)": FMC_WS, "Read operations").
    regs::fmc().ws.update(|bits| bits & !0b111 | 2);
    rcu.cfg1.set(cfg1);
    rcu.cfg2.update(|bits| bits & !(1 << USBFSPSC_BIT2_SHIFT) | usb_bit2);
    rcu.cfg0.set(cfg0);
    rcu.ctl0.modify(|_, w| w.pllen().set_bit());
    while rcu.ctl0.get() & 1 << 25 == 0 {} // PLLSTB
    rcu.cfg0.update(|bits| bits & !SCS_MASK | SCS_PLL);
    while rcu.cfg0.get() >> SCSS_SHIFT & SCS_MASK != SCS_PLL {}
    if crystal.is_some() {
        // A crystal that stops later: hardware goes back to IRC8M and raises an NMI (manual, "HXTAL
        // clock monitor (CKM)"). Without it the core, the timers and the guard would stop with the
        // outputs as they are, until the watchdog.
        rcu.ctl0.modify(|_, w| w.ckmen().set_bit());
    }

    AHB_HZ.store(pll.output_hz(), Ordering::Relaxed);
    APB_DIVISOR.store(apb_divisor, Ordering::Relaxed);
    if usb == UsbClock::Irc48mTrimmedBySof {
        start_irc48m();
    }
    // What every driver needs: ports, DMA, SYSCFG. The rest is clocked by its driver.
    rcu.ahben.modify(|_, w| {
        w.paen().set_bit().pben().set_bit().pcen().set_bit().pden().set_bit().pfen().set_bit();
        w.dmaen().set_bit()
    });
    rcu.apb2en.modify(|_, w| w.cfgcmpen().set_bit());
}

/// Back to IRC8M, PLL off: the state after reset.
fn run_from_irc8m() {
    let rcu = regs::rcu();
    rcu.ctl0.modify(|_, w| w.irc8men().set_bit());
    while rcu.ctl0.get() & 1 << 1 == 0 {} // IRC8MSTB
    rcu.cfg0.update(|bits| bits & !SCS_MASK);
    while rcu.cfg0.get() >> SCSS_SHIFT & SCS_MASK != 0 {}
    rcu.ctl0.modify(|_, w| w.pllen().clear_bit());
    while rcu.ctl0.get() & 1 << 25 != 0 {}
}

fn start_crystal() -> bool {
    let rcu = regs::rcu();
    rcu.ctl0.modify(|_, w| w.hxtalen().set_bit());
    for _ in 0..HXTAL_TIMEOUT_LOOPS {
        if rcu.ctl0.get() & 1 << 17 != 0 {
            return true; // HXTALSTB
        }
    }
    rcu.ctl0.modify(|_, w| w.hxtalen().clear_bit());
    false
}

/// IRC48M on, selected for USB, and the CTC unit trimming it from the host's 1 kHz start-of-frame
/// packets (manual, "Clock trim controller (CTC)": reload = 48 MHz / 1 kHz - 1; the limit is the
/// reload's 0.12 %, half the trim step, which is the manual's own formula).
fn start_irc48m() {
    const CTC_RELOAD: u32 = 48_000 - 1;
    const CTC_LIMIT: u32 = 48_000 * 12 / 10_000 / 2;
    const REFSEL_USB_SOF: u32 = 0b10 << 28;
    let rcu = regs::rcu();
    rcu.addctl.modify(|_, w| w.irc48men().set_bit());
    while rcu.addctl.get() & 1 << 17 == 0 {} // IRC48MSTB
    rcu.addctl.modify(|_, w| w.ck48msel().set_bit());
    rcu.addapb1en.modify(|_, w| w.ctcen().set_bit());
    let ctc = regs::ctc();
    ctc.ctl1.set(REFSEL_USB_SOF | CTC_LIMIT << 16 | CTC_RELOAD);
    ctc.ctl0.modify(|_, w| w.autotrim().set_bit().cnten().set_bit());
}
