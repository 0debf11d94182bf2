//! The USB device core (user manual chapter 27; Synopsys OTG FS): registers and FIFOs on one side,
//! packets of the bus on the other.
//!
//! Quirks of the real core that firmware depends on: an OUT endpoint keeps EPENA when its transfer
//! ends and only answers NAK; XFRC of an OUT endpoint and STUP are raised when the status words 3
//! and 4 are popped; a SETUP is always taken, sets NAK on both directions of endpoint 0 and clears
//! its STALL; a new address holds from the end of the status stage.

use std::collections::VecDeque;

use super::endpoint::{Endpoint, ctl, int};

/// Endpoints of each direction.
pub const ENDPOINTS: usize = 4;
/// FIFO memory in words.
pub const FIFO_WORDS: u32 = 320;

/// Interrupt flags of GINTF.
mod gint {
    pub const HOST_MODE: u32 = 1;
    pub const OTG: u32 = 1 << 2;
    pub const SOF: u32 = 1 << 3;
    pub const RXFLVL: u32 = 1 << 4;
    pub const NPTXFE: u32 = 1 << 5;
    pub const ESUSP: u32 = 1 << 10;
    pub const USBSUSP: u32 = 1 << 11;
    pub const USBRST: u32 = 1 << 12;
    pub const ENUMDNE: u32 = 1 << 13;
    pub const IEPINT: u32 = 1 << 18;
    pub const OEPINT: u32 = 1 << 19;
    pub const SRQ: u32 = 1 << 30;
    pub const WKUP: u32 = 1 << 31;
}

/// The device's answer to a token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// Data, with its toggle.
    Data(Vec<u8>, bool),
    /// Taken.
    Ack,
    /// Not now.
    Nak,
    /// Halted.
    Stall,
    /// No answer at all.
    Silence,
}

/// A status word of the receive FIFO and the bytes behind it.
#[derive(Debug, Clone)]
struct Received {
    status: u32,
    bytes: Vec<u8>,
}

/// The core.
#[derive(Debug)]
pub struct DeviceCore {
    gotgcs: u32,
    gotgint: u32,
    gahbcs: u32,
    gusbcs: u32,
    gintf: u32,
    ginten: u32,
    grflen: u32,
    txflen: [u32; ENDPOINTS],
    gccfg: u32,
    dcfg: u32,
    dctl: u32,
    diepinten: u32,
    doepinten: u32,
    daepinten: u32,
    diepfeinten: u32,
    pwrclk: u32,
    pub(super) ins: [Endpoint; ENDPOINTS],
    pub(super) outs: [Endpoint; ENDPOINTS],
    rx: VecDeque<Received>,
    /// Words of the popped packet that have not been read.
    popped: VecDeque<u8>,
    address: u8,
    frame: u16,
    suspended: bool,
    vbus: bool,
}

impl DeviceCore {
    /// The core after reset, with or without VBUS.
    #[must_use]
    pub fn new(vbus: bool) -> Self {
        Self {
            gotgcs: 0x800,
            gotgint: 0,
            gahbcs: 0,
            gusbcs: 0xa80,
            gintf: 0,
            ginten: 0,
            grflen: 0x200,
            txflen: [0x0200_0200, 0x0200_0400, 0x0200_0400, 0x0200_0400],
            gccfg: 0,
            dcfg: 0,
            dctl: 0,
            diepinten: 0,
            doepinten: 0,
            daepinten: 0,
            diepfeinten: 0,
            pwrclk: 0,
            ins: std::array::from_fn(Endpoint::new),
            outs: std::array::from_fn(Endpoint::new),
            rx: VecDeque::new(),
            popped: VecDeque::new(),
            address: 0,
            frame: 0,
            suspended: false,
            vbus,
        }
    }

    /// Whether the pull-up shows a device on the bus.
    #[must_use]
    pub fn pulled_up(&self) -> bool {
        self.gccfg >> 16 & 1 != 0
            && self.dctl >> 1 & 1 == 0
            && self.gusbcs >> 30 & 1 != 0
            && (self.vbus || self.ignores_vbus())
    }

    fn ignores_vbus(&self) -> bool {
        self.gccfg >> 21 & 1 != 0
    }

    /// Level of the interrupt line.
    #[must_use]
    pub fn interrupt(&self) -> bool {
        self.gahbcs & 1 != 0 && self.flags() & self.ginten != 0
    }

