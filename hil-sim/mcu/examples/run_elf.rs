//! Runs a firmware ELF and shows what it does:
//! `cargo run -p stspp-hil-mcu --example run_elf -- f330 target/firmware/f330.elf 200` (milliseconds).

use std::path::Path;

use stspp_hil_mcu::chip::Chip;
use stspp_hil_mcu::defmt_log::DefmtLog;
use stspp_hil_mcu::image::Image;
use stspp_hil_mcu::soc::Variant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().collect();
    let [_, variant, elf, milliseconds] = &args[..] else {
        return Err("usage: run_elf f330|f350 ELF MILLISECONDS".into());
    };
    let variant = match variant.as_str() {
        "f330" => Variant::F330,
        "f350" => Variant::F350,
        other => return Err(format!("no such chip: {other}").into()),
    };
    let image = Image::load(Path::new(elf))?;
    println!("flash {} bytes, static RAM {} bytes", image.flash_bytes, image.static_ram_bytes);
    let mut log = DefmtLog::new(&image);
    let mut chip = Chip::new(variant, &image);
    let start = std::time::Instant::now();
    let milliseconds: u64 = milliseconds.parse()?;
    for _ in 0..milliseconds {
        chip.run_for_ns(1_000_000);
        for line in log.as_mut().map(|l| l.read(&mut chip)).unwrap_or_default() {
            println!("{:10.3} ms  {line}", chip.now_ns() as f64 / 1e6);
        }
        for change in chip.take_pin_changes() {
            println!("{:10.3} ms  {} {:?}", change.time_ns as f64 / 1e6, change.pin, change.level);
        }
    }
    println!(
        "{} instructions at {} MHz in {:.2} s",
        chip.instructions(),
        chip.hclk_hz() / 1_000_000,
        start.elapsed().as_secs_f64()
    );
    for reset in chip.resets() {
        println!("reset at {:.3} ms: {:?}", reset.time_ns as f64 / 1e6, reset.cause);
    }
    for entry in chip.unmodelled() {
        println!("unmodelled: {} ({} times)", entry.what, entry.count);
    }
    println!("pc and registers {:x?}", chip.registers());
    Ok(())
}
