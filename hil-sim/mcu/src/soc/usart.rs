//! USART (user manual chapter 18): asynchronous 8-bit frames with the time of every byte, and the
//! far end of the wire.

use std::collections::VecDeque;

use super::peripheral::{Cx, DmaSource, NEVER, Peripheral, Signal};

mod stat {
    pub const FERR: u32 = 1 << 1;
    pub const ORERR: u32 = 1 << 3;
    pub const IDLEF: u32 = 1 << 4;
    pub const RBNE: u32 = 1 << 5;
    pub const TC: u32 = 1 << 6;
    pub const TBE: u32 = 1 << 7;
    pub const BSY: u32 = 1 << 16;
    pub const TEA: u32 = 1 << 21;
    pub const REA: u32 = 1 << 22;
}

/// The far end's clock may differ by this much (1/32) before a frame is misread.
const BAUD_TOLERANCE_DIVISOR: u64 = 32;

/// A byte that left the chip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SentByte {
    /// Cycle at which its stop bit ended.
    pub cycle: u64,
    /// The byte.
    pub byte: u8,
}

/// A USART and the bytes on its two wires.
#[derive(Debug)]
pub struct Usart {
    index: u8,
    irq: u16,
    ctl: [u32; 3],
    baud: u32,
    rt: u32,
    status: u32,
    rdr: u32,
    tdr: Option<u8>,
    shifting: Option<(u8, u64)>,
    /// Bytes that the far end has yet to send.
    incoming: VecDeque<u8>,
    /// Byte on the receive wire and the cycle of its stop bit.
    arriving: Option<(u8, u64)>,
    idle_at: Option<u64>,
    /// Baud rate of the far end.
    host_baud: u32,
    connected: bool,
    sent: Vec<SentByte>,
    next: u64,
}

impl Usart {
    /// USART0 or USART1 after reset.
    #[must_use]
    pub fn new(index: u8) -> Self {
        Self {
            index,
            irq: 27 + u16::from(index),
            ctl: [0; 3],
            baud: 0,
            rt: 0,
            status: stat::TC | stat::TBE,
            rdr: 0,
            tdr: None,
            shifting: None,
            incoming: VecDeque::new(),
            arriving: None,
            idle_at: None,
            host_baud: 2_000_000,
            connected: true,
            sent: Vec::new(),
            next: NEVER,
        }
    }

    /// Takes over the far end of the wire from the model before a reset.
    #[must_use]
    pub fn wired_as(mut self, before: &mut Usart) -> Self {
        self.host_baud = before.host_baud;
        self.connected = before.connected;
        self.incoming = std::mem::take(&mut before.incoming);
        self.sent = std::mem::take(&mut before.sent);
        self
    }

    /// 0 or 1.
    #[must_use]
    pub fn index(&self) -> u8 {
        self.index
    }

    /// Goes on after a reset of the chip: the far end keeps sending.
    pub fn after_reset(&mut self, cx: &mut Cx<'_>) {
        self.start_arrival(cx);
        self.reschedule();
    }

    /// Bytes that the far end sends, back to back from now on.
    pub fn host_send(&mut self, bytes: &[u8], cx: &mut Cx<'_>) {
        if self.connected {
            self.incoming.extend(bytes);
            self.start_arrival(cx);
            self.reschedule();
        }
    }

    /// Bytes that the far end has not begun to send.
    #[must_use]
    pub fn host_backlog(&self) -> usize {
        self.incoming.len()
    }

    /// Takes the bytes that left the chip so far.
    pub fn take_sent(&mut self) -> Vec<SentByte> {
        std::mem::take(&mut self.sent)
    }

    /// Sets the far end's baud rate.
    pub fn set_host_baud(&mut self, baud: u32) {
        self.host_baud = baud;
    }

    /// Plugs the wire in or pulls it: bytes under way are lost.
    pub fn set_connected(&mut self, connected: bool) {
        self.connected = connected;
        if !connected {
            self.incoming.clear();
            self.arriving = None;
            self.reschedule();
        }
    }

    fn enabled(&self, bit: u32) -> bool {
        self.ctl[0] & 1 != 0 && self.ctl[0] >> bit & 1 != 0
    }

