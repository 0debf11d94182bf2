//! Names of the chip's registers and fields, from the vendor's SVD (`data/gd32f3x0_registers.tsv`,
//! written by the example `registers_from_svd`). Only the log of unmodelled accesses uses them.

use std::collections::HashMap;
use std::sync::OnceLock;

/// A register as the SVD names it.
#[derive(Debug)]
pub struct Register {
    /// `PERIPHERAL.REGISTER`.
    pub name: String,
    /// Value after reset.
    pub reset: u32,
    /// Fields: name, lowest bit, width.
    pub fields: Vec<(String, u32, u32)>,
}

impl Register {
    /// Names the fields that have a bit in `mask`; bits that no field covers are called `bitN`.
    #[must_use]
    pub fn fields_in(&self, mask: u32) -> Vec<String> {
        let mut left = mask;
        let mut names = Vec::new();
        for (field, bit, width) in &self.fields {
            let field_mask = (u32::MAX >> (32 - width)) << bit;
            if left & field_mask != 0 {
                names.push(field.clone());
                left &= !field_mask;
            }
        }
        names.extend((0..32).filter(|bit| left >> bit & 1 != 0).map(|bit| format!("bit{bit}")));
        names
    }
}

/// The register at `address` (its first byte), if the SVD has one there.
#[must_use]
pub fn register_at(address: u32) -> Option<&'static Register> {
    table().get(&address)
}

fn table() -> &'static HashMap<u32, Register> {
    static TABLE: OnceLock<HashMap<u32, Register>> = OnceLock::new();
    TABLE.get_or_init(|| {
        include_str!("../../data/gd32f3x0_registers.tsv")
            .lines()
            .filter(|line| !line.starts_with('#'))
            .filter_map(parse)
            .collect()
    })
}

fn parse(line: &str) -> Option<(u32, Register)> {
    let mut columns = line.split('\t');
    let peripheral = columns.next()?;
    let base = u32::from_str_radix(columns.next()?, 16).ok()?;
    let register = columns.next()?;
    let offset = u32::from_str_radix(columns.next()?, 16).ok()?;
    let reset = u32::from_str_radix(columns.next()?, 16).ok()?;
    let fields = columns
        .next()?
        .split(',')
        .filter_map(|field| {
            let mut parts = field.split(':');
            Some((
                parts.next()?.to_string(),
                parts.next()?.parse().ok()?,
                parts.next()?.parse().ok()?,
            ))
        })
        .collect();
    Some((base + offset, Register { name: format!("{peripheral}.{register}"), reset, fields }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_names_registers_and_bits() {
        let ctl0 = register_at(0x4002_1000).unwrap();
        assert_eq!(ctl0.name, "RCU.CTL0");
        assert_eq!(ctl0.fields_in(1 << 24 | 1 << 2), ["PLLEN", "bit2"]);
        assert_eq!(register_at(0x5000_0800).unwrap().name, "USBFS_DEVICE.DCFG");
        assert!(table().len() > 500);
    }
}
