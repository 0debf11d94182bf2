//! Timers (user manual chapters 14-17), counted in HCLK cycles without stepping: a timer knows the
//! cycle at which its counter took its present value, and the cycle of its next match or overflow.
//!
//! Modelled: up counting, prescaler, repetition, preload, single pulse, output compare and PWM,
//! complementary outputs without dead time, break, input capture, DMA requests, trigger output,
//! slave modes reset, trigger and external clock from another timer. Counting starts with the write
//! of CEN; the one or two cycles of synchronisation of a real timer are left out, equally for every
//! timer.

mod count;
mod kind;
mod output;

pub use kind::TimerKind;

use super::peripheral::{Cx, DmaSource, NEVER, Peripheral, Signal, TimerId};

pub(super) const CEN: u32 = 1;
const UPDIS: u32 = 1 << 1;
const UPS: u32 = 1 << 2;
const SPM: u32 = 1 << 3;
const ARSE: u32 = 1 << 7;
const POEN: u32 = 1 << 15;

/// One timer.
#[derive(Debug)]
pub struct Timer {
    id: TimerId,
    kind: &'static TimerKind,
    ctl0: u32,
    ctl1: u32,
    smcfg: u32,
    dmainten: u32,
    intf: u32,
    chctl: [u32; 2],
    chctl2: u32,
    psc: u32,
    car: u32,
    crep: u32,
    ccv: [u32; 4],
    cchp: u32,
    cfg: u32,
    dmacfg: u32,
    /// Beats of a DMA burst made so far.
    burst: u32,
    psc_active: u32,
    car_active: u32,
    ccv_active: [u32; 4],
    repetitions_left: u32,
    cnt: u32,
    /// Cycle at which `cnt` took its value, while the timer counts its own clock.
    tick_at: u64,
    ocref: [bool; 4],
    driven: [Option<bool>; 7],
    break_level: bool,
    held: bool,
    next: u64,
}

impl Timer {
    /// The timer after reset.
    #[must_use]
    pub fn new(id: TimerId) -> Self {
        let kind = TimerKind::of(id);
        let max = kind.max();
        Self {
            id,
            kind,
            ctl0: 0,
            ctl1: 0,
            smcfg: 0,
            dmainten: 0,
            intf: 0,
            chctl: [0; 2],
            chctl2: 0,
            psc: 0,
            car: max,
            crep: 0,
            ccv: [0; 4],
            cchp: 0,
            cfg: 0,
            dmacfg: 0,
            burst: 0,
            psc_active: 0,
            car_active: max,
            ccv_active: [0; 4],
            repetitions_left: 0,
            cnt: 0,
            tick_at: 0,
            ocref: [false; 4],
            driven: [None; 7],
            break_level: false,
            held: false,
            next: NEVER,
        }
    }

    /// Holds or releases the counter (debug halt with the hold bit set). Outputs keep their level,
    /// the worst case for the light.
    pub fn hold(&mut self, held: bool, cx: &mut Cx<'_>) {
        if self.held != held {
            self.settle(cx);
            self.held = held;
            self.tick_at = cx.now;
            self.reschedule(cx);
        }
    }

    /// Starts a count of pending interrupts over: the lines of this timer.
    fn raise(&self, cx: &mut Cx<'_>) {
        let active = self.intf & self.dmainten & 0xff;
        if let Some(cc) = self.kind.irq_channels {
            cx.out.push(Signal::Irq(cc, active & 0x1e != 0));
            cx.out.push(Signal::Irq(self.kind.irq, active & !0x1e != 0));
        } else {
            cx.out.push(Signal::Irq(self.kind.irq, active != 0));
        }
    }

    fn flag(&mut self, bit: u32, cx: &mut Cx<'_>) {
        self.intf |= 1 << bit;
        self.raise(cx);
    }

    fn software_event(&mut self, value: u32, cx: &mut Cx<'_>) {
        if value & 1 != 0 {
            self.cnt = 0;
            self.tick_at = cx.now;
            self.update(true, cx);
            self.refresh_pwm(cx);
        }
        for ch in 0..self.kind.channels {
            if value >> (ch + 1) & 1 != 0 {
                self.channel_event(ch, cx);
            }
        }
        if value & 1 << 6 != 0 {
            self.trigger_event(cx);
        }
        if value & 1 << 7 != 0 && self.kind.break_input {
            self.trip_break(cx);
        }
    }