    /// HCLK cycles of a frame: start, eight data, stop bits.
    fn frame_cycles(&self, cx: &Cx<'_>) -> u64 {
        let kernel_hz = if self.index == 0 {
            cx.clocks.usart0_hz
        } else {
            cx.clocks.hclk_hz / cx.clocks.apb1_div
        };
        let oversample8 = self.ctl[0] >> 15 & 1 != 0;
        let bit_clocks =
            if oversample8 { (self.baud >> 4) * 8 + (self.baud & 7) } else { self.baud };
        let stop_bits = if self.ctl[1] >> 12 & 3 == 2 { 2 } else { 1 };
        let clocks = u64::from(bit_clocks.max(1)) * (9 + stop_bits);
        (clocks * u64::from(cx.clocks.hclk_hz)).div_ceil(u64::from(kernel_hz.max(1)))
    }

    fn host_frame_cycles(&self, cx: &Cx<'_>) -> u64 {
        (10 * u64::from(cx.clocks.hclk_hz)).div_ceil(u64::from(self.host_baud))
    }

    fn start_arrival(&mut self, cx: &Cx<'_>) {
        if self.arriving.is_none()
            && let Some(byte) = self.incoming.pop_front()
        {
            self.arriving = Some((byte, cx.now + self.host_frame_cycles(cx)));
            self.idle_at = None;
        }
    }

    fn start_shift(&mut self, cx: &mut Cx<'_>) {
        if self.shifting.is_none()
            && self.enabled(3)
            && let Some(byte) = self.tdr.take()
        {
            self.shifting = Some((byte, cx.now + self.frame_cycles(cx)));
            self.status |= stat::TBE;
            self.status &= !stat::TC;
        }
    }

    fn receive(&mut self, byte: u8, cx: &mut Cx<'_>) {
        if !self.enabled(2) {
            return;
        }
        let (own, far) = (self.frame_cycles(cx), self.host_frame_cycles(cx));
        let misread = own.abs_diff(far) > far / BAUD_TOLERANCE_DIVISOR;
        if misread {
            self.status |= stat::FERR;
        }
        if self.status & stat::RBNE != 0 && self.ctl[2] >> 12 & 1 == 0 {
            self.status |= stat::ORERR;
        } else {
            self.rdr = u32::from(if misread { byte.rotate_left(3) ^ 0x5a } else { byte });
            self.status |= stat::RBNE;
        }
    }

    fn reschedule(&mut self) {
        self.next = [self.shifting.map(|s| s.1), self.arriving.map(|a| a.1), self.idle_at]
            .into_iter()
            .flatten()
            .min()
            .unwrap_or(NEVER);
    }

    /// Interrupt and DMA request levels from the status.
    fn raise(&mut self, cx: &mut Cx<'_>) {
        let on = |bit: u32| self.ctl[0] >> bit & 1 != 0;
        let error_ie = self.ctl[2] & 1 != 0 && self.ctl[2] >> 6 & 1 != 0;
        let s = self.status;
        let active = on(7) && s & stat::TBE != 0
            || on(6) && s & stat::TC != 0
            || on(5) && s & (stat::RBNE | stat::ORERR) != 0
            || on(4) && s & stat::IDLEF != 0
            || error_ie && s & (stat::FERR | stat::ORERR) != 0;
        cx.out.push(Signal::Irq(self.irq, active && self.ctl[0] & 1 != 0));
        let rx = self.ctl[2] >> 6 & 1 != 0 && s & stat::RBNE != 0 && self.enabled(2);
        let tx = self.ctl[2] >> 7 & 1 != 0 && s & stat::TBE != 0 && self.enabled(3);
        cx.out.push(Signal::DmaLevel(DmaSource::UsartRx(self.index), rx));
        cx.out.push(Signal::DmaLevel(DmaSource::UsartTx(self.index), tx));
    }
}