    fn flags(&self) -> u32 {
        let host_mode = if self.gusbcs >> 30 & 1 == 0 { gint::HOST_MODE } else { 0 };
        let rx = if self.rx.is_empty() { 0 } else { gint::RXFLVL };
        let endpoints = self.daepint() & self.daepinten;
        let ins = if endpoints & 0xffff != 0 { gint::IEPINT } else { 0 };
        let outs = if endpoints >> 16 != 0 { gint::OEPINT } else { 0 };
        let otg = if self.gotgint != 0 { gint::OTG } else { 0 };
        self.gintf | host_mode | rx | ins | outs | otg | gint::NPTXFE
    }

    fn daepint(&self) -> u32 {
        let mut word = 0;
        for n in 0..ENDPOINTS {
            let empty = self.ins[n].fifo.is_empty() && self.diepfeinten >> n & 1 != 0;
            if self.ins[n].int & self.diepinten != 0 || empty {
                word |= 1 << n;
            }
            if self.outs[n].int & self.doepinten != 0 {
                word |= 1 << (16 + n);
            }
        }
        word
    }

    /// The bus drives a reset.
    pub fn bus_reset(&mut self) {
        self.address = 0;
        self.suspended = false;
        self.gintf |= gint::USBRST;
    }

    /// The reset ends: full speed was found.
    pub fn reset_done(&mut self) {
        self.gintf |= gint::ENUMDNE;
    }

    /// A start-of-frame packet.
    pub fn start_of_frame(&mut self, frame: u16) {
        self.frame = frame;
        self.gintf |= gint::SOF;
    }

    /// The bus has been idle for 3 ms.
    pub fn suspend(&mut self) {
        self.suspended = true;
        self.gintf |= gint::ESUSP | gint::USBSUSP;
    }

    /// The bus resumes.
    pub fn resume(&mut self) {
        self.suspended = false;
        self.gintf |= gint::WKUP;
    }

    /// VBUS came or went; the core tells only where it senses it.
    pub fn set_vbus(&mut self, on: bool) {
        if self.vbus == on {
            return;
        }
        self.vbus = on;
        if !self.ignores_vbus() && self.gccfg >> 18 & 3 != 0 {
            if on {
                self.gintf |= gint::SRQ;
            } else {
                self.gotgint |= 1 << 2;
            }
        }
    }

    /// Whether the device answers at `address`.
    #[must_use]
    pub fn answers(&self, address: u8) -> bool {
        self.address == address && !self.suspended
    }

    fn rx_words_used(&self) -> u32 {
        self.rx.iter().map(|r| 1 + r.bytes.len().div_ceil(4) as u32).sum::<u32>()
            + self.popped.len().div_ceil(4) as u32
    }

    fn push(&mut self, packet_status: u32, endpoint: usize, bytes: Vec<u8>) {
        let status = packet_status << 17 | (bytes.len() as u32) << 4 | endpoint as u32;
        self.rx.push_back(Received { status, bytes });
    }

    /// A SETUP token with its eight bytes.
    pub fn setup(&mut self, bytes: [u8; 8]) -> Answer {
        self.push(6, 0, bytes.to_vec());
        self.push(4, 0, Vec::new());
        self.ins[0].ctl = self.ins[0].ctl & !ctl::STALL | ctl::NAKSTS | ctl::DPID;
        self.outs[0].ctl = self.outs[0].ctl & !ctl::STALL | ctl::NAKSTS | ctl::DPID;
        Answer::Ack
    }

    /// An OUT token with its packet and toggle.
    pub fn out(&mut self, endpoint: usize, bytes: &[u8], toggle: bool) -> Answer {
        let room = self.grflen.min(FIFO_WORDS).saturating_sub(self.rx_words_used());
        let ep = &mut self.outs[endpoint];
        if ep.ctl & ctl::USBAEP == 0 {
            return Answer::Silence;
        }
        if ep.ctl & ctl::STALL != 0 {
            return Answer::Stall;
        }
        // Endpoint 0's packet count may be 0 while it waits for a status stage.
        if !ep.ready()
            || endpoint != 0 && ep.packets_left() == 0
            || room < 3 + bytes.len().div_ceil(4) as u32
        {
            return Answer::Nak;
        }
        if (ep.ctl & ctl::DPID != 0) != toggle {
            // A repeated packet: acknowledged, and dropped.
            return Answer::Ack;
        }
        ep.ctl ^= ctl::DPID;
        ep.count_packet(bytes.len() as u32);
        let ends = ep.packets_left() == 0 || (bytes.len() as u32) < ep.max_packet();
        if ends {
            ep.ctl |= ctl::NAKSTS;
        }
        self.push(2, endpoint, bytes.to_vec());
        if ends {
            self.push(3, endpoint, Vec::new());
        }
        Answer::Ack
    }

