//! Outputs: the reference signal of each channel, and what reaches the pins.

use super::super::peripheral::{Cx, Signal};
use super::{POEN, Timer};

impl Timer {
    /// The eight bits of CHCTL0/CHCTL1 that belong to channel `ch`.
    pub(super) fn mode_bits(&self, ch: usize) -> u32 {
        self.chctl[ch / 2] >> (8 * (ch % 2)) & 0xff
    }

    pub(super) fn set_ocref(&mut self, ch: usize, high: bool, cx: &mut Cx<'_>) {
        if self.ocref[ch] != high {
            self.ocref[ch] = high;
            // Master modes 4..=7: a channel's reference as the trigger output.
            if high && self.ctl1 >> 4 & 7 == ch as u32 + 4 {
                cx.out.push(Signal::Trgo(self.id));
            }
        }
    }

    /// Recomputes the references that depend on the count (PWM modes 0 and 1).
    pub(super) fn refresh_pwm(&mut self, cx: &mut Cx<'_>) {
        for ch in 0..self.kind.channels {
            let bits = self.mode_bits(ch);
            if bits & 3 == 0 && bits >> 4 & 6 == 6 {
                let below = self.cnt < self.ccv_active[ch];
                self.set_ocref(ch, below != (bits >> 4 & 1 != 0), cx);
            }
        }
    }

    /// Recomputes the references after a mode change: forced levels and PWM act at once.
    pub(super) fn refresh_forced(&mut self, cx: &mut Cx<'_>) {
        for ch in 0..self.kind.channels {
            let bits = self.mode_bits(ch);
            match (bits & 3, bits >> 4 & 7) {
                (0, 4) => self.set_ocref(ch, false, cx),
                (0, 5) => self.set_ocref(ch, true, cx),
                _ => {}
            }
        }
        self.refresh_pwm(cx);
    }

    /// Works out what every output drives, and tells the pins what changed.
    pub(super) fn drive_outputs(&mut self, cx: &mut Cx<'_>) {
        for output in 0..7 {
            let level = self.output_level(output);
            if self.driven[output] != level {
                self.driven[output] = level;
                cx.out.push(Signal::TimerOutput(self.id, output as u8, level));
            }
        }
    }

    /// What output `output` (0..=3 channels, 4..=6 complements) drives: `None` is floating.
    fn output_level(&self, output: usize) -> Option<bool> {
        let (ch, complement) = if output < 4 { (output, false) } else { (output - 4, true) };
        if ch >= if complement { self.kind.complements } else { self.kind.channels }
            || self.mode_bits(ch) & 3 != 0
        {
            return None;
        }
        let bit = 4 * ch + if complement { 2 } else { 0 };
        let enabled = self.chctl2 >> bit & 1 != 0;
        let inverted = self.chctl2 >> (bit + 1) & 1 != 0;
        let other_enabled = self.chctl2 >> (4 * ch) & 1 != 0;
        // Alone, a complementary output follows the reference; beside its channel, the inverse.
        let reference = if complement && other_enabled { !self.ocref[ch] } else { self.ocref[ch] };
        if !self.kind.break_input {
            return enabled.then_some(reference != inverted);
        }
        let (poen, ios, ros) =
            (self.cchp & POEN != 0, self.cchp >> 10 & 1 != 0, self.cchp >> 11 & 1 != 0);
        match (poen, enabled) {
            (true, true) => Some(reference != inverted),
            (true, false) => ros.then_some(inverted),
            (false, _) => {
                let idle = self.ctl1 >> (8 + 2 * ch + usize::from(complement)) & 1 != 0;
                (ios && enabled).then_some(idle)
            }
        }
    }
}
