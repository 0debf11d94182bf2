//! Two flash pages in memory, with power that can fail half-way.

use stspp_firmware_logic::hardware::{Page, SettingsStore, StoreError};

/// Size of a page, as on the chip.
pub const PAGE_LEN: usize = 1024;

/// NOR flash: erasing sets every bit, writing only clears bits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MemoryFlash {
    pages: [[u8; PAGE_LEN]; 2],
    /// Power fails after this many more bytes, erased or written.
    bytes_until_power_fails: Option<usize>,
    erase_counts: [u32; 2],
}

impl Default for MemoryFlash {
    fn default() -> Self {
        Self { pages: [[0xFF; PAGE_LEN]; 2], bytes_until_power_fails: None, erase_counts: [0; 2] }
    }
}

impl MemoryFlash {
    /// Lets power fail after `bytes` more bytes have been erased or written; `None` restores it.
    pub fn fail_after(&mut self, bytes: Option<usize>) {
        self.bytes_until_power_fails = bytes;
    }

    /// The bytes of a page.
    pub fn page(&self, page: Page) -> &[u8; PAGE_LEN] {
        &self.pages[index(page)]
    }

    /// The bytes of a page, to corrupt them.
    pub fn page_mut(&mut self, page: Page) -> &mut [u8; PAGE_LEN] {
        &mut self.pages[index(page)]
    }

    /// How often a page has been erased.
    pub fn erase_count(&self, page: Page) -> u32 {
        self.erase_counts[index(page)]
    }

    fn power(&mut self) -> Result<(), StoreError> {
        match &mut self.bytes_until_power_fails {
            Some(0) => Err(StoreError),
            Some(bytes) => {
                *bytes -= 1;
                Ok(())
            }
            None => Ok(()),
        }
    }
}

fn index(page: Page) -> usize {
    match page {
        Page::A => 0,
        Page::B => 1,
    }
}

impl SettingsStore for MemoryFlash {
    fn read(&self, page: Page, out: &mut [u8]) -> Result<(), StoreError> {
        let bytes = self.page(page).get(..out.len()).ok_or(StoreError)?;
        out.copy_from_slice(bytes);
        Ok(())
    }

    fn erase(&mut self, page: Page) -> Result<(), StoreError> {
        self.erase_counts[index(page)] += 1;
        for at in 0..PAGE_LEN {
            self.power()?;
            self.pages[index(page)][at] = 0xFF;
        }
        Ok(())
    }

    fn write(&mut self, page: Page, bytes: &[u8]) -> Result<(), StoreError> {
        if bytes.len() > PAGE_LEN {
            return Err(StoreError);
        }
        for (at, byte) in bytes.iter().enumerate() {
            self.power()?;
            self.pages[index(page)][at] &= byte;
        }
        Ok(())
    }
}