    /// An IN token; the host acknowledges what it gets.
    pub fn input(&mut self, endpoint: usize) -> Answer {
        let ep = &mut self.ins[endpoint];
        if ep.ctl & ctl::USBAEP == 0 {
            return Answer::Silence;
        }
        if ep.ctl & ctl::STALL != 0 {
            return Answer::Stall;
        }
        let bytes = ep.bytes_left().min(ep.max_packet());
        if !ep.ready() || ep.packets_left() == 0 || (ep.fifo.len() as u32) < bytes {
            return Answer::Nak;
        }
        let toggle = ep.ctl & ctl::DPID != 0;
        ep.ctl ^= ctl::DPID;
        let data = ep.fifo.drain(..bytes as usize).collect();
        // The FIFO holds whole words: what pads the last one goes with it.
        if ep.bytes_left() == bytes {
            ep.fifo.drain(..((4 - bytes as usize % 4) % 4).min(ep.fifo.len()));
        }
        ep.count_packet(bytes);
        if ep.packets_left() == 0 {
            ep.ctl &= !ctl::EPENA;
            ep.int |= int::XFRC;
            if endpoint == 0 && (self.dcfg >> 4 & 0x7f) as u8 != self.address {
                self.address = (self.dcfg >> 4 & 0x7f) as u8;
            }
        }
        Answer::Data(data, toggle)
    }

    fn pop_status(&mut self) -> u32 {
        let Some(received) = self.rx.pop_front() else { return 0 };
        let endpoint = (received.status & 0xf) as usize;
        match received.status >> 17 & 0xf {
            3 => self.outs[endpoint].int |= int::XFRC,
            4 => self.outs[endpoint].int |= int::STUP,
            _ => {}
        }
        self.popped = received.bytes.into();
        received.status
    }

    fn pop_word(&mut self) -> u32 {
        (0..4).fold(0, |word, n| word | u32::from(self.popped.pop_front().unwrap_or(0)) << (8 * n))
    }

    fn tx_words_free(&self, n: usize) -> u32 {
        (self.txflen[n] >> 16).saturating_sub(self.ins[n].fifo.len().div_ceil(4) as u32)
    }

    fn soft_reset(&mut self) {
        let keep = (self.vbus, self.gccfg, self.gusbcs);
        *self = Self::new(keep.0);
        (self.gccfg, self.gusbcs) = (keep.1, keep.2);
    }

