//! The firmware images under test. They are built by `cargo xtask firmware`; without them a test says
//! that it does nothing, and passes.
#![allow(dead_code, reason = "each test binary uses its part")]

use stspp_hil_mcu::chip::Chip;
use stspp_hil_mcu::controller::{McuController, firmware_elf};
use stspp_hil_mcu::image::Image;
use stspp_hil_mcu::session::Session;
use stspp_hil_mcu::soc::Variant;

pub const BOARDS: [Variant; 2] = [Variant::F330, Variant::F350];

/// The image of a board, or a printed line that says that the test does nothing.
pub fn image(variant: Variant) -> Option<Image> {
    let path = firmware_elf(variant);
    if !path.exists() {
        println!(
            "SKIPPED for {variant:?}: {} is not there; build it with `cargo xtask firmware`",
            path.display()
        );
        return None;
    }
    Some(Image::load(&path).unwrap_or_else(|error| panic!("{error}")))
}

/// A host talking to a chip that has booted.
pub fn session(variant: Variant) -> Option<Session<McuController>> {
    let controller = McuController::start(variant, image(variant)?)
        .unwrap_or_else(|error| panic!("{variant:?}: {error}"));
    let mut session = Session::new(controller);
    session.run_for(20_000_000);
    Some(session)
}

/// The firmware's own log since its start (as far as its buffer keeps it).
pub fn log(session: &mut Session<McuController>) -> Vec<String> {
    let image = session.controller.image().clone();
    match stspp_hil_mcu::defmt_log::DefmtLog::new(&image) {
        Some(mut log) => log.read(session.controller.chip()),
        None => vec!["(no log)".to_string()],
    }
}

/// Fails where the firmware touched a register or bit that has no model.
pub fn assert_all_modelled(session: &mut Session<McuController>) {
    assert_chip_modelled(session.controller.chip());
}

/// The same for a chip.
pub fn assert_chip_modelled(chip: &Chip) {
    let touched = chip.unmodelled();
    assert!(touched.is_empty(), "not modelled: {touched:#?}");
}
