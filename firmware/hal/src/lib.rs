//! Embassy HAL for the GigaDevice GD32F330 and GD32F350 (feature `gd32f330` or `gd32f350`).
//!
//! [`init`] sets up clocks, the critical section and the time driver and hands out the
//! [`Peripherals`], each owned singleton is given to one driver; interrupts are tied to drivers by
//! [`bind_interrupts!`]. One file per peripheral; what is computed rather than written into
//! registers is in [`calc`], which builds and is tested on the host.
//!
//! The manual cited throughout is GigaDevice's *GD32F3x0 User Manual*, by chapter and section
//! name, "data sheet" the *GD32F330xx* and *GD32F350xx Datasheet*.
//!
//! TIMER1 belongs to the time driver: it counts microseconds, free-running, and its compare
//! channels 0 and 1 are used. Channels 2 and 3 drive [`sequence`].
#![cfg_attr(target_os = "none", no_std)]

pub mod calc;
pub mod chip;

#[cfg(target_os = "none")]
pub use gd32f3x0_pac as pac;

#[cfg(target_os = "none")]
mod device;
#[cfg(target_os = "none")]
pub use device::*;

#[cfg(target_os = "none")]
mod critical_section;
#[cfg(target_os = "none")]
mod regs;

#[cfg(target_os = "none")]
pub mod adc;
#[cfg(target_os = "none")]
pub mod dma;
#[cfg(target_os = "none")]
pub mod exti;
#[cfg(target_os = "none")]
pub mod flash;
#[cfg(target_os = "none")]
pub mod gpio;
#[cfg(target_os = "none")]
pub mod guard;
#[cfg(target_os = "none")]
pub mod rcu;
#[cfg(target_os = "none")]
pub mod reset;
#[cfg(target_os = "none")]
pub mod sequence;
#[cfg(target_os = "none")]
pub mod time_driver;
#[cfg(target_os = "none")]
pub mod timer;
#[cfg(target_os = "none")]
pub mod usart;
#[cfg(all(target_os = "none", feature = "gd32f350"))]
pub mod usb;
#[cfg(target_os = "none")]
pub mod watchdog;
