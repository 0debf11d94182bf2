//! One endpoint of the USB device core, IN or OUT.

use std::collections::VecDeque;

/// Bits of DIEPxCTL and DOEPxCTL.
pub mod ctl {
    /// Endpoint active in the configuration.
    pub const USBAEP: u32 = 1 << 15;
    /// Data PID of the next packet (DATA1 when set).
    pub const DPID: u32 = 1 << 16;
    /// Answers NAK.
    pub const NAKSTS: u32 = 1 << 17;
    /// Answers STALL.
    pub const STALL: u32 = 1 << 21;
    /// Write: stop answering NAK.
    pub const CNAK: u32 = 1 << 26;
    /// Write: answer NAK.
    pub const SNAK: u32 = 1 << 27;
    /// Write: the next packet is DATA0.
    pub const SD0PID: u32 = 1 << 28;
    /// Write: the next packet is DATA1.
    pub const SD1PID: u32 = 1 << 29;
    /// Write: disable.
    pub const EPDIS: u32 = 1 << 30;
    /// Enabled.
    pub const EPENA: u32 = 1 << 31;
    /// Bits that keep what was written.
    pub const STORED: u32 = 0x07ff | USBAEP | 0xc_0000 | 1 << 20 | STALL | 0x03c0_0000;
}

/// Bits of DIEPxINTF and DOEPxINTF.
pub mod int {
    /// Transfer completed.
    pub const XFRC: u32 = 1;
    /// Endpoint disabled.
    pub const EPDISD: u32 = 1 << 1;
    /// OUT: SETUP phase done.
    pub const STUP: u32 = 1 << 3;
    /// IN: NAK became effective.
    pub const INEPNE: u32 = 1 << 6;
    /// IN: transmit FIFO empty.
    pub const TXFE: u32 = 1 << 7;
}

/// Registers and FIFO of one direction of one endpoint.
#[derive(Debug, Default, Clone)]
pub struct Endpoint {
    /// DxEPxCTL.
    pub ctl: u32,
    /// DxEPxINTF, without TXFE.
    pub int: u32,
    /// DxEPxLEN.
    pub len: u32,
    /// IN: bytes in the transmit FIFO.
    pub fifo: VecDeque<u8>,
    number: usize,
}

impl Endpoint {
    /// Endpoint `number` after reset.
    #[must_use]
    pub fn new(number: usize) -> Self {
        // Endpoint 0 is always active.
        let ctl = if number == 0 { ctl::USBAEP } else { 0 };
        Self { ctl, number, ..Self::default() }
    }

    /// Largest packet in bytes.
    #[must_use]
    pub fn max_packet(&self) -> u32 {
        if self.number == 0 { 64 >> (self.ctl & 3) } else { self.ctl & 0x7ff }
    }

    /// Bytes left of the transfer.
    #[must_use]
    pub fn bytes_left(&self) -> u32 {
        if self.number == 0 { self.len & 0x7f } else { self.len & 0x7_ffff }
    }

    /// Packets left of the transfer.
    #[must_use]
    pub fn packets_left(&self) -> u32 {
        if self.number == 0 { self.len >> 19 & 3 } else { self.len >> 19 & 0x3ff }
    }

    /// Takes a packet of `bytes` off the transfer.
    pub fn count_packet(&mut self, bytes: u32) {
        let mask = if self.number == 0 { 0x7f } else { 0x7_ffff };
        let left = self.bytes_left().saturating_sub(bytes);
        self.len = self.len & !mask | left;
        if self.packets_left() > 0 {
            self.len -= 1 << 19;
        }
    }

    /// Whether the endpoint takes part in transfers now.
    #[must_use]
    pub fn ready(&self) -> bool {
        self.ctl & ctl::EPENA != 0 && self.ctl & ctl::NAKSTS == 0
    }

    /// A write to the control register.
    pub fn write_ctl(&mut self, value: u32, is_in: bool) {
        let mut next = self.ctl & !ctl::STORED | value & ctl::STORED;
        if self.number == 0 {
            next |= ctl::USBAEP;
            // Software can only set STALL of endpoint 0; the next SETUP clears it.
            next |= self.ctl & ctl::STALL;
        }
        if value & ctl::SNAK != 0 {
            next |= ctl::NAKSTS;
            if is_in {
                self.int |= int::INEPNE;
            }
        }
        if value & ctl::CNAK != 0 {
            next &= !ctl::NAKSTS;
            self.int &= !int::INEPNE;
        }
        if value & ctl::SD0PID != 0 {
            next &= !ctl::DPID;
        }
        if value & ctl::SD1PID != 0 {
            next |= ctl::DPID;
        }
        if value & ctl::EPENA != 0 {
            next |= ctl::EPENA;
        }
        if value & ctl::EPDIS != 0 && next & ctl::EPENA != 0 {
            next &= !ctl::EPENA;
            self.int |= int::EPDISD;
        }
        self.ctl = next;
    }
}