    fn trigger_event(&mut self, cx: &mut Cx<'_>) {
        self.flag(6, cx);
        if self.dmainten >> 14 & 1 != 0 {
            cx.out.push(Signal::DmaPulse(DmaSource::TimerTrigger(self.id)));
        }
    }

    /// The break input's level, already with the pin's own polarity.
    pub fn set_break_input(&mut self, high: bool, cx: &mut Cx<'_>) {
        self.break_level = high;
        self.check_break(cx);
    }

    /// An internal break source (a locked-up core, a clock failure).
    pub fn break_now(&mut self, cx: &mut Cx<'_>) {
        if self.kind.break_input && self.cchp >> 12 & 1 != 0 {
            self.trip_break(cx);
        }
    }

    fn check_break(&mut self, cx: &mut Cx<'_>) {
        let enabled = self.cchp >> 12 & 1 != 0;
        let active_high = self.cchp >> 13 & 1 != 0;
        if enabled && self.kind.break_input && self.break_level == active_high {
            self.trip_break(cx);
        }
    }

    fn trip_break(&mut self, cx: &mut Cx<'_>) {
        self.cchp &= !POEN;
        self.flag(7, cx);
        self.drive_outputs(cx);
    }

    /// Whether another timer's trigger output reaches this timer, and what it does there.
    pub fn on_trgo(&mut self, from: TimerId, cx: &mut Cx<'_>) {
        let selected = (self.smcfg >> 4 & 7) as usize;
        if self.kind.internal_triggers.get(selected).copied().flatten() != Some(from) {
            return;
        }
        match self.smcfg & 7 {
            4 => {
                self.settle(cx);
                self.cnt = 0;
                self.tick_at = cx.now;
                self.update(false, cx);
                self.refresh_pwm(cx);
                self.trigger_event(cx);
            }
            6 => {
                self.settle(cx);
                if self.ctl0 & CEN == 0 {
                    self.ctl0 |= CEN;
                    self.tick_at = cx.now;
                }
                self.trigger_event(cx);
            }
            7 => {
                if self.ctl0 & CEN != 0 {
                    self.tick(cx);
                }
                self.trigger_event(cx);
            }
            _ => {}
        }
        self.reschedule(cx);
    }

    /// A level at the input of channel `ch`: captures on the edge that the channel asks for.
    pub fn channel_input(&mut self, ch: u8, high: bool, cx: &mut Cx<'_>) {
        let ch = usize::from(ch);
        // CHxMS = 1: the channel's own input, unfiltered.
        if self.mode_bits(ch) & 3 != 1 || self.chctl2 >> (4 * ch) & 1 == 0 {
            return;
        }
        let falling = self.chctl2 >> (4 * ch + 1) & 1 != 0;
        let both = falling && self.chctl2 >> (4 * ch + 3) & 1 != 0;
        if both || high != falling {
            self.settle(cx);
            self.ccv[ch] = self.cnt;
            if self.intf >> (ch + 1) & 1 != 0 {
                self.intf |= 1 << (ch + 9);
            }
            self.channel_event(ch, cx);
        }
    }

    /// A write through DMATB: goes to the next register of the burst, and asks for the next beat
    /// (user manual, TIMERx_DMACFG: DMATA is the first register, DMATC the beats less one).
    fn burst_beat(&mut self, value: u32, cx: &mut Cx<'_>) {
        let first = self.dmacfg & 0x1f;
        let beats = (self.dmacfg >> 8 & 0x1f) + 1;
        let offset = 4 * (first + self.burst);
        self.burst = (self.burst + 1) % beats;
        if self.burst != 0 {
            cx.out.push(Signal::DmaBurst);
        }
        if offset != 0x4c {
            self.write(offset, value, cx);
        }
    }

