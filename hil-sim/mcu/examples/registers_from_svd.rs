//! Writes `data/gd32f3x0_registers.tsv` from the SVD that the `gd32f3x0-pac` crate ships:
//! `cargo run -p stspp-hil-mcu --example registers_from_svd -- path/to/GD32F3x0.svd`.
//!
//! One line per register: peripheral, base address, register, offset, reset value, fields as
//! `NAME:bit:width` joined by commas. The emulator names unmodelled registers and bits by it.

use std::collections::HashMap;
use std::fmt::Write as _;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("usage: registers_from_svd SVD")?;
    let text = std::fs::read_to_string(path)?;
    let document = roxmltree::Document::parse(&text)?;
    let peripherals: Vec<_> =
        document.descendants().filter(|n| n.has_tag_name("peripheral")).collect();
    let by_name: HashMap<&str, _> = peripherals.iter().map(|p| (child(p, "name"), *p)).collect();

    let mut out =
        String::from("# generated from GD32F3x0.svd of gd32f3x0-pac 0.1.0 (MIT OR Apache-2.0)\n");
    for peripheral in &peripherals {
        let name = child(peripheral, "name");
        let base = number(child(peripheral, "baseAddress"));
        let source = match peripheral.attribute("derivedFrom") {
            Some(from) if !peripheral.children().any(|c| c.has_tag_name("registers")) => {
                by_name[from]
            }
            _ => *peripheral,
        };
        let mut registers: Vec<_> =
            source.descendants().filter(|n| n.has_tag_name("register")).collect();
        registers.sort_by_key(|r| number(child(r, "addressOffset")));
        for register in registers {
            let mut fields: Vec<_> = register
                .descendants()
                .filter(|n| n.has_tag_name("field"))
                .map(|f| {
                    (
                        number(child(&f, "bitOffset")),
                        number(child(&f, "bitWidth")),
                        child(&f, "name").to_string(),
                    )
                })
                .collect();
            fields.sort();
            let fields: Vec<String> = fields
                .into_iter()
                .map(|(bit, width, name)| format!("{name}:{bit}:{width}"))
                .collect();
            writeln!(
                out,
                "{name}\t{base:08x}\t{}\t{:x}\t{:x}\t{}",
                child(&register, "name"),
                number(child(&register, "addressOffset")),
                number(child(&register, "resetValue")),
                fields.join(",")
            )?;
        }
    }
    let target = concat!(env!("CARGO_MANIFEST_DIR"), "/data/gd32f3x0_registers.tsv");
    std::fs::write(target, out)?;
    println!("wrote {target}");
    Ok(())
}

/// Text of the first child element with this tag, or "0" where the SVD leaves it out.
fn child<'a>(node: &roxmltree::Node<'a, '_>, tag: &str) -> &'a str {
    node.children().find(|c| c.has_tag_name(tag)).and_then(|c| c.text()).map_or("0", str::trim)
}

fn number(text: &str) -> u64 {
    match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(hex) => u64::from_str_radix(hex, 16),
        None => text.parse(),
    }
    .unwrap_or_else(|_| panic!("not a number in the SVD: {text}"))
}
