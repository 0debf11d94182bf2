//! Records in flash: found, counted, and never taken for what they are not.

mod common;

use common::MockFlash;
use proptest::prelude::*;
use stspp_firmware_logic::hardware::{Page, SettingsStore};
use stspp_firmware_logic::settings::{RECORD_LEN, Settings, load, save};
use stspp_protocol::reply::StorageError;
use stspp_protocol::timing::{MAX_SLOTS, ProjectionTiming, Slot};

fn settings(exposure_us: u32) -> Settings {
    Settings { timing: ProjectionTiming { exposure_us, ..ProjectionTiming::default() } }
}

#[test]
fn nothing_is_found_in_erased_flash() {
    assert_eq!(load(&MockFlash::default()), Err(StorageError::Empty));
    // Zeros were written by somebody: damaged, not new.
    let blank = MockFlash { pages: [[0; 256]; 2], ..MockFlash::default() };
    assert_eq!(load(&blank), Err(StorageError::Read));
}

#[test]
fn the_newest_is_found_over_many_saves() {
    let mut flash = MockFlash::default();
    for exposure_us in 100..150 {
        save(&mut flash, &settings(exposure_us)).unwrap();
        assert_eq!(load(&flash), Ok(settings(exposure_us)));
    }
}

/// The count wraps: the record after 0xFFFF_FFFF is newer, not older.
#[test]
fn the_count_wraps() {
    let mut flash = MockFlash::default();
    save(&mut flash, &settings(100)).unwrap();
    // Forge a record of the highest count: count at byte 8, CRC-32 over all before the last four.
    let page = &mut flash.pages[Page::A as usize];
    page[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
    let crc = crc32_by_bits(&page[..RECORD_LEN - 4]);
    page[RECORD_LEN - 4..RECORD_LEN].copy_from_slice(&crc.to_le_bytes());
    assert_eq!(load(&flash), Ok(settings(100)));
    save(&mut flash, &settings(200)).unwrap();
    assert_eq!(flash.pages[Page::B as usize][8..12], [0; 4]);
    assert_eq!(load(&flash), Ok(settings(200)));
    save(&mut flash, &settings(300)).unwrap();
    assert_eq!(load(&flash), Ok(settings(300)));
}

/// CRC-32 (ISO-HDLC) bit by bit.
fn crc32_by_bits(bytes: &[u8]) -> u32 {
    let mut crc = u32::MAX;
    for &byte in bytes {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
        }
    }
    !crc
}

#[test]
fn the_largest_settings_fit() {
    let slot = Slot { projector_mask: u16::MAX, floodlight: true };
    let timing = ProjectionTiming {
        slots: std::iter::repeat_n(slot, MAX_SLOTS).collect(),
        frame_period_us: u32::MAX,
        exposure_us: u32::MAX,
        trigger_delay_us: u32::MAX,
        gate_lead_us: u32::MAX,
        gate_lag_us: u32::MAX,
    };
    let mut flash = MockFlash::default();
    save(&mut flash, &Settings { timing: timing.clone() }).unwrap();
    assert_eq!(load(&flash), Ok(Settings { timing }));
}

/// A flash that forgets a bit while writing is not believed.
#[test]
fn what_does_not_read_back_is_a_failed_write() {
    #[derive(Clone)]
    struct Forgetful(MockFlash);
    impl SettingsStore for Forgetful {
        fn read(
            &self,
            page: Page,
            out: &mut [u8],
        ) -> Result<(), stspp_firmware_logic::hardware::StoreError> {
            self.0.read(page, out)
        }
        fn erase(&mut self, page: Page) -> Result<(), stspp_firmware_logic::hardware::StoreError> {
            self.0.erase(page)
        }
        fn write(
            &mut self,
            page: Page,
            bytes: &[u8],
        ) -> Result<(), stspp_firmware_logic::hardware::StoreError> {
            self.0.write(page, bytes)?;
            self.0.pages[page as usize][17] ^= 0x20;
            Ok(())
        }
    }
    let mut flash = MockFlash::default();
    save(&mut flash, &settings(100)).unwrap();
    let mut flash = Forgetful(flash);
    assert_eq!(save(&mut flash, &settings(200)), Err(StorageError::Write));
    assert_eq!(load(&flash), Ok(settings(100)));
}

proptest! {
    /// Any damage to the newer record leaves the older one; noise alone is nothing.
    #[test]
    fn damage_is_noticed(
        at in 0..RECORD_LEN, flip in 1u8.., noise in prop::collection::vec(any::<u8>(), 256),
    ) {
        let mut flash = MockFlash::default();
        save(&mut flash, &settings(100)).unwrap();
        save(&mut flash, &settings(200)).unwrap();
        flash.pages[Page::B as usize][at] ^= flip;
        prop_assert_eq!(load(&flash), Ok(settings(100)));
        flash.pages[Page::B as usize].copy_from_slice(&noise);
        prop_assert_eq!(load(&flash), Ok(settings(100)));
        flash.pages[Page::A as usize].copy_from_slice(&noise);
        prop_assert_eq!(load(&flash), Err(StorageError::Read));
    }
}
