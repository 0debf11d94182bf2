//! A depth stream whose light is gated by the firmware's own binary on the emulated chip.

use std::time::Duration;

use stspp::Sensor;
use stspp_hil_mcu::controller::{McuController, firmware_elf};
use stspp_hil_mcu::soc::Variant;

/// What a fresh clone says, where the firmware has not been built.
#[test]
fn a_missing_image_names_the_command_that_builds_it() {
    let missing = std::path::Path::new("/nowhere/f350.elf");
    let Err(error) = McuController::load(Variant::F350, missing) else { panic!("loaded nothing") };
    assert!(error.to_string().contains("cargo xtask firmware"), "{error}");
}

#[test]
fn depth_streams_from_the_emulated_binary() {
    for (variant, uri) in [
        (Variant::F330, "sim:plane?distance_m=1.0&scale=8&mcu=f330"),
        (Variant::F350, "sim:plane?distance_m=1.0&scale=8&mcu=f350"),
    ] {
        let elf = firmware_elf(variant);
        if !elf.exists() {
            println!(
                "SKIPPED: {} is not there; build it with `cargo xtask firmware`",
                elf.display()
            );
            continue;
        }
        let mut sensor = Sensor::open(uri).unwrap_or_else(|error| panic!("{uri}: {error}"));
        let mut stream = sensor.stream().unwrap();
        let frame = stream
            .next_timeout(Duration::from_secs(120))
            .unwrap_or_else(|error| panic!("{uri}: {error}"));
        let depth_m: Vec<f32> =
            frame.depth_m.as_slice().iter().copied().filter(|d| d.is_finite()).collect();
        assert!(depth_m.len() > 1_000, "{uri}: {} points", depth_m.len());
        let mean_m = depth_m.iter().sum::<f32>() / depth_m.len() as f32;
        assert!((mean_m - 1.0).abs() < 0.02, "{uri}: mean depth {mean_m} m");
    }
}
