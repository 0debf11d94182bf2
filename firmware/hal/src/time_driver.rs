//! embassy-time driver on TIMER1: 1 MHz, free-running over 32 bits, extended to 64 (user manual,
//! "General level0 timer (TIMERx, x=1,2)").
//!
//! Compare channel 0 is the alarm; channel 1, at 2^31, and the overflow count half periods. The
//! race between counter and count, and the order of reads that settles it, are told and tested in
//! [`crate::calc::period`].

use crate::calc::{period, timing};
use crate::interrupt::typelevel::{self, Handler};
use crate::interrupt::{Interrupt, InterruptExt, Priority};
use crate::regs::{self, RegExt};
use core::cell::{Cell, RefCell};
use core::sync::atomic::{AtomicU32, Ordering, compiler_fence};
use core::task::Waker;
use critical_section::CriticalSection;
use embassy_sync::blocking_mutex::Mutex;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_time_driver::Driver;
use embassy_time_queue_utils::Queue;

/// Ticks per second of TIMER1 and of embassy-time.
pub const TICK_HZ: u32 = 1_000_000;

// TIMERx_INTF, TIMERx_DMAINTEN.
const UP: u32 = 1 << 0;
const CH0: u32 = 1 << 1;
const CH1: u32 = 1 << 2;

struct Timer1Driver {
    half_periods: AtomicU32,
    alarm: Mutex<CriticalSectionRawMutex, Cell<u64>>,
    queue: Mutex<CriticalSectionRawMutex, RefCell<Queue>>,
}

embassy_time_driver::time_driver_impl!(static DRIVER: Timer1Driver = Timer1Driver {
    half_periods: AtomicU32::new(0),
    alarm: Mutex::const_new(CriticalSectionRawMutex::new(), Cell::new(u64::MAX)),
    queue: Mutex::const_new(CriticalSectionRawMutex::new(), RefCell::new(Queue::new())),
});

/// Low 32 bits of the tick count: the time base of [`crate::sequence`].
#[inline(always)]
pub fn counter() -> u32 {
    regs::timer1().cnt.get()
}

pub(crate) fn init(priority: Priority) {
    let timer_hz = crate::rcu::clocks().timer_hz;
    let Some(prescaler) = timing::prescaler(timer_hz, TICK_HZ) else {
        panic!("the timer clock is no whole number of megahertz")
    };
    let rcu = regs::rcu();
    rcu.apb1en.modify(|_, w| w.timer1en().set_bit());
    rcu.apb1rst.modify(|_, w| w.timer1rst().set_bit());
    rcu.apb1rst.modify(|_, w| w.timer1rst().clear_bit());

    let timer = regs::timer1();
    timer.psc.set(u32::from(prescaler));
    timer.car.set(u32::MAX);
    timer.ch1cv.set(1 << 31);
    // The prescaler is taken over by an update event; UPS keeps that event from raising UPIF.
    timer.ctl0.modify(|_, w| w.ups().set_bit());
    timer.swevg.write(|w| w.upg().set_bit());
    timer.intf.set(0);
    timer.dmainten.set(UP | CH1);
    timer.ctl0.modify(|_, w| w.cen().set_bit());

    Interrupt::TIMER1.set_priority(priority);
    // SAFETY: the handler is bound by the application, which the sequence's and the executor's
    // documentation require; without it time stands still but nothing is unsound.
    unsafe { Interrupt::TIMER1.enable() };
}

impl Timer1Driver {
    fn on_half_period(&self) {
        // Only this interrupt writes it.
        let next = self.half_periods.load(Ordering::Relaxed).wrapping_add(1);
        self.half_periods.store(next, Ordering::Relaxed);
        critical_section::with(|cs| {
            let at = self.alarm.borrow(cs).get();
            if at != u64::MAX {
                self.arm(cs, at);
            }
        });
    }

    /// Arms the alarm; false where `at` has passed already.
    fn arm(&self, cs: CriticalSection, at: u64) -> bool {
        let timer = regs::timer1();
        let disarm = || timer.dmainten.update(|bits| bits & !CH0);
        self.alarm.borrow(cs).set(at);
        if at == u64::MAX {
            disarm();
            return true;
        }
        let now = self.now();
        let Some(compare) = period::alarm(now, at) else {
            disarm();
            return true;
        };
        timer.ch0cv.set(compare);
        timer.intf.set(!CH0);
        timer.dmainten.update(|bits| bits | CH0);
        // The counter may have passed `at` before the compare was written; then no match comes.
        if at <= self.now() {
            disarm();
            self.alarm.borrow(cs).set(u64::MAX);
            return false;
        }
        true
    }

    fn on_alarm(&self, cs: CriticalSection) {
        let mut queue = self.queue.borrow(cs).borrow_mut();
        let mut next = queue.next_expiration(self.now());
        while !self.arm(cs, next) {
            next = queue.next_expiration(self.now());
        }
    }
}

impl Driver for Timer1Driver {
    fn now(&self) -> u64 {
        let half_periods = self.half_periods.load(Ordering::Relaxed);
        // The count must be read before the counter: see `calc::period`.
        compiler_fence(Ordering::Acquire);
        period::ticks(half_periods, counter())
    }

    fn schedule_wake(&self, at: u64, waker: &Waker) {
        critical_section::with(|cs| {
            if self.queue.borrow(cs).borrow_mut().schedule_wake(at, waker) {
                self.on_alarm(cs);
            }
        });
    }
}

/// Handler of TIMER1's interrupt for time. [`crate::sequence::InterruptHandler`] may be bound
/// beside it.
pub struct InterruptHandler;

impl Handler<typelevel::TIMER1> for InterruptHandler {
    unsafe fn on_interrupt() {
        let timer = regs::timer1();
        let flags = timer.intf.get() & timer.dmainten.get() & (UP | CH0 | CH1);
        // Flags are cleared by writing zero; ones leave the others alone.
        timer.intf.set(!flags);
        if flags & UP != 0 {
            DRIVER.on_half_period();
        }
        if flags & CH1 != 0 {
            DRIVER.on_half_period();
        }
        if flags & CH0 != 0 {
            critical_section::with(|cs| DRIVER.on_alarm(cs));
        }
    }
}
