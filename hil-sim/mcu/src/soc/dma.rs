//! DMA controller (user manual chapter 9): seven channels, fixed request map with SYSCFG remaps.
//!
//! Timing: one transfer at a time. A request is served [`TRANSFER_CYCLES`] HCLK cycles after it came
//! when the controller is idle; otherwise it waits for the transfer in progress and for channels of
//! higher priority. The manual gives no figure for this chip; the value is that of the STM32F0's
//! identical controller (AN2548: arbitration, address, read, write, acknowledge) and not proven on
//! hardware. Waiting for the bus matrix behind the core is not modelled: it adds at most two cycles.

use super::peripheral::{Cx, DmaSource, NEVER, Peripheral, Signal, TimerId};

/// Cycles from a request to the write that ends its transfer.
pub const TRANSFER_CYCLES: u64 = 6;

const CHANNELS: usize = 7;
const CHEN: u32 = 1;
const DIR_FROM_MEMORY: u32 = 1 << 4;
const CIRCULAR: u32 = 1 << 5;
const M2M: u32 = 1 << 14;

#[derive(Debug, Default, Clone, Copy)]
struct Channel {
    ctl: u32,
    cnt: u32,
    paddr: u32,
    maddr: u32,
    /// Count that a circular channel reloads.
    reload: u32,
    /// Transfers done since the channel was enabled or reloaded.
    done: u32,
    /// A latched pulse request.
    pulse: bool,
}

/// One bus transfer that the chip has to make for the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transfer {
    /// Channel number.
    pub channel: u8,
    /// Address and width in bytes of the read.
    pub from: (u32, u32),
    /// Address and width in bytes of the write.
    pub to: (u32, u32),
}

/// The DMA controller.
#[derive(Debug, Default)]
pub struct Dma {
    flags: u32,
    channels: [Channel; CHANNELS],
    levels: Vec<DmaSource>,
    remap: u32,
    in_flight: Option<(Transfer, u64)>,
    /// A transfer is being made; its count is not up to date yet.
    transferring: bool,
}

impl Dma {
    /// The channel that serves `source` under the remap bits of SYSCFG_CFG0.
    ///
    /// Channels of ADC, USART0_TX, TIMER0_UP are the vendor's; the rest follows the identical map of
    /// the STM32F0 (inferred).
    fn channel_of(&self, source: DmaSource) -> Option<u8> {
        let remap = |bit: u32, off: u8, on: u8| if self.remap >> bit & 1 != 0 { on } else { off };
        Some(match source {
            DmaSource::Adc => remap(8, 0, 1),
            DmaSource::UsartTx(0) => remap(9, 1, 3),
            DmaSource::UsartRx(0) => remap(10, 2, 4),
            DmaSource::UsartTx(_) => 3,
            DmaSource::UsartRx(_) => 4,
            DmaSource::TimerChannel(TimerId::T0, 0) => 1,
            DmaSource::TimerChannel(TimerId::T0, 1) => 2,
            DmaSource::TimerChannel(TimerId::T0, 2) => 4,
            DmaSource::TimerChannel(TimerId::T0, 3) | DmaSource::TimerTrigger(TimerId::T0) => 3,
            DmaSource::TimerUpdate(TimerId::T0) => 4,
            DmaSource::TimerUpdate(TimerId::T1) => 1,
            DmaSource::TimerChannel(TimerId::T1, 0) => 4,
            DmaSource::TimerChannel(TimerId::T1, 1) => 2,
            DmaSource::TimerChannel(TimerId::T1, 2) => 0,
            DmaSource::TimerChannel(TimerId::T1, 3) => 3,
            DmaSource::TimerUpdate(TimerId::T2) | DmaSource::TimerChannel(TimerId::T2, 3) => 2,
            DmaSource::TimerChannel(TimerId::T2, 0) | DmaSource::TimerTrigger(TimerId::T2) => 3,
            DmaSource::TimerChannel(TimerId::T2, 2) => 1,
            DmaSource::TimerUpdate(TimerId::T14)
            | DmaSource::TimerTrigger(TimerId::T14)
            | DmaSource::TimerChannel(TimerId::T14, 0) => 4,
            DmaSource::TimerUpdate(TimerId::T15) | DmaSource::TimerChannel(TimerId::T15, 0) => {
                remap(11, 2, 3)
            }
            DmaSource::TimerUpdate(TimerId::T16) | DmaSource::TimerChannel(TimerId::T16, 0) => {
                remap(12, 0, 1)
            }
            _ => return None,
        })
    }

    /// Takes the remap bits of SYSCFG_CFG0.
    pub fn set_remap(&mut self, cfg0: u32) {
        self.remap = cfg0;
    }

    /// One request of a source that latches (timers). Lost where its channel is off.
    pub fn request(&mut self, source: DmaSource, cx: &Cx<'_>) {
        if let Some(n) = self.channel_of(source)
            && self.channels[usize::from(n)].ctl & CHEN != 0
        {
            self.channels[usize::from(n)].pulse = true;
            self.arbitrate(cx.now);
        }
    }

    /// Another request for channel `n` (a timer's burst goes on).
    pub fn request_again(&mut self, n: u8) {
        self.channels[usize::from(n)].pulse = true;
    }

    /// A request that stays until it is served (USART, ADC).
    pub fn set_level(&mut self, source: DmaSource, active: bool, cx: &Cx<'_>) {
        self.levels.retain(|s| *s != source);
        if active {
            self.levels.push(source);
            self.arbitrate(cx.now);
        }
    }

