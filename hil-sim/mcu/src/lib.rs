//! An emulated GD32F330 or GD32F350 that runs the firmware's own ELF in virtual time.
//!
//! [`chip::Chip`] is the chip: a Cortex-M4F core ([`cpu`]), peripherals counted in core clock cycles
//! ([`soc`]), the USB device core with a host at the other end of its cable ([`usb`]). Time passes
//! only in `run_until_ns`; sleeping costs nothing. [`controller::McuController`] puts it behind the
//! same trait as the in-process simulator.
//!
//! Whatever register or bit the firmware touches that has no model is listed by the vendor's name
//! ([`chip::Chip::unmodelled`]): a test that ends with an empty list has met the chip's manual, not
//! an emulator's guess.

pub mod board;
pub mod chip;
pub mod clock;
pub mod controller;
pub mod cpu;
#[cfg(feature = "defmt-log")]
pub mod defmt_log;
pub mod front;
pub mod image;
pub mod measure;
pub mod rtt;
pub mod session;
pub mod soc;
pub mod trace;
pub mod usb;