    fn write_cchp(&mut self, value: u32, cx: &mut Cx<'_>) {
        // PROT locks what it names until reset (user manual: complementary channel protection).
        let mut fixed = match self.cchp >> 8 & 3 {
            0 => 0,
            1 => 0x70ff,
            _ => 0x7cff,
        };
        if self.cchp >> 8 & 3 != 0 {
            fixed |= 0x300;
        }
        self.cchp = self.cchp & fixed | value & !fixed & 0xffff;
        self.check_break(cx);
    }
}

impl Peripheral for Timer {
    fn read(&mut self, offset: u32, cx: &mut Cx<'_>) -> u32 {
        self.settle(cx);
        match offset {
            0x00 => self.ctl0,
            0x04 => self.ctl1,
            0x08 => self.smcfg,
            0x0c => self.dmainten,
            0x10 => self.intf,
            0x18 => self.chctl[0],
            0x1c => self.chctl[1],
            0x20 => self.chctl2,
            0x24 => self.cnt,
            0x28 => self.psc,
            0x2c => self.car,
            0x30 => self.crep,
            0x34..=0x40 => {
                let ch = (offset as usize - 0x34) / 4;
                if self.mode_bits(ch) & 3 != 0 {
                    // Reading a capture clears its flag.
                    self.intf &= !(1 << (ch + 1));
                    self.raise(cx);
                }
                self.ccv[ch]
            }
            0x44 => self.cchp,
            0x48 => self.dmacfg,
            0xfc => self.cfg,
            _ => 0,
        }
    }

    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>) {
        self.settle(cx);
        match offset {
            0x00 => {
                let started = value & CEN != 0 && self.ctl0 & CEN == 0;
                self.ctl0 = value & 0x3ff;
                if started {
                    self.tick_at = cx.now;
                    if self.ctl1 >> 4 & 7 == 1 {
                        cx.out.push(Signal::Trgo(self.id));
                    }
                }
            }
            0x04 => self.ctl1 = value & 0x7fff,
            0x08 => self.smcfg = value & 0xffff,
            0x0c => {
                self.dmainten = value & 0x7fff;
                self.raise(cx);
            }
            0x10 => {
                // Flags are cleared by writing 0.
                self.intf &= value;
                self.raise(cx);
            }
            0x14 => self.software_event(value, cx),
            0x18 | 0x1c => {
                self.chctl[(offset as usize - 0x18) / 4] = value & 0xffff;
                self.refresh_forced(cx);
            }
            0x20 => {
                self.chctl2 = value & 0xffff;
                self.drive_outputs(cx);
            }
            0x24 => {
                self.cnt = value & self.kind.max();
                self.tick_at = cx.now;
                self.refresh_pwm(cx);
            }
            0x28 => self.psc = value & 0xffff,
            0x2c => {
                self.car = value & self.kind.max();
                if self.ctl0 & ARSE == 0 {
                    self.car_active = self.car;
                }
            }
            0x30 => self.crep = value & 0xff,
            0x34..=0x40 => {
                let ch = (offset as usize - 0x34) / 4;
                self.ccv[ch] = value & self.kind.max();
                // CHxCOMSEN: the shadow is loaded at the update event.
                if self.mode_bits(ch) >> 3 & 1 == 0 {
                    self.ccv_active[ch] = self.ccv[ch];
                    self.refresh_pwm(cx);
                }
            }
            0x44 => {
                self.write_cchp(value, cx);
                self.drive_outputs(cx);
            }
            0x48 => {
                self.dmacfg = value & 0x1f1f;
                self.burst = 0;
            }
            0x4c => self.burst_beat(value, cx),
            0xfc => self.cfg = value & 3,
            _ => return,
        }
        self.drive_outputs(cx);
        self.reschedule(cx);
    }

    fn modelled(&self, offset: u32) -> Option<u32> {
        self.kind.modelled(offset)
    }

    fn next_event(&self) -> u64 {
        self.next
    }

    fn event(&mut self, cx: &mut Cx<'_>) {
        self.advance(cx);
        self.reschedule(cx);
    }

    fn before_clock_change(&mut self, cx: &mut Cx<'_>) {
        self.settle(cx);
    }

    fn after_clock_change(&mut self, cx: &mut Cx<'_>) {
        // The prescaler's own count is lost: at most one tick.
        self.tick_at = cx.now;
        self.reschedule(cx);
    }
}

#[cfg(test)]
mod tests;