    /// Reads a register.
    pub fn read(&mut self, offset: u32) -> u32 {
        match offset {
            0x000 => {
                let session = if self.vbus || self.ignores_vbus() { 3 << 18 } else { 0 };
                self.gotgcs & !(3 << 18) | session
            }
            0x004 => self.gotgint,
            0x008 => self.gahbcs,
            0x00c => self.gusbcs,
            0x010 => 0x8000_0000,
            0x014 => self.flags(),
            0x018 => self.ginten,
            0x01c => self.rx.front().map_or(0, |r| r.status),
            0x020 => self.pop_status(),
            0x024 => self.grflen,
            0x028 => self.txflen[0],
            0x038 => self.gccfg,
            0x03c => 0x1000,
            0x104..=0x10c => self.txflen[(offset as usize - 0x100) / 4],
            0x800 => self.dcfg,
            0x804 => self.dctl,
            // Full speed (ES = 3) and the frame number.
            0x808 => u32::from(self.suspended) | 3 << 1 | u32::from(self.frame) << 8,
            0x810 => self.diepinten,
            0x814 => self.doepinten,
            0x818 => self.daepint(),
            0x81c => self.daepinten,
            0x834 => self.diepfeinten,
            0x900..=0x97f => {
                let n = (offset as usize - 0x900) / 0x20;
                match offset & 0x1f {
                    0x00 => self.ins[n].ctl,
                    0x08 => {
                        self.ins[n].int | if self.ins[n].fifo.is_empty() { int::TXFE } else { 0 }
                    }
                    0x10 => self.ins[n].len,
                    0x18 => self.tx_words_free(n),
                    _ => 0,
                }
            }
            0xb00..=0xb7f => {
                let n = (offset as usize - 0xb00) / 0x20;
                match offset & 0x1f {
                    0x00 => self.outs[n].ctl,
                    0x08 => self.outs[n].int,
                    0x10 => self.outs[n].len,
                    _ => 0,
                }
            }
            0xe00 => self.pwrclk,
            0x1000.. => self.pop_word(),
            _ => 0,
        }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) {
        match offset {
            0x000 => self.gotgcs = value,
            0x004 => self.gotgint &= !value,
            0x008 => self.gahbcs = value,
            0x00c => self.gusbcs = value,
            0x010 => self.write_reset(value),
            0x014 => self.gintf &= !value,
            0x018 => self.ginten = value,
            0x024 => self.grflen = value & 0xffff,
            0x028 => self.txflen[0] = value,
            0x038 => self.gccfg = value,
            0x104..=0x10c => self.txflen[(offset as usize - 0x100) / 4] = value,
            0x800 => {
                self.dcfg = value;
                if value >> 4 & 0x7f == 0 {
                    self.address = 0;
                }
            }
            0x804 => self.dctl = value,
            0x810 => self.diepinten = value,
            0x814 => self.doepinten = value,
            0x81c => self.daepinten = value,
            0x834 => self.diepfeinten = value & 0xf,
            0x900..=0x97f => {
                let ep = &mut self.ins[(offset as usize - 0x900) / 0x20];
                match offset & 0x1f {
                    0x00 => ep.write_ctl(value, true),
                    0x08 => ep.int &= !value,
                    0x10 => ep.len = value,
                    _ => {}
                }
            }
            0xb00..=0xb7f => {
                let ep = &mut self.outs[(offset as usize - 0xb00) / 0x20];
                match offset & 0x1f {
                    0x00 => ep.write_ctl(value, false),
                    0x08 => ep.int &= !value,
                    0x10 => ep.len = value,
                    _ => {}
                }
            }
            0xe00 => self.pwrclk = value,
            0x1000.. => {
                let n = ((offset - 0x1000) / 0x1000) as usize;
                if n < ENDPOINTS && self.tx_words_free(n) > 0 {
                    self.ins[n].fifo.extend(value.to_le_bytes());
                }
            }
            _ => {}
        }
    }

    fn write_reset(&mut self, value: u32) {
        if value & 1 != 0 {
            self.soft_reset();
        }
        if value >> 4 & 1 != 0 {
            self.rx.clear();
            self.popped.clear();
        }
        if value >> 5 & 1 != 0 {
            let which = value >> 6 & 0x1f;
            for (n, ep) in self.ins.iter_mut().enumerate() {
                if which == 0x10 || which as usize == n {
                    ep.fifo.clear();
                }
            }
        }
    }

    /// Bits of a register that the core honours: `None` where it has no such register.
    #[must_use]
    pub fn modelled(offset: u32) -> Option<u32> {
        Some(match offset {
            // Session overrides are the host's; SRP and HNP are not modelled.
            0x000 => 0x000f_0800,
            0x004 => u32::MAX,
            0x008 => 1,
            // Turn-around and time-out calibration do not matter here, nor HNP and SRP on a device; bits
            // 6 and 7 are the fixed PHY.
            0x00c => 0x4000_3fc7,
            0x010 => 0x8000_0ff3,
            0x014 => u32::MAX,
            0x018 => 0xc00c_3c3c,
            0x01c | 0x020 | 0x03c => 0,
            0x024 => 0xffff,
            0x028 | 0x104 | 0x108 | 0x10c => u32::MAX,
            // GHWCFG4 of the original core: reserved here, reads 0. The driver looks at the width of
            // a PHY that this chip does not have.
            0x050 => 0,
            0x038 => 0x003d_0000,
            0x800 => 0x1ff7,
            // Soft disconnect and remote wake-up request.
            0x804 => 0x0003,
            0x808 | 0x818 => 0,
            0x810 => 0x003b,
            0x814 => 0x003b,
            0x81c => 0x000f_000f,
            0x834 => 0x000f,
            0x900..=0x97f | 0xb00..=0xb7f => match offset & 0x1f {
                0x00 | 0x08 | 0x10 => u32::MAX,
                0x18 if offset < 0xb00 => 0,
                _ => return None,
            },
            0xe00 => 3,
            0x1000..=0x4fff => u32::MAX,
            _ => return None,
        })
    }
}
