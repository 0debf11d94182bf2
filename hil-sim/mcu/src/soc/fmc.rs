//! Flash memory controller (user manual chapter 2): unlock, page erase, word and half-word program,
//! protection by the lock, times from the datasheet, and what a power cut leaves behind.

use std::sync::Arc;

use super::peripheral::{Cx, NEVER, Peripheral, Signal};
use crate::cpu::SharedMemory;

/// Bytes of an erase page.
pub const PAGE_BYTES: u32 = 1024;
/// Start of the flash in the address map.
pub const FLASH_BASE: u32 = 0x0800_0000;

/// Time of a word program (datasheet, "Flash memory": 37.5 us typical).
const PROGRAM_NS: u64 = 37_500;
/// Time of a page erase (datasheet: 45 ms typical for this family's pages).
const ERASE_NS: u64 = 45_000_000;

const BUSY: u32 = 1;
const PGERR: u32 = 1 << 2;
const WPERR: u32 = 1 << 4;
const ENDF: u32 = 1 << 5;
const PG: u32 = 1;
const PER: u32 = 1 << 1;
const START: u32 = 1 << 6;
const LOCK: u32 = 1 << 7;

/// An operation in progress.
#[derive(Debug, Clone, Copy)]
enum Operation {
    Program { offset: u32, bytes: u32, value: u32 },
    Erase { page: u32 },
}

/// The controller; the flash cells themselves are shared with the core.
pub struct Fmc {
    flash: Arc<dyn SharedMemory>,
    ws: u32,
    wsen: u32,
    stat: u32,
    ctl: u32,
    addr: u32,
    key_step: u8,
    /// A wrong key locks the controller until reset.
    key_refused: bool,
    busy: Option<(Operation, u64)>,
    operations: u64,
}

impl Fmc {
    /// The controller of `flash` after reset.
    #[must_use]
    pub fn new(flash: Arc<dyn SharedMemory>) -> Self {
        Self {
            flash,
            ws: 0,
            wsen: 0,
            stat: 0,
            ctl: LOCK,
            addr: 0,
            key_step: 0,
            key_refused: false,
            busy: None,
            operations: 0,
        }
    }

    /// The cycle at which the running operation ends. Until then the core waits when it fetches from
    /// the flash (user manual 2.3.4).
    #[must_use]
    pub fn busy_until(&self) -> Option<u64> {
        self.busy.map(|(_, at)| at)
    }

    /// Programs and erases begun since reset.
    #[must_use]
    pub fn operations(&self) -> u64 {
        self.operations
    }

    /// The supply fails in the middle of whatever runs: a program leaves only some of its bits
    /// cleared, an erase a page of noise. `noise` seeds what is left.
    pub fn power_cut(&mut self, mut noise: u64) {
        let mut random = move || {
            noise ^= noise << 13;
            noise ^= noise >> 7;
            noise ^= noise << 17;
            noise as u32
        };
        match self.busy.take() {
            Some((Operation::Program { offset, bytes, value }, _)) => {
                let before = self.flash.read(offset, bytes);
                self.flash.write(offset, bytes, before & (value | random()));
            }
            Some((Operation::Erase { page }, _)) => {
                for word in 0..PAGE_BYTES / 4 {
                    self.flash.write(page + 4 * word, 4, random());
                }
            }
            None => {}
        }
    }

    /// A write by the core into the flash's address range.
    pub fn program(&mut self, offset: u32, bytes: u32, value: u32, cx: &mut Cx<'_>) {
        if self.ctl & LOCK != 0 || self.ctl & PG == 0 || self.busy.is_some() {
            self.stat |= WPERR;
            return;
        }
        let now = self.flash.read(offset, bytes);
        let erased = u32::MAX >> (32 - 8 * bytes);
        if bytes == 1 || now & erased != erased {
            self.stat |= PGERR;
            return;
        }
        self.begin(Operation::Program { offset, bytes, value }, PROGRAM_NS, cx);
    }

    fn begin(&mut self, operation: Operation, ns: u64, cx: &mut Cx<'_>) {
        self.operations += 1;
        self.stat |= BUSY;
        self.busy = Some((operation, cx.now + cx.clocks.cycles_in(ns)));
    }

    fn raise(&self, cx: &mut Cx<'_>) {
        let end = self.ctl >> 12 & 1 != 0 && self.stat & ENDF != 0;
        let error = self.ctl >> 10 & 1 != 0 && self.stat & (PGERR | WPERR) != 0;
        cx.out.push(Signal::Irq(3, end || error));
    }
}

impl Peripheral for Fmc {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.ws,
            0x0c => self.stat,
            0x10 => self.ctl,
            0x14 => self.addr,
            // No protection, user option byte all ones.
            0x1c => 0x03ff_fffc & !0x6,
            0x20 => 0xffff,
            0xfc => self.wsen,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        match offset {
            0x00 => self.ws = value & 7,
            0x04 => {
                self.key_step = match (self.key_step, value) {
                    (0, 0x4567_0123) => 1,
                    (1, 0xcdef_89ab) if !self.key_refused => {
                        self.ctl &= !LOCK;
                        0
                    }
                    _ => {
                        self.key_refused = true;
                        0
                    }
                };
            }
            0x0c => self.stat &= !(value & (PGERR | WPERR | ENDF)),
            0x10 => {
                if self.ctl & LOCK != 0 {
                    return;
                }
                self.ctl = value & 0x1eb7;
                if value & LOCK != 0 {
                    self.ctl |= LOCK;
                }
                if value & START != 0 && value & PER != 0 && self.busy.is_none() {
                    let page = self.addr.wrapping_sub(FLASH_BASE) & !(PAGE_BYTES - 1);
                    if page < self.flash.bytes() {
                        self.begin(Operation::Erase { page }, ERASE_NS, cx);
                    } else {
                        self.stat |= WPERR;
                    }
                }
            }
            0x14 => self.addr = value,
            0xfc => self.wsen = value & 3,
            _ => {}
        }
        self.raise(cx);
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            // Wait states: the code area has none at any clock (datasheet 2.3).
            0x00 => Some(7),
            0x04 | 0x14 => Some(u32::MAX),
            0x0c => Some(0x35),
            // Mass erase and option bytes are not.
            0x10 => Some(0x14c3),
            0x1c | 0x20 => Some(0),
            0xfc => Some(3),
            _ => None,
        }
    }

    fn next_event(&self) -> u64 {
        self.busy.map_or(NEVER, |(_, at)| at)
    }

    fn event(&mut self, cx: &mut Cx<'_>) {
        match self.busy.take() {
            Some((Operation::Program { offset, bytes, value }, _)) => {
                let before = self.flash.read(offset, bytes);
                self.flash.write(offset, bytes, before & value);
            }
            Some((Operation::Erase { page }, _)) => {
                for word in 0..PAGE_BYTES / 4 {
                    self.flash.write(page + 4 * word, 4, u32::MAX);
                }
                self.ctl &= !START;
            }
            None => return,
        }
        self.stat = self.stat & !BUSY | ENDF;
        self.raise(cx);
    }
}
