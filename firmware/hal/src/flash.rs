//! On-chip flash as storage (user manual, "Flash memory controller (FMC)": "Page erase", "Main
//! flash programming").
//!
//! The core waits while a page is erased (tens of milliseconds) or a word is programmed (tens of
//! microseconds): all code runs from the same flash. Nothing that needs the CPU may be timed across
//! a call. What the DMA and the timers do goes on.

use crate::Peri;
use crate::chip::{FLASH_BYTES, FLASH_PAGE_BYTES};
use crate::peripherals::FMC;
use crate::regs::{self, RegExt};
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

const BASE: u32 = 0x0800_0000;
const UNLOCK: [u32; 2] = [0x4567_0123, 0xcdef_89ab];
// FMC_CTL.
const PG: u32 = 1 << 0;
const PER: u32 = 1 << 1;
const START: u32 = 1 << 6;
const LK: u32 = 1 << 7;
// FMC_STAT.
const BUSY: u32 = 1 << 0;
const PGERR: u32 = 1 << 2;
const WPERR: u32 = 1 << 4;
const ENDF: u32 = 1 << 5;

/// Why the flash did not take it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Error {
    /// Outside the flash.
    OutOfBounds,
    /// Not a multiple of the word or page.
    NotAligned,
    /// The word was not erased.
    NotErased,
    /// The page is write-protected (option bytes).
    Protected,
    /// What is read back is not what was written.
    Verify,
}

impl NorFlashError for Error {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::OutOfBounds => NorFlashErrorKind::OutOfBounds,
            Self::NotAligned => NorFlashErrorKind::NotAligned,
            _ => NorFlashErrorKind::Other,
        }
    }
}

/// The flash, locked between calls.
pub struct Flash<'d> {
    _fmc: Peri<'d, FMC>,
}

fn check(offset: u32, length: usize, align: u32) -> Result<(), Error> {
    let end = u64::from(offset) + length as u64;
    if end > u64::from(FLASH_BYTES) {
        return Err(Error::OutOfBounds);
    }
    if !offset.is_multiple_of(align) || !(length as u32).is_multiple_of(align) {
        return Err(Error::NotAligned);
    }
    Ok(())
}

impl<'d> Flash<'d> {
    /// Takes the controller.
    pub fn new(fmc: Peri<'d, FMC>) -> Self {
        Self { _fmc: fmc }
    }

    /// Runs `operation` with the controller unlocked, and reports what it says.
    fn unlocked(&mut self, operation: impl FnOnce()) -> Result<(), Error> {
        let fmc = regs::fmc();
        for key in UNLOCK {
            fmc.key.set(key);
        }
        fmc.stat.set(PGERR | WPERR | ENDF);
        operation();
        while fmc.stat.get() & BUSY != 0 {}
        let stat = fmc.stat.get();
        fmc.ctl.set(LK);
        match stat {
            s if s & WPERR != 0 => Err(Error::Protected),
            s if s & PGERR != 0 => Err(Error::NotErased),
            _ => Ok(()),
        }
    }
}

impl ErrorType for Flash<'_> {
    type Error = Error;
}

impl ReadNorFlash for Flash<'_> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Error> {
        check(offset, bytes.len(), 1)?;
        for (index, byte) in bytes.iter_mut().enumerate() {
            // SAFETY: inside the flash, by the check.
            *byte = unsafe { ((BASE + offset) as *const u8).add(index).read_volatile() };
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        FLASH_BYTES as usize
    }
}

impl NorFlash for Flash<'_> {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = FLASH_PAGE_BYTES as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Error> {
        check(from, to.saturating_sub(from) as usize, FLASH_PAGE_BYTES)?;
        for page in (from..to).step_by(Self::ERASE_SIZE) {
            self.unlocked(|| {
                let fmc = regs::fmc();
                fmc.ctl.set(PER);
                fmc.addr.set(BASE + page);
                fmc.ctl.set(PER | START);
            })?;
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        check(offset, bytes.len(), 4)?;
        for (index, chunk) in bytes.chunks_exact(4).enumerate() {
            let mut word = [0; 4];
            word.copy_from_slice(chunk);
            let value = u32::from_le_bytes(word);
            let address = (BASE + offset) as *mut u32;
            self.unlocked(|| {
                regs::fmc().ctl.set(PG);
                // SAFETY: inside the flash, aligned, by the check; the controller is in
                // programming mode, and no Rust object lies in the pages given to storage.
                unsafe { address.add(index).write_volatile(value) };
            })?;
            // SAFETY: as above.
            if unsafe { address.add(index).read_volatile() } != value {
                return Err(Error::Verify);
            }
        }
        Ok(())
    }
}
