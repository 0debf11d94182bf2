//! Settings in the flash: they survive power loss, and a torn write leaves the old ones.

mod common;

use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::session::{CallError, Session};
use stspp_hil_mcu::soc::Variant;
use stspp_hil_sim::device::Controller;
use stspp_protocol::message::{Reply, Request};
use stspp_protocol::reply::{RequestError, StorageError};
use stspp_protocol::request::{GetTiming, LoadSettings, SaveSettings, SetTiming};
use stspp_protocol::timing::ProjectionTiming;

/// The two pages of the settings (firmware/app/src/board).
const PAGES: [u32; 2] = [0x0800_0000 + 126 * 1024, 0x0800_0000 + 127 * 1024];

fn timing(exposure_us: u32) -> ProjectionTiming {
    ProjectionTiming { exposure_us, ..ProjectionTiming::default() }
}

fn active(session: &mut Session<McuController>) -> ProjectionTiming {
    match session.call(Request::GetTiming(GetTiming)).unwrap() {
        Reply::GetTiming(active) => active.timing,
        other => panic!("the reply to GetTiming is {other:?}"),
    }
}

fn save(session: &mut Session<McuController>, exposure_us: u32) {
    session.hello().unwrap();
    session.call(Request::SetTiming(SetTiming { timing: timing(exposure_us) })).unwrap();
    session.call(Request::SaveSettings(SaveSettings)).unwrap();
}

fn power_cycle(session: &mut Session<McuController>) {
    session.controller.chip().brown_out(10_000_000);
    // The F350 is enumerated anew: its bus is debounced for 100 ms, and reset.
    let boot_ns = if session.controller.enumerated().is_some() { 300_000_000 } else { 30_000_000 };
    session.run_for(boot_ns);
    session.drop_replies();
}

#[test]
fn settings_survive_power_loss_and_torn_writes_on_the_f330() {
    survive_power_loss(Variant::F330);
}

#[test]
fn settings_survive_power_loss_and_torn_writes_on_the_f350() {
    survive_power_loss(Variant::F350);
}

fn survive_power_loss(variant: Variant) {
    let Some(mut session) = common::session(variant) else { return };
    session.hello().unwrap();
    assert!(matches!(
        session.call(Request::LoadSettings(LoadSettings)),
        Err(CallError::Refused(RequestError::Storage(StorageError::Empty)))
    ));
    save(&mut session, 10_000);
    power_cycle(&mut session);
    assert_eq!(active(&mut session).exposure_us, 10_000, "settings are back after a power cycle");

    // Power fails at moments all over a save: the old settings or the new, never anything else.
    let mut kept = 10_000;
    let (mut old, mut new) = (0, 0);
    for step in 0..24u32 {
        let wanted = 11_000 + step;
        session.hello().unwrap();
        session.call(Request::SetTiming(SetTiming { timing: timing(wanted) })).unwrap();
        let before = session.controller.chip().soc().fmc.operations();
        session.send(&Request::SaveSettings(SaveSettings));
        // Up to the erase, then through the program operations in steps.
        let started = session
            .controller
            .chip()
            .run_until(100_000_000, 20_000, |chip| chip.soc().fmc.operations() > before);
        assert!(started, "the save touches the flash");
        let wait_ns = if step < 4 {
            u64::from(step) * 12_000_000
        } else {
            44_900_000 + u64::from(step - 4) * 110_000
        };
        session.controller.chip().run_for_ns(wait_ns);
        power_cycle(&mut session);
        let found = active(&mut session).exposure_us;
        assert!(
            found == kept || found == wanted,
            "cut {step}: {found}, neither {kept} nor {wanted}"
        );
        if found == wanted {
            new += 1
        } else {
            old += 1
        }
        kept = found;
    }
    println!("{variant:?}: 24 cuts: {old} left the old settings, {new} the new");
    assert!(old > 0 && new > 0, "the cuts fell before and after the end of the write");
    common::assert_all_modelled(&mut session);
}

#[test]
fn corrupt_settings_are_not_taken() {
    for variant in common::BOARDS {
        corrupt_settings(variant);
    }
}

fn corrupt_settings(variant: Variant) {
    let Some(mut session) = common::session(variant) else { return };
    save(&mut session, 10_000);
    for (n, page) in PAGES.into_iter().enumerate() {
        for word in 0..64u32 {
            session
                .controller
                .chip()
                .poke(page + 4 * word, 0x1234_5678u32.wrapping_mul(word + n as u32 + 1));
        }
    }
    power_cycle(&mut session);
    assert_eq!(active(&mut session), ProjectionTiming::default());
    session.hello().unwrap();
    let refused = session.call(Request::LoadSettings(LoadSettings)).unwrap_err();
    assert_eq!(refused, CallError::Refused(RequestError::Storage(StorageError::Read)));
    println!("{variant:?}: {refused}");
    // And they can be written again.
    save(&mut session, 12_000);
    power_cycle(&mut session);
    assert_eq!(active(&mut session).exposure_us, 12_000);
    assert!(session.controller.now_ns() > 0);
}
