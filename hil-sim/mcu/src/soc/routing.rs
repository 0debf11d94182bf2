//! Signals from one model to another.

use std::sync::atomic::Ordering;

use super::Soc;
use super::adc::Adc;
use super::exti::Syscfg;
use super::gpio::Gpio;
use super::misc::{Ctc, Pmu};
use super::peripheral::{Peripheral, PeripheralId, Signal, TimerId};
use super::timer::Timer;
use super::usart::Usart;
use crate::clock::Clocks;

impl Soc {
    /// Delivers all waiting signals, and those that they cause, at cycle `now`.
    pub(super) fn route(&mut self, now: u64) {
        // Each round delivers what the round before caused. No loop of models feeds itself.
        while !self.signals.is_empty() {
            let signals = std::mem::take(&mut self.signals);
            for signal in signals {
                self.deliver(signal, now);
            }
        }
    }

    fn deliver(&mut self, signal: Signal, now: u64) {
        match signal {
            Signal::Irq(n, high) => {
                let levels = self.irq_levels & !(1 << n) | u128::from(high) << n;
                if levels != self.irq_levels {
                    self.irq_levels = levels;
                    self.shared.attention.store(true, Ordering::Relaxed);
                }
            }
            Signal::DmaPulse(source) => self.with(now, |soc, cx| soc.dma.request(source, cx)),
            Signal::DmaBurst => {
                if let Some(n) = self.dma_channel_served {
                    self.dma.request_again(n);
                }
            }
            Signal::DmaLevel(source, active) => {
                self.with(now, |soc, cx| soc.dma.set_level(source, active, cx))
            }
            Signal::TimerOutput(timer, output, level) => {
                self.timer_outputs[timer.index()][usize::from(output)] = level;
                self.refresh_timer_pins(timer, output, now);
            }
            Signal::Trgo(from) => {
                for id in TimerId::ALL {
                    if id != from {
                        self.with(now, |soc, cx| soc.timers[id.index()].on_trgo(from, cx));
                    }
                }
            }
            Signal::PortChanged(port) => self.refresh_port(port, now),
            Signal::ExtiRouting => {
                for line in 0..16 {
                    let port = usize::from(self.syscfg.exti_port(line)).min(5);
                    let level = self.gpio[port].input(line);
                    self.exti.preset_level(line, level);
                }
            }
            Signal::DmaRemap(cfg0) => self.dma.set_remap(cfg0),
            Signal::ClocksChanged => self.change_clocks(now),
            Signal::PeripheralReset(id) => self.reset_peripheral(id, now),
            Signal::Nmi => {
                self.pending_nmi = true;
                self.shared.attention.store(true, Ordering::Relaxed);
            }
            Signal::Reset(cause) => {
                self.pending_reset.get_or_insert(cause);
                self.shared.attention.store(true, Ordering::Relaxed);
            }
        }
    }

    fn change_clocks(&mut self, now: u64) {
        let next: Clocks = self.rcu.clocks(self.clocks.ns_at(now));
        let next = self.clocks.rebase(now, next);
        if next == self.clocks.rebase(now, self.clocks) {
            return;
        }
        if next.hclk_hz > self.variant.max_hclk_hz() && !self.clock_over_limit {
            self.clock_over_limit = true;
            self.log.note(now, format!("core clock {} Hz is above the chip's limit", next.hclk_hz));
        }
        self.for_each(now, |device, cx| device.before_clock_change(cx));
        self.clocks = next;
        self.for_each(now, |device, cx| device.after_clock_change(cx));
        self.shared.attention.store(true, Ordering::Relaxed);
    }

    fn for_each(&mut self, now: u64, mut act: impl FnMut(&mut dyn Peripheral, &mut super::Cx<'_>)) {
        self.with(now, |soc, cx| {
            for timer in &mut soc.timers {
                act(timer, cx);
            }
            for usart in &mut soc.usarts {
                act(usart, cx);
            }
            act(&mut soc.adc, cx);
            act(&mut soc.fmc, cx);
            act(&mut soc.fwdgt, cx);
            act(&mut soc.usbfs, cx);
        });
    }

    fn reset_peripheral(&mut self, id: PeripheralId, now: u64) {
        match id {
            PeripheralId::Gpio(port) => {
                let n = usize::from(port);
                self.gpio[n] = Gpio::new(port).wired_as(&self.gpio[n]);
                self.refresh_port(port, now);
            }
            PeripheralId::Syscfg => self.syscfg = Syscfg::default(),
            PeripheralId::Timer(timer) => {
                self.timers[timer.index()] = Timer::new(timer);
                for output in 0..7 {
                    self.timer_outputs[timer.index()][usize::from(output)] = None;
                    self.refresh_timer_pins(timer, output, now);
                }
            }
            PeripheralId::Usart(n) => {
                let usart = &mut self.usarts[usize::from(n)];
                let fresh = Usart::new(n).wired_as(usart);
                *usart = fresh;
            }
            PeripheralId::Adc => self.adc = Adc::new().wired_as(&self.adc),
            PeripheralId::Pmu => self.pmu = Pmu::default(),
            PeripheralId::Ctc => self.ctc = Ctc::default(),
            PeripheralId::Usbfs => self.with(now, |soc, cx| soc.usbfs.core_reset(cx)),
            // These have no reset bit.
            PeripheralId::Rcu
            | PeripheralId::Exti
            | PeripheralId::Dma
            | PeripheralId::Fmc
            | PeripheralId::Fwdgt
            | PeripheralId::Crc
            | PeripheralId::Dbg => {}
        }
    }

    /// Makes the DMA transfer that is due at `now`.
    pub(super) fn make_dma_transfer(&mut self, now: u64) {
        let Some(transfer) = self.dma.take_transfer() else { return };
        let (from, from_bytes) = transfer.from;
        let (to, to_bytes) = transfer.to;
        self.dma_channel_served = Some(transfer.channel);
        let moved = self.bus_read(from, from_bytes, now).and_then(|word| {
            let kept = word & (u32::MAX >> (32 - 8 * from_bytes));
            self.bus_write(to, to_bytes, kept, now)
        });
        self.dma_channel_served = None;
        self.with(now, |soc, cx| soc.dma.complete(transfer, moved.is_err(), cx));
        self.dma.next(now);
    }

    /// The core has locked up: trips the break inputs if the firmware linked them.
    pub fn core_locked_up(&mut self, now: u64) {
        if self.syscfg.lockup_breaks_timers() {
            self.act(now, |soc, cx| {
                for timer in &mut soc.timers {
                    timer.break_now(cx);
                }
            });
        }
    }
}