impl Peripheral for Usart {
    fn read(&mut self, offset: u32, cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 | 0x04 | 0x08 => self.ctl[offset as usize / 4],
            0x0c => self.baud,
            0x14 => self.rt,
            0x1c => {
                self.status
                    | if self.arriving.is_some() { stat::BSY } else { 0 }
                    | if self.enabled(3) { stat::TEA } else { 0 }
                    | if self.enabled(2) { stat::REA } else { 0 }
            }
            0x24 => {
                self.status &= !stat::RBNE;
                self.raise(cx);
                self.rdr
            }
            // The receive buffer is empty: the FIFO is not used.
            0xd0 => 0x400,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        match offset {
            0x00 => {
                self.ctl[0] = value;
                if value & 1 == 0 {
                    self.status = stat::TC | stat::TBE;
                    self.tdr = None;
                }
                self.start_shift(cx);
            }
            0x04 | 0x08 => self.ctl[offset as usize / 4] = value,
            0x0c => self.baud = value & 0xffff,
            0x14 => self.rt = value,
            0x18 => {
                if value >> 3 & 1 != 0 {
                    self.status &= !stat::RBNE;
                }
                if value >> 4 & 1 != 0 {
                    self.tdr = None;
                    self.status |= stat::TBE;
                }
            }
            0x20 => self.status &= !(value & (stat::FERR | stat::ORERR | stat::IDLEF | stat::TC)),
            0x28 => {
                if self.ctl[0] & 1 != 0 {
                    self.tdr = Some(value as u8);
                    self.status &= !(stat::TBE | stat::TC);
                    self.start_shift(cx);
                }
            }
            _ => return,
        }
        self.reschedule();
        self.raise(cx);
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            // 8 data bits without parity, oversampling by 8 or 16.
            0x00 => Some(0x0000_80fd),
            0x04 => Some(0x3000),
            // OSB and one-sample mode make no difference on a clean wire; DDRE keeps DMA on errors.
            0x08 => Some(0x38c1),
            0x0c => Some(0xffff),
            0x14 => Some(0),
            0x18 => Some(0x18),
            0x1c => Some(0),
            0x20 => Some(0x0012_1b5f),
            0x24 => Some(0),
            0x28 => Some(0x1ff),
            0xd0 => Some(0),
            _ => None,
        }
    }

    fn next_event(&self) -> u64 {
        self.next
    }

    fn event(&mut self, cx: &mut Cx<'_>) {
        if let Some((byte, at)) = self.shifting
            && at <= cx.now
        {
            self.shifting = None;
            if self.connected {
                self.sent.push(SentByte { cycle: cx.now, byte });
            }
            if self.tdr.is_some() {
                self.start_shift(cx);
            } else {
                self.status |= stat::TC;
            }
        }
        if let Some((byte, at)) = self.arriving
            && at <= cx.now
        {
            self.arriving = None;
            self.receive(byte, cx);
            self.start_arrival(cx);
            if self.arriving.is_none() {
                self.idle_at = Some(cx.now + self.host_frame_cycles(cx));
            }
        }
        if self.idle_at.is_some_and(|at| at <= cx.now) {
            self.idle_at = None;
            if self.enabled(2) {
                self.status |= stat::IDLEF;
            }
        }
        self.reschedule();
        self.raise(cx);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clocks;

    fn at<T>(usart: &mut Usart, now: u64, act: impl FnOnce(&mut Usart, &mut Cx<'_>) -> T) -> T {
        let clocks = Clocks::after_reset();
        act(usart, &mut Cx { now, clocks: &clocks, out: &mut Vec::new() })
    }

    fn enabled() -> Usart {
        let mut usart = Usart::new(0);
        usart.set_host_baud(1_000_000);
        at(&mut usart, 0, |u, cx| {
            u.write(0x0c, 8, cx);
            u.write(0x00, 0xd, cx);
        });
        usart
    }

    #[test]
    fn a_byte_takes_ten_bits_each_way() {
        let mut usart = enabled();
        at(&mut usart, 100, |u, cx| u.write(0x28, 0xa5, cx));
        assert_eq!(usart.next_event(), 180);
        at(&mut usart, 180, |u, cx| u.event(cx));
        assert_eq!(usart.take_sent(), [SentByte { cycle: 180, byte: 0xa5 }]);
        at(&mut usart, 200, |u, cx| u.host_send(&[0x11, 0x22], cx));
        at(&mut usart, 280, |u, cx| u.event(cx));
        assert_eq!(at(&mut usart, 281, |u, cx| u.read(0x24, cx)), 0x11);
        at(&mut usart, 360, |u, cx| u.event(cx));
        assert_eq!(at(&mut usart, 361, |u, cx| u.read(0x24, cx)), 0x22);
    }

    #[test]
    fn an_unread_byte_is_overrun_and_a_wrong_baud_rate_is_misread() {
        let mut usart = enabled();
        at(&mut usart, 0, |u, cx| u.host_send(&[1, 2], cx));
        at(&mut usart, 80, |u, cx| u.event(cx));
        at(&mut usart, 160, |u, cx| u.event(cx));
        assert_ne!(at(&mut usart, 161, |u, cx| u.read(0x1c, cx)) & stat::ORERR, 0);
        assert_eq!(at(&mut usart, 161, |u, cx| u.read(0x24, cx)), 1);
        usart.set_host_baud(900_000);
        at(&mut usart, 1000, |u, cx| u.host_send(&[7], cx));
        let due = usart.next_event();
        at(&mut usart, due, |u, cx| u.event(cx));
        assert_ne!(at(&mut usart, due, |u, cx| u.read(0x1c, cx)) & stat::FERR, 0);
    }
}
