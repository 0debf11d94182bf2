//! Everything that switches off at once, and what is remembered over a reset.
//!
//! [`cut`] is the one way to darkness: stop the DMA that makes edges, then write the off word.
//! It is called by the interlock's interrupt (priority 0), the guard's, and the panic and fault
//! handlers; it takes no lock. The first cut's time is kept for the account of the on-time.

use crate::{board, shared, trigger_in};
use core::cell::UnsafeCell;
use core::panic::PanicInfo;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use cortex_m_rt::{ExceptionFrame, exception};
use embassy_gd32f3x0::interrupt::typelevel::{self, Handler};
use embassy_gd32f3x0::interrupt::{Interrupt, InterruptExt};
use embassy_gd32f3x0::{exti, guard, reset, sequence, time_driver};
use stspp_firmware_logic::controller::Boot;
use stspp_protocol::fault::{FaultReason, FaultSet};
use stspp_protocol::version::ResetCause;

static CUT: AtomicBool = AtomicBool::new(false);
static CUT_AT: AtomicU32 = AtomicU32::new(0);
static INTERLOCK_OPENED: AtomicBool = AtomicBool::new(false);

/// Stops all edges and makes all outputs low. From any context.
#[inline(always)]
pub(crate) fn cut() {
    sequence::halt();
    board::outputs_off();
    if !CUT.load(Ordering::Relaxed) {
        CUT_AT.store(time_driver::counter(), Ordering::Relaxed);
        CUT.store(true, Ordering::Release);
    }
}

/// Whether [`cut`] was called since [`allow`].
pub(crate) fn is_cut() -> bool {
    CUT.load(Ordering::Acquire)
}

/// Low half of the time of the first cut since [`allow`].
pub(crate) fn cut_at() -> u32 {
    CUT_AT.load(Ordering::Relaxed)
}

/// Forgets the last cut, before outputs are used again. Whoever calls it asks [`is_cut`] and
/// [`interlock_is_closed`] again *after* it has started the DMA: a cut in between must win.
pub(crate) fn allow() {
    CUT.store(false, Ordering::Release);
}

/// Level of the interlock input: closed is high, so that a broken wire is open.
#[inline(always)]
pub(crate) fn interlock_is_closed() -> bool {
    // SAFETY: GPIOA_ISTAT, read only; PA0.
    unsafe { (0x4800_0010 as *const u32).read_volatile() & 1 != 0 }
}

/// Whether the interlock has opened since the last call, however short.
pub(crate) fn take_interlock_opened() -> bool {
    INTERLOCK_OPENED.swap(false, Ordering::AcqRel)
}

/// The interlock's interrupt. Priority 0: no critical section, no waker, no log.
pub(crate) struct InterlockHandler;

impl Handler<typelevel::EXTI0_1> for InterlockHandler {
    unsafe fn on_interrupt() {
        // Whatever brought us here but an edge at trigger-in, the other line of this vector, ends
        // the light. An opening that is over before this runs is an opening too: the falling edge
        // is pending, or a rising one that follows a falling one. Only a rising edge from rest
        // finds the outputs low anyway.
        let trigger = exti::RawLine::is_pending(board::TRIGGER_LINE);
        if exti::RawLine::is_pending(0) || !trigger {
            cut();
            exti::RawLine::acknowledge(0);
            INTERLOCK_OPENED.store(true, Ordering::Release);
            Interrupt::I2C0_EV.pend();
        }
        if trigger {
            trigger_in::on_edge();
        }
    }
}

/// The guard has ended an on-time.
pub(crate) struct GuardHandler;

impl Handler<typelevel::TIMER0_BRK_UP_TRG_COM> for GuardHandler {
    unsafe fn on_interrupt() {
        if guard::is_tripped() {
            cut();
            shared::WAKE.signal(());
        }
    }
}

/// Software interrupt: what priority 0 may not do itself.
pub(crate) struct WakeHandler;

impl Handler<typelevel::I2C0_EV> for WakeHandler {
    unsafe fn on_interrupt() {
        shared::WAKE.signal(());
    }
}

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    cut();
    cortex_m::interrupt::disable();
    remember(FaultReason::Panic);
    let line = info.location().map_or(0, core::panic::Location::line);
    let file = info.location().map_or("", core::panic::Location::file);
    defmt::error!("panic at {=str}:{=u32}", file, line);
    reset::software_reset()
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    cut();
    remember(FaultReason::HardFault);
    defmt::error!("hard fault at {=u32:#x}", frame.pc());
    reset::software_reset()
}

