//! Counting: where the counter stands at a cycle, the next match or overflow, and what they do.

use super::super::peripheral::{Cx, DmaSource, NEVER, Signal};
use super::{ARSE, CEN, SPM, Timer, UPDIS, UPS};

impl Timer {
    /// HCLK cycles per counter tick.
    fn tick_cycles(&self, cx: &Cx<'_>) -> u64 {
        let clock =
            if self.kind.apb2 { cx.clocks.timer_apb2_div } else { cx.clocks.timer_apb1_div };
        u64::from(clock) * (u64::from(self.psc_active) + 1)
    }

    /// Whether the counter runs on its own clock now.
    pub(super) fn counting(&self) -> bool {
        self.ctl0 & CEN != 0 && !self.held && !self.externally_clocked()
    }

    fn externally_clocked(&self) -> bool {
        self.kind.slave && self.smcfg & 7 == 7
    }

    /// Brings `cnt` up to `cx.now`. No match lies before it: those are events of their own.
    pub(super) fn settle(&mut self, cx: &mut Cx<'_>) {
        while self.next <= cx.now {
            let due = self.next;
            let mut at = Cx { now: due, clocks: cx.clocks, out: cx.out };
            self.advance(&mut at);
            self.reschedule(&at);
        }
        if self.counting() {
            let tick = self.tick_cycles(cx);
            let ticks = cx.now.saturating_sub(self.tick_at) / tick;
            self.cnt = (u64::from(self.cnt) + ticks) as u32;
            self.tick_at += ticks * tick;
        }
    }

    /// Ticks from the present count to the overflow.
    fn ticks_to_overflow(&self) -> u64 {
        // A counter beyond the reload value runs to its end first.
        let top = if self.cnt <= self.car_active { self.car_active } else { self.kind.max() };
        u64::from(top) - u64::from(self.cnt) + 1
    }

    pub(super) fn reschedule(&mut self, cx: &Cx<'_>) {
        // A reload value of 0 stops the counter (user manual, CAR).
        if !self.counting() || self.car_active == 0 {
            self.next = NEVER;
            return;
        }
        let mut ticks = self.ticks_to_overflow();
        for ch in 0..self.kind.channels {
            if self.mode_bits(ch) & 3 == 0 && self.ccv_active[ch] > self.cnt {
                ticks = ticks.min(u64::from(self.ccv_active[ch] - self.cnt));
            }
        }
        self.next = self.tick_at + ticks * self.tick_cycles(cx);
    }

    /// Handles the match or overflow that is due at `cx.now`.
    pub(super) fn advance(&mut self, cx: &mut Cx<'_>) {
        let ticks = (cx.now - self.tick_at) / self.tick_cycles(cx);
        self.tick_at = cx.now;
        self.count_by(ticks, cx);
    }

    /// One tick from another timer's trigger output.
    pub(super) fn tick(&mut self, cx: &mut Cx<'_>) {
        if self.car_active != 0 {
            self.count_by(1, cx);
        }
    }

    fn count_by(&mut self, ticks: u64, cx: &mut Cx<'_>) {
        let overflow = ticks >= self.ticks_to_overflow();
        if overflow {
            self.cnt = 0;
        } else {
            self.cnt += ticks as u32;
        }
        if overflow {
            if self.repetitions_left > 0 {
                self.repetitions_left -= 1;
            } else {
                self.update(false, cx);
            }
        }
        for ch in 0..self.kind.channels {
            if self.mode_bits(ch) & 3 == 0 && self.cnt == self.ccv_active[ch] {
                self.matched(ch, cx);
            }
        }
        self.refresh_pwm(cx);
        self.drive_outputs(cx);
    }

    /// The update event, by an overflow or (`software`) by UPG: loads the shadows.
    pub(super) fn update(&mut self, software: bool, cx: &mut Cx<'_>) {
        if self.ctl0 & UPDIS != 0 {
            return;
        }
        self.psc_active = self.psc;
        self.car_active = self.car;
        for ch in 0..self.kind.channels {
            if self.mode_bits(ch) & 3 == 0 {
                self.ccv_active[ch] = self.ccv[ch];
            }
        }
        self.repetitions_left = self.crep;
        if !(software && self.ctl0 & UPS != 0) {
            self.flag(0, cx);
            if self.dmainten >> 8 & 1 != 0 {
                cx.out.push(Signal::DmaPulse(DmaSource::TimerUpdate(self.id)));
            }
        }
        match self.ctl1 >> 4 & 7 {
            0 if software => cx.out.push(Signal::Trgo(self.id)),
            2 => cx.out.push(Signal::Trgo(self.id)),
            _ => {}
        }
        if self.ctl0 & SPM != 0 && !software {
            self.ctl0 &= !CEN;
        }
        debug_assert!(self.ctl0 & ARSE == 0 || self.car_active == self.car);
    }

    /// A compare match of an output channel.
    fn matched(&mut self, ch: usize, cx: &mut Cx<'_>) {
        match self.mode_bits(ch) >> 4 & 7 {
            1 => self.set_ocref(ch, true, cx),
            2 => self.set_ocref(ch, false, cx),
            3 => self.set_ocref(ch, !self.ocref[ch], cx),
            _ => {}
        }
        // Master mode 3: the compare pulse of channel 0.
        if ch == 0 && self.ctl1 >> 4 & 7 == 3 {
            cx.out.push(Signal::Trgo(self.id));
        }
        self.channel_event(ch, cx);
    }

    /// Flag and DMA request of a match or a capture.
    pub(super) fn channel_event(&mut self, ch: usize, cx: &mut Cx<'_>) {
        self.flag(ch as u32 + 1, cx);
        if self.dmainten >> (9 + ch) & 1 != 0 {
            cx.out.push(Signal::DmaPulse(DmaSource::TimerChannel(self.id, ch as u8)));
        }
    }
}
