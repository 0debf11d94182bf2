//! Flash, static RAM and the stack's high-water mark of both boards.

mod common;

use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::measure::faults::light_up;
use stspp_hil_mcu::session::Session;
use stspp_protocol::message::Request;
use stspp_protocol::request::{
    Disarm, GetStatus, GetTiming, Heartbeat, LoadSettings, SaveSettings, SetTiming,
};
use stspp_protocol::timing::{ProjectionTiming, Slot};

/// The area that runs without wait states.
const FLASH_BUDGET: u32 = 64 * 1024;
/// Static RAM and stack together.
const RAM_BUDGET: u32 = 14 * 1024;

#[test]
fn flash_and_ram_stay_within_their_budgets() {
    for variant in common::BOARDS {
        let Some(image) = common::image(variant) else { continue };
        let mut controller = McuController::start(variant, image.clone()).unwrap();
        controller.chip().paint_stack(&image);
        // The boot is part of the account: again, on the painted stack.
        controller.chip().reset(stspp_hil_mcu::soc::peripheral::ResetCause::Pin);
        let mut session = Session::new(controller);
        session.run_for(1_000_000_000);
        // The deepest paths: the largest messages, faults, settings, slots at the highest rate.
        let full = ProjectionTiming {
            slots: (0..16).map(|n| Slot::projector(n % 10)).collect(),
            frame_period_us: 1_000,
            exposure_us: 900,
            trigger_delay_us: 20,
            gate_lead_us: 10,
            gate_lag_us: 10,
        };
        light_up(&mut session, &full).unwrap();
        for _ in 0..50 {
            for request in [
                Request::GetStatus(GetStatus),
                Request::GetTiming(GetTiming),
                Request::Heartbeat(Heartbeat),
            ] {
                session.call(request).unwrap();
            }
            session.call(Request::SetTiming(SetTiming { timing: full.clone() })).unwrap();
        }
        session.call(Request::Disarm(Disarm)).unwrap();
        session.call(Request::SaveSettings(SaveSettings)).unwrap();
        session.call(Request::LoadSettings(LoadSettings)).unwrap();
        session.run_for(100_000_000);
        let stack = session.controller.chip().stack_used(&image);
        let ram = image.static_ram_bytes + stack;
        println!(
            "{variant:?}: flash {} of {FLASH_BUDGET} bytes, static RAM {} + stack {stack} = {ram} of {RAM_BUDGET} bytes",
            image.flash_bytes, image.static_ram_bytes
        );
        assert!(image.flash_bytes < FLASH_BUDGET, "{variant:?}: flash {}", image.flash_bytes);
        assert!(ram < RAM_BUDGET, "{variant:?}: RAM {ram}");
        common::assert_all_modelled(&mut session);
    }
}
