//! Critical section by BASEPRI: everything is masked but the interrupts of priority 0.
//!
//! The usual implementation (PRIMASK) would delay the interlock by the longest critical section of
//! any crate in the binary. Priority 0 is therefore kept out of all critical sections; in return a
//! handler of that priority may touch nothing that a critical section protects: no wakers, no
//! channels, no logging. It may write registers and atomics, and pend an interrupt of lower
//! priority that does the rest.
//!
//! (ARMv7-M Architecture Reference Manual, B1.4.3 "The special-purpose mask registers".)

use cortex_m::register::{basepri, basepri_max};

/// The highest priority that a critical section masks (4 priority bits: level 1).
const MASK: u8 = 0x10;

struct BasepriSection;
critical_section::set_impl!(BasepriSection);

// SAFETY: one core; between acquire and release no interrupt of priority 1 to 15 runs, and
// handlers of priority 0 promise not to enter critical sections (module text).
unsafe impl critical_section::Impl for BasepriSection {
    unsafe fn acquire() -> critical_section::RawRestoreState {
        let before = basepri::read();
        basepri_max::write(MASK);
        cortex_m::asm::isb();
        core::sync::atomic::compiler_fence(core::sync::atomic::Ordering::SeqCst);
        before
    }

    unsafe fn release(before: critical_section::RawRestoreState) {
        core::sync::atomic::compiler_fence(core::sync::atomic::Ordering::SeqCst);
        // SAFETY: restores what `acquire` found; sections nest.
        unsafe { basepri::write(before) }
    }
}
