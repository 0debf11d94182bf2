//! Settings in the last two pages of the flash.

use crate::board::SETTINGS_PAGES;
use core::cell::RefCell;
use embassy_gd32f3x0::Peri;
use embassy_gd32f3x0::flash::Flash;
use embassy_gd32f3x0::peripherals::FMC;
use embedded_storage::nor_flash::{NorFlash, ReadNorFlash};
use stspp_firmware_logic::hardware::{Page, SettingsStore, StoreError};

/// The store.
pub(crate) struct Store {
    flash: RefCell<Flash<'static>>,
}

impl Store {
    pub(crate) fn new(fmc: Peri<'static, FMC>) -> Self {
        Self { flash: RefCell::new(Flash::new(fmc)) }
    }
}

fn offset(page: Page) -> u32 {
    match page {
        Page::A => SETTINGS_PAGES[0],
        Page::B => SETTINGS_PAGES[1],
    }
}

fn refused(error: embassy_gd32f3x0::flash::Error) -> StoreError {
    defmt::error!("flash: {}", error);
    StoreError
}

impl SettingsStore for Store {
    fn read(&self, page: Page, out: &mut [u8]) -> Result<(), StoreError> {
        self.flash.borrow_mut().read(offset(page), out).map_err(refused)
    }

    fn erase(&mut self, page: Page) -> Result<(), StoreError> {
        let at = offset(page);
        let size = Flash::ERASE_SIZE as u32;
        self.flash.get_mut().erase(at, at + size).map_err(refused)
    }

    fn write(&mut self, page: Page, bytes: &[u8]) -> Result<(), StoreError> {
        self.flash.get_mut().write(offset(page), bytes).map_err(refused)
    }
}
