//! Prints the table of docs/hardware.md: every cause of darkness, its bound, and what the emulated
//! chip measures: `cargo run -p stspp-hil-mcu --example fault_table [-- f330|f350 ELF]`.

use std::path::PathBuf;

use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::measure::faults::{Cause, measure};
use stspp_hil_mcu::session::Session;
use stspp_hil_mcu::soc::Variant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let boards = match &args[..] {
        [] => vec![
            ("f330", PathBuf::from("target/firmware/f330.elf")),
            ("f350", PathBuf::from("target/firmware/f350.elf")),
        ],
        [name, elf] => vec![(name.as_str(), PathBuf::from(elf))],
        _ => return Err("usage: fault_table [f330|f350 ELF]".into()),
    };
    println!(
        "| board | cause | bound | measured | latched | survives reset | arms only after clearing | light again only then |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for (name, elf) in boards {
        let variant = if name == "f350" { Variant::F350 } else { Variant::F330 };
        for cause in Cause::ALL.into_iter().filter(|cause| cause.applies_to(variant)) {
            let mut session = Session::new(McuController::load(variant, &elf)?);
            session.run_for(20_000_000);
            match measure(&mut session, cause) {
                Ok(o) => println!(
                    "| {name} | {} | {} | {} | {} | {} | {} | {} |",
                    cause.describe(),
                    time(Some(cause.bound_ns(variant))),
                    time(o.dark_after_ns),
                    o.latched,
                    o.latched_after_reset,
                    yes(o.refused_to_arm),
                    yes(o.recovered && !o.light_again),
                ),
                Err(error) => {
                    println!("| {name} | {} | | failed: {error} | | | | |", cause.describe())
                }
            }
            for entry in session.controller.chip().unmodelled() {
                println!("unmodelled: {}", entry.what);
            }
        }
    }
    Ok(())
}

fn time(ns: Option<u64>) -> String {
    match ns {
        None => "never".to_string(),
        Some(ns) if ns < 1_000_000 => format!("{:.2} us", ns as f64 / 1e3),
        Some(ns) => format!("{:.2} ms", ns as f64 / 1e6),
    }
}

fn yes(on: bool) -> &'static str {
    if on { "yes" } else { "no" }
}
