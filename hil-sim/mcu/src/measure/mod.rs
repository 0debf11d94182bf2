//! Measurements on the emulated chip: what tests assert and `docs/hardware.md` quotes.

pub mod faults;
pub mod timing;
