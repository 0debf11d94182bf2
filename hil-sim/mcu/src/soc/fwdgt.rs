//! Free watchdog (user manual chapter 15.1), on its own 40 kHz oscillator.

use super::peripheral::{Cx, NEVER, Peripheral, ResetCause, Signal};

/// Nominal IRC40K. Its tolerance (20 to 60 kHz) is in the bounds, not in the model.
pub const IRC40K_HZ: u64 = 40_000;

/// The watchdog. Only a reset stops it.
#[derive(Debug)]
pub struct Fwdgt {
    psc: u32,
    rld: u32,
    running: bool,
    unlocked: bool,
    /// Virtual time at which it bites.
    bites_at_ns: u64,
    next: u64,
    /// Set while the core is halted with FWDGT_HOLD: time left.
    held_ns: Option<u64>,
    updating_until_ns: u64,
}

impl Fwdgt {
    /// The watchdog after reset: not running.
    #[must_use]
    pub fn new() -> Self {
        Self {
            psc: 0,
            rld: 0xfff,
            running: false,
            unlocked: false,
            bites_at_ns: 0,
            next: NEVER,
            held_ns: None,
            updating_until_ns: 0,
        }
    }

    /// Whether the firmware has started it.
    #[must_use]
    pub fn running(&self) -> bool {
        self.running
    }

    fn period_ns(&self) -> u64 {
        let divider = 4u64 << self.psc.min(6);
        (u64::from(self.rld) + 1) * divider * 1_000_000_000 / IRC40K_HZ
    }

    fn reload(&mut self, cx: &Cx<'_>) {
        self.bites_at_ns = cx.clocks.ns_at(cx.now) + self.period_ns();
        self.next = cx.clocks.cycle_at(self.bites_at_ns);
    }

    /// Holds or releases the count (debug halt with DBG.CTL0.FWDGT_HOLD).
    pub fn hold(&mut self, held: bool, cx: &Cx<'_>) {
        if !self.running {
            return;
        }
        let now_ns = cx.clocks.ns_at(cx.now);
        match (held, self.held_ns) {
            (true, None) => {
                self.held_ns = Some(self.bites_at_ns.saturating_sub(now_ns));
                self.next = NEVER;
            }
            (false, Some(left)) => {
                self.held_ns = None;
                self.bites_at_ns = now_ns + left;
                self.next = cx.clocks.cycle_at(self.bites_at_ns);
            }
            _ => {}
        }
    }
}

impl Default for Fwdgt {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Fwdgt {
    fn read(&mut self, offset: u32, cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x04 => self.psc,
            0x08 => self.rld,
            0x0c => u32::from(cx.clocks.ns_at(cx.now) < self.updating_until_ns) * 3,
            0x10 => 0xfff,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        // A new prescaler or reload value needs up to five oscillator cycles (user manual).
        const UPDATE_NS: u64 = 5 * 1_000_000_000 / IRC40K_HZ;
        match offset {
            0x00 => match value & 0xffff {
                0x5555 => self.unlocked = true,
                0xaaaa => {
                    self.unlocked = false;
                    if self.running {
                        self.reload(cx);
                    }
                }
                0xcccc => {
                    self.unlocked = false;
                    self.running = true;
                    self.reload(cx);
                }
                _ => self.unlocked = false,
            },
            0x04 if self.unlocked => {
                self.psc = value & 7;
                self.updating_until_ns = cx.clocks.ns_at(cx.now) + UPDATE_NS;
            }
            0x08 if self.unlocked => {
                self.rld = value & 0xfff;
                self.updating_until_ns = cx.clocks.ns_at(cx.now) + UPDATE_NS;
            }
            _ => {}
        }
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            0x00 => Some(0xffff),
            0x04 => Some(7),
            0x08 => Some(0xfff),
            0x0c => Some(0),
            // The window is not modelled.
            _ => None,
        }
    }

    fn next_event(&self) -> u64 {
        self.next
    }

    fn event(&mut self, cx: &mut Cx<'_>) {
        self.next = NEVER;
        self.running = false;
        cx.out.push(Signal::Reset(ResetCause::Watchdog));
    }

    fn after_clock_change(&mut self, cx: &mut Cx<'_>) {
        if self.running && self.held_ns.is_none() {
            self.next = cx.clocks.cycle_at(self.bites_at_ns);
        }
    }
}