    fn wants(&self, n: usize) -> bool {
        let channel = &self.channels[n];
        channel.ctl & CHEN != 0
            && channel.cnt > 0
            && (channel.ctl & M2M != 0
                || channel.pulse
                || self.levels.iter().any(|s| self.channel_of(*s) == Some(n as u8)))
    }

    fn arbitrate(&mut self, now: u64) {
        if self.in_flight.is_some() || self.transferring {
            return;
        }
        // Higher PRIO first, then the lower channel number.
        let winner = (0..CHANNELS)
            .filter(|&n| self.wants(n))
            .max_by_key(|&n| (self.channels[n].ctl >> 12 & 3, CHANNELS - n));
        if let Some(n) = winner {
            self.in_flight = Some((self.start(n), now + TRANSFER_CYCLES));
        }
    }

    fn start(&mut self, n: usize) -> Transfer {
        let channel = &mut self.channels[n];
        channel.pulse = false;
        let width = |field: u32| 1 << (field & 3).min(2);
        let (pwidth, mwidth) = (width(channel.ctl >> 8), width(channel.ctl >> 10));
        let step = |on: u32, width: u32, done: u32| if on != 0 { width * done } else { 0 };
        let peripheral = (channel.paddr + step(channel.ctl >> 6 & 1, pwidth, channel.done), pwidth);
        let memory = (channel.maddr + step(channel.ctl >> 7 & 1, mwidth, channel.done), mwidth);
        let (from, to) = if channel.ctl & DIR_FROM_MEMORY != 0 {
            (memory, peripheral)
        } else {
            (peripheral, memory)
        };
        Transfer { channel: n as u8, from, to }
    }

    /// Ends the transfer in flight: what the chip must read and write now. A transfer that has begun
    /// is made even when its channel was switched off meanwhile (the worst case for a firmware that
    /// wants its outputs off).
    pub fn take_transfer(&mut self) -> Option<Transfer> {
        let (transfer, _) = self.in_flight.take()?;
        self.transferring = true;
        Some(transfer)
    }

    /// Accounts for the transfer that the chip has made (or that ended in a bus error).
    pub fn complete(&mut self, transfer: Transfer, failed: bool, cx: &mut Cx<'_>) {
        self.transferring = false;
        let n = usize::from(transfer.channel);
        let channel = &mut self.channels[n];
        let shift = 4 * n;
        if channel.ctl & CHEN == 0 || channel.cnt == 0 {
            return;
        }
        if failed {
            channel.ctl &= !CHEN;
            self.flags |= 0x9 << shift;
        } else {
            channel.done += 1;
            channel.cnt -= 1;
            if channel.cnt == channel.reload / 2 {
                self.flags |= 0x5 << shift;
            }
            if channel.cnt == 0 {
                self.flags |= 0x3 << shift;
                if channel.ctl & CIRCULAR != 0 {
                    channel.cnt = channel.reload;
                    channel.done = 0;
                }
            }
        }
        self.raise(cx);
    }

    /// Starts the next waiting transfer.
    pub fn next(&mut self, now: u64) {
        self.arbitrate(now);
    }

    fn raise(&self, cx: &mut Cx<'_>) {
        let active = |n: usize| {
            let enabled = self.channels[n].ctl & 0xe;
            self.flags >> (4 * n) & enabled != 0
        };
        cx.out.push(Signal::Irq(9, active(0)));
        cx.out.push(Signal::Irq(10, active(1) || active(2)));
        cx.out.push(Signal::Irq(11, active(3) || active(4)));
        cx.out.push(Signal::Irq(48, active(5) || active(6)));
    }
}

impl Peripheral for Dma {
    fn read(&mut self, offset: u32, _cx: &mut Cx<'_>) -> u32 {
        match offset {
            0x00 => self.flags,
            0x08..=0x90 => {
                let channel = &self.channels[(offset as usize - 8) / 20];
                match (offset - 8) % 20 {
                    0 => channel.ctl,
                    4 => channel.cnt,
                    8 => channel.paddr,
                    12 => channel.maddr,
                    _ => 0,
                }
            }
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        match offset {
            0x04 => {
                for n in 0..CHANNELS {
                    let clear = value >> (4 * n) & 0xf;
                    // Clearing the global flag clears all four.
                    let clear = if clear & 1 != 0 { 0xf } else { clear };
                    self.flags &= !(clear << (4 * n));
                    if self.flags >> (4 * n) & 0xe == 0 {
                        self.flags &= !(1 << (4 * n));
                    }
                }
            }
            0x08..=0x90 => {
                let n = (offset as usize - 8) / 20;
                let channel = &mut self.channels[n];
                let on = channel.ctl & CHEN != 0;
                match (offset - 8) % 20 {
                    0 => {
                        channel.ctl = value & 0x7fff;
                        if !on && value & CHEN != 0 {
                            channel.reload = channel.cnt;
                            channel.done = 0;
                            channel.pulse = false;
                        }
                        self.arbitrate(cx.now);
                    }
                    // Count and addresses can be changed only while the channel is off.
                    4 if !on => channel.cnt = value & 0xffff,
                    8 if !on => channel.paddr = value,
                    12 if !on => channel.maddr = value,
                    _ => {}
                }
            }
            _ => return,
        }
        self.raise(cx);
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        match offset {
            0x00 | 0x04 => Some(0x0fff_ffff),
            0x08..=0x90 => match (offset - 8) % 20 {
                0 => Some(0x7fff),
                4 => Some(0xffff),
                8 | 12 => Some(u32::MAX),
                _ => None,
            },
            _ => None,
        }
    }

    fn next_event(&self) -> u64 {
        self.in_flight.map_or(NEVER, |(_, at)| at)
    }
}
