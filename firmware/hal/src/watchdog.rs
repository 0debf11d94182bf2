//! Free watchdog (user manual, "Free watchdog timer (FWDGT)"): clocked by IRC40K, stopped by
//! nothing but a reset.

use crate::Peri;
use crate::calc::timing;
use crate::peripherals::FWDGT;
use crate::regs::{self, RegExt};

const KEY_FEED: u32 = 0xaaaa;
const KEY_UNLOCK: u32 = 0x5555;
const KEY_START: u32 = 0xcccc;

/// The watchdog, running.
pub struct Watchdog<'d> {
    _fwdgt: Peri<'d, FWDGT>,
}

impl<'d> Watchdog<'d> {
    /// Starts it: the chip is reset when it is not fed for `timeout_us` (it never bites earlier
    /// than that; see [`timing::watchdog_longest_us`] for the latest).
    ///
    /// # Panics
    /// When the timeout is longer than the watchdog can count, about 17 s.
    pub fn start(fwdgt: Peri<'d, FWDGT>, timeout_us: u32) -> Self {
        let Some((prescaler, reload)) = timing::watchdog(timeout_us) else {
            panic!("watchdog timeout too long")
        };
        let regs = regs::fwdgt();
        // Started first, so that IRC40K runs and takes the new values over.
        regs.ctl.set(KEY_START);
        regs.ctl.set(KEY_UNLOCK);
        regs.psc.set(u32::from(prescaler));
        regs.rld.set(u32::from(reload));
        // PUD, RUD: the values have crossed into the watchdog's clock domain.
        while regs.stat.get() & 0b11 != 0 {}
        regs.ctl.set(KEY_FEED);
        Self { _fwdgt: fwdgt }
    }

    /// Feeds it.
    pub fn feed(&mut self) {
        regs::fwdgt().ctl.set(KEY_FEED);
    }
}