/// The clock monitor: the crystal has stopped, and the core runs from the internal oscillator.
#[exception]
unsafe fn NonMaskableInt() -> ! {
    cut();
    remember(FaultReason::Clock);
    reset::software_reset()
}

#[exception]
unsafe fn DefaultHandler(irq: i16) {
    cut();
    remember(FaultReason::HardFault);
    defmt::error!("no handler for interrupt {=i16}", irq);
    reset::software_reset()
}

/// A panic of defmt itself (a log within a log).
#[defmt::panic_handler]
fn defmt_panic() -> ! {
    panic!("defmt")
}

// ---- What survives a reset ------------------------------------------------------------------

/// RAM that neither start-up code nor reset clears.
#[repr(C)]
struct Kept {
    magic: u32,
    faults: u32,
    bootloader: u32,
    check: u32,
}

const MAGIC: u32 = 0x5753_7453;
const BOOTLOADER: u32 = 0xb007_10ad;

struct KeptCell(UnsafeCell<core::mem::MaybeUninit<Kept>>);
// SAFETY: one core; written whole by volatile writes, and what is read is held against `check`.
unsafe impl Sync for KeptCell {}

#[unsafe(link_section = ".uninit.kept")]
static KEPT: KeptCell = KeptCell(UnsafeCell::new(core::mem::MaybeUninit::uninit()));

fn check_of(faults: u32, bootloader: u32) -> u32 {
    (MAGIC ^ faults.rotate_left(7) ^ bootloader.rotate_left(19)).wrapping_mul(0x9e37_79b1)
}

/// Faults and bootloader request, or nothing where the RAM has lost its contents.
fn recall() -> (u32, u32) {
    let kept = KEPT.0.get().cast::<[u32; 4]>();
    // SAFETY: four words of RAM; any bits are valid words.
    let [magic, faults, bootloader, check] = unsafe { kept.read_volatile() };
    if magic == MAGIC && check == check_of(faults, bootloader) {
        (faults, bootloader)
    } else {
        (0, 0)
    }
}

fn keep(faults: u32, bootloader: u32) {
    let kept = KEPT.0.get().cast::<[u32; 4]>();
    // SAFETY: as above.
    unsafe { kept.write_volatile([MAGIC, faults, bootloader, check_of(faults, bootloader)]) }
}

/// Adds a fault to those kept.
fn remember(reason: FaultReason) {
    let mut faults = FaultSet(recall().0);
    faults.insert(reason);
    keep(faults.0, 0);
}

/// Keeps the latched faults.
pub(crate) fn keep_faults(latched: FaultSet) {
    if recall().0 != latched.0 {
        keep(latched.0, 0);
    }
}

/// Asks for the bootloader after the next reset.
pub(crate) fn request_bootloader() {
    keep(recall().0, BOOTLOADER);
}

/// Whether the bootloader was asked for; asks once.
pub(crate) fn take_bootloader_request() -> bool {
    let (faults, bootloader) = recall();
    if bootloader == BOOTLOADER {
        keep(faults, 0);
        return true;
    }
    false
}

/// How the controller came up.
pub(crate) fn boot(cause: reset::Cause) -> Boot {
    let mut carried = match cause {
        // RAM may hold anything after that, also what looks right.
        reset::Cause::Power => FaultSet::EMPTY,
        _ => FaultSet(recall().0),
    };
    // A halt of a debugger that was not followed by the watchdog's reset is the debugger's affair:
    // that is how an image is flashed.
    let halted = reset::take_debug_halt();
    if cause == reset::Cause::Watchdog {
        carried.insert(if halted { FaultReason::DebugHalt } else { FaultReason::Watchdog });
    }
    keep(carried.0, 0);
    let cause = match cause {
        reset::Cause::Power => ResetCause::PowerOn,
        reset::Cause::Pin => ResetCause::Pin,
        reset::Cause::Software => ResetCause::Software,
        reset::Cause::Watchdog => ResetCause::Watchdog,
        _ => ResetCause::Unknown,
    };
    Boot { cause, carried }
}
