//! Settings over power cycles, and with power failing while they are written.

use stspp_firmware_logic::hardware::Page;
use stspp_firmware_logic::settings::RECORD_LEN;
use stspp_hil_sim::device::in_process::flash::{MemoryFlash, PAGE_LEN};
use stspp_hil_sim::device::in_process::{InProcessOptions, Injection};
use stspp_protocol::reply::{RequestError, StorageError};
use stspp_protocol::request::{GetTiming, SaveSettings};
use stspp_protocol::timing::ProjectionTiming;

use crate::host::{Host, MS};

fn timing(exposure_us: u32) -> ProjectionTiming {
    ProjectionTiming { exposure_us, ..ProjectionTiming::default() }
}

fn with_flash(flash: MemoryFlash) -> Host {
    let mut host = Host::new(InProcessOptions { flash, ..InProcessOptions::default() });
    host.hello().unwrap();
    host
}

fn exposure_us(host: &mut Host) -> u32 {
    host.call(&GetTiming).unwrap().timing.exposure_us
}

#[test]
fn what_is_saved_is_there_after_power_on() {
    let mut host = Host::connected();
    host.set_timing(&timing(12_345));
    host.call(&SaveSettings).unwrap();
    host.set_timing(&timing(999));
    host.device.inject(Injection::PowerCycle);
    host.run(10 * MS);
    assert_eq!(exposure_us(&mut host), 12_345);
    let mut host = with_flash(host.device.into_flash());
    assert_eq!(exposure_us(&mut host), 12_345);
}

/// Power fails after every possible number of bytes: the old settings or the new ones, nothing else.
#[test]
fn a_torn_write_leaves_the_old_settings() {
    // Three records, so that both pages hold one and the older is overwritten.
    let mut host = Host::connected();
    for exposure_us in [1_000, 2_000, 3_000] {
        host.set_timing(&timing(exposure_us));
        host.call(&SaveSettings).unwrap();
    }
    let flash = host.device.into_flash();
    assert_eq!(flash.erase_count(Page::A) + flash.erase_count(Page::B), 3);
    let all = PAGE_LEN + RECORD_LEN;
    let mut torn = 0;
    for bytes in (0..=all).step_by(7).chain([all - 1, all]) {
        let mut failing = flash.clone();
        failing.fail_after(Some(bytes));
        let mut host = with_flash(failing);
        assert_eq!(exposure_us(&mut host), 3_000);
        host.set_timing(&timing(4_000));
        let saved = host.call(&SaveSettings);
        if bytes < all {
            assert_eq!(saved, Err(RequestError::Storage(StorageError::Write)));
            torn += 1;
        } else {
            saved.unwrap();
        }
        let mut flash = host.device.into_flash();
        flash.fail_after(None);
        let mut host = with_flash(flash);
        assert_eq!(exposure_us(&mut host), if bytes < all { 3_000 } else { 4_000 });
        // The next save works again.
        host.set_timing(&timing(5_000));
        host.call(&SaveSettings).unwrap();
        let mut host = with_flash(host.device.into_flash());
        assert_eq!(exposure_us(&mut host), 5_000);
    }
    assert!(torn > 100);
}

#[test]
fn corrupt_flash_falls_back_to_the_older_record_and_then_to_defaults() {
    let mut host = Host::connected();
    for exposure_us in [1_000, 2_000] {
        host.set_timing(&timing(exposure_us));
        host.call(&SaveSettings).unwrap();
    }
    let flash = host.device.into_flash();
    for at in 0..RECORD_LEN {
        for bit in [0, 3, 7] {
            let mut flash = flash.clone();
            flash.page_mut(Page::B)[at] ^= 1 << bit;
            let mut host = with_flash(flash);
            assert_eq!(exposure_us(&mut host), 1_000, "byte {at} bit {bit}");
        }
    }
    let mut both = flash.clone();
    both.page_mut(Page::A)[20] ^= 1;
    both.page_mut(Page::B)[20] ^= 1;
    assert_eq!(exposure_us(&mut with_flash(both)), 32_000);
}
