//! Why the chip was reset, software reset, the chip's serial number, and the way into the ROM
//! bootloader.

use crate::regs::{self, RegExt};

/// Cause of the last reset (user manual, RCU_RSTSCK), the most telling one if several are set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Cause {
    /// Supply came up, or browned out.
    Power,
    /// The reset pin.
    Pin,
    /// [`software_reset`], or a debugger.
    Software,
    /// The free watchdog.
    Watchdog,
    /// Another cause (window watchdog, low power, option bytes).
    Other,
}

/// Reads the cause of the last reset and clears the flags for the next one.
pub fn take_cause() -> Cause {
    let rstsck = &regs::rcu().rstsck;
    let flags = rstsck.get();
    rstsck.update(|bits| bits | 1 << 24); // RSTFC
    // Bits 31..25: LPRSTF WWDGTRSTF FWDGTRSTF SWRSTF PORRSTF EPRSTF OBLRSTF. Every internal reset
    // also pulls the reset pin, so that flag counts last.
    match flags {
        f if f & 1 << 27 != 0 => Cause::Power,
        f if f & 1 << 29 != 0 => Cause::Watchdog,
        f if f & 1 << 28 != 0 => Cause::Software,
        f if f & (1 << 31 | 1 << 30 | 1 << 25) != 0 => Cause::Other,
        _ => Cause::Pin,
    }
}

/// Whether a debugger has halted the core since the last call or power-on, also before a reset: the
/// debug fault status register (DFSR: HALTED, BKPT, DWTTRAP, VCATCH, EXTERNAL) is cleared by power-on
/// and by writing ones (ARMv7-M Architecture Reference Manual, C1.6.1).
pub fn take_debug_halt() -> bool {
    const DFSR: *mut u32 = 0xe000_ed30 as *mut u32;
    // SAFETY: a register of the core's system control space that nothing else uses.
    unsafe {
        let events = DFSR.read_volatile();
        if events != 0 {
            DFSR.write_volatile(events);
        }
        events != 0
    }
}

/// The chip's unique 96-bit identifier (user manual, "Device electronic signature": 0x1FFF F7AC).
pub fn unique_id() -> [u8; 12] {
    let mut id = [0; 12];
    for (index, word) in id.chunks_exact_mut(4).enumerate() {
        // SAFETY: read-only words of the information block on both chips.
        let value = unsafe { (0x1fff_f7ac as *const u32).add(index).read_volatile() };
        word.copy_from_slice(&value.to_le_bytes());
    }
    id
}

/// Resets the chip.
pub fn software_reset() -> ! {
    cortex_m::peripheral::SCB::sys_reset()
}

/// Start of the ROM bootloader's vector table (user manual, "Boot configuration": system memory
/// at 0x1FFF EC00).
const BOOTLOADER: *const u32 = 0x1fff_ec00 as *const u32;

/// Jumps into the ROM bootloader. To be called straight after a reset, before [`crate::init`]:
/// the bootloader expects the chip as reset leaves it.
///
/// # Safety
/// No interrupt may be enabled and no peripheral running.
pub unsafe fn enter_bootloader() -> ! {
    // SAFETY: the ROM's table has an initial stack pointer and a reset vector; the caller
    // promises the chip to be as after reset.
    unsafe { cortex_m::asm::bootload(BOOTLOADER) }
}
