//! A one-shot that ends light whatever else the chip does: TIMER0 and a DMA channel write a fixed
//! word to a port when the time is over (user manual, "Advanced timer (TIMERx, x=0)"; TIMER0_UP
//! requests DMA channel 4).
//!
//! It is independent of what it guards: another timer, another DMA channel, no table, no CPU. It
//! also interrupts, so that the software learns of it.

use crate::Peri;
use crate::calc::timing;
use crate::dma::{self, Control};
use crate::gpio::Output;
use crate::interrupt::typelevel::{self, Handler};
use crate::interrupt::{Interrupt, InterruptExt, Priority};
use crate::peripherals::{DMA_CH4, TIMER0};
use crate::regs::{self, RegExt};
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicBool, Ordering};

const CHANNEL: u8 = 4;
// TIMERx_CTL0.
const CEN: u32 = 1 << 0;
const UPS: u32 = 1 << 2;
const SPM: u32 = 1 << 3;
// TIMERx_DMAINTEN.
const UP_INTERRUPT: u32 = 1 << 0;
const UP_DMA: u32 = 1 << 8;

struct Word(UnsafeCell<u32>);
// SAFETY: written once before the channel starts, then read by DMA only.
unsafe impl Sync for Word {}
static OFF_WORD: Word = Word(UnsafeCell::new(0));
static TRIPPED: AtomicBool = AtomicBool::new(false);

/// Ticks a second.
const TICK_HZ: u32 = 100_000;
/// Microseconds a tick.
const TICK_US: u32 = 1_000_000 / TICK_HZ;
/// Longest guarded time in microseconds (16-bit counter).
pub const MAX_US: u32 = 65_536 * TICK_US;

/// The driver. Arming is by free functions, because the interrupt that sees the edges does it.
pub struct Guard<'d> {
    _timer: Peri<'d, TIMER0>,
    _channel: Peri<'d, DMA_CH4>,
}

impl<'d> Guard<'d> {
    /// Prepares the one-shot: when the time given to [`arm`] is over, `off_word` is written to the
    /// port of `pin`.
    pub fn new(
        timer: Peri<'d, TIMER0>,
        channel: Peri<'d, DMA_CH4>,
        pin: &Output<'_>,
        off_word: u32,
        priority: Priority,
        _irq: impl typelevel::Binding<typelevel::TIMER0_BRK_UP_TRG_COM, InterruptHandler>,
    ) -> Self {
        let Some(prescaler) = timing::prescaler(crate::rcu::clocks().timer_hz, TICK_HZ) else {
            panic!("the timer clock is no multiple of 100 kHz")
        };
        let rcu = regs::rcu();
        rcu.apb2en.modify(|_, w| w.timer0en().set_bit());
        rcu.apb2rst.modify(|_, w| w.timer0rst().set_bit());
        rcu.apb2rst.modify(|_, w| w.timer0rst().clear_bit());
        // SAFETY: the channel has not been started yet.
        unsafe { OFF_WORD.0.get().write(off_word) };

        let timer_regs = regs::timer0();
        timer_regs.psc.set(u32::from(prescaler));
        timer_regs.car.set(0xffff);
        timer_regs.ctl0.set(UPS | SPM);
        timer_regs.swevg.write(|w| w.upg().set_bit());
        timer_regs.intf.set(0);
        // Circular over one word without increment: it serves every overflow, for ever.
        dma::start(
            CHANNEL,
            Control::new(
                Control::TO_PERIPHERAL | Control::CIRCULAR | Control::WORDS | Control::ULTRA,
            ),
            regs::gpio(pin.identity().0).bop.as_ptr(),
            OFF_WORD.0.get().cast(),
            1,
        );
        timer_regs.dmainten.set(UP_INTERRUPT | UP_DMA);
        Interrupt::TIMER0_BRK_UP_TRG_COM.set_priority(priority);
        // SAFETY: bound, by the constructor's parameter.
        unsafe { Interrupt::TIMER0_BRK_UP_TRG_COM.enable() };
        Self { _timer: timer, _channel: channel }
    }
}

/// Starts the time anew: at least `limit_us` (at most [`MAX_US`]), at most a tick more.
#[inline(always)]
pub fn arm(limit_us: u32) {
    let ticks = limit_us.min(MAX_US - TICK_US).div_ceil(TICK_US) + 1;
    let timer = regs::timer0();
    timer.ctl0.set(UPS | SPM);
    timer.car.set(ticks - 1);
    timer.cnt.set(0);
    timer.ctl0.set(UPS | SPM | CEN);
}

/// Stops it: there is nothing to guard.
#[inline(always)]
pub fn disarm() {
    regs::timer0().ctl0.set(UPS | SPM);
}

/// Whether it has ended something since the last [`take_tripped`].
pub fn is_tripped() -> bool {
    TRIPPED.load(Ordering::Acquire)
}

/// Whether it has ended something since the last call.
pub fn take_tripped() -> bool {
    // A plain swap: load and store are enough, one context asks.
    let tripped = TRIPPED.load(Ordering::Acquire);
    if tripped {
        TRIPPED.store(false, Ordering::Release);
    }
    tripped
}

/// Handler of TIMER0's update interrupt. The port is off already when it runs.
pub struct InterruptHandler;

impl Handler<typelevel::TIMER0_BRK_UP_TRG_COM> for InterruptHandler {
    unsafe fn on_interrupt() {
        let timer = regs::timer0();
        if timer.intf.get() & 1 != 0 {
            timer.intf.set(!1);
            crate::sequence::halt();
            TRIPPED.store(true, Ordering::Release);
        }
    }
}
