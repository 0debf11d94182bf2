//! Says hello to a firmware and prints what it answers and logs:
//! `cargo run -p stspp-hil-mcu --example talk -- f330 target/firmware/f330.elf`.

use std::path::Path;

use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::defmt_log::DefmtLog;
use stspp_hil_mcu::session::Session;
use stspp_hil_mcu::soc::Variant;
use stspp_protocol::message::Request;
use stspp_protocol::request::{Arm, GetFaults, GetStatus, StartStream};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().collect();
    let [_, name, elf] = &args[..] else { return Err("usage: talk f330|f350 ELF".into()) };
    let variant = if name == "f350" { Variant::F350 } else { Variant::F330 };
    let mut session = Session::new(McuController::load(variant, Path::new(elf))?);
    let mut log = DefmtLog::new(session.controller.image());
    if let Some(enumerated) = session.controller.enumerated() {
        println!("{enumerated}");
    }
    session.run_for(20_000_000);
    println!("hello: {:?}", session.hello());
    for request in [
        Request::GetStatus(GetStatus),
        Request::GetFaults(GetFaults),
        Request::Arm(Arm),
        Request::StartStream(StartStream),
    ] {
        let reply = session.call(request);
        println!("{:?} after {} us", reply, session.last_call_ns / 1000);
    }
    session.run_for(200_000_000);
    for received in session.take_events() {
        println!("{received:?}");
    }
    for edge in session.take_edges() {
        println!("{edge:?}");
    }
    let chip = session.controller.chip();
    for line in log.as_mut().map(|log| log.read(chip)).unwrap_or_default() {
        println!("log: {line}");
    }
    for entry in chip.unmodelled() {
        println!("unmodelled: {} ({} times)", entry.what, entry.count);
    }
    println!(
        "resets {:?}; {} bad frames; registers {:x?}",
        chip.resets(),
        session.bad_frames,
        chip.registers()
    );
    Ok(())
}
