//! The tasks, one a file.

pub(crate) mod led;
#[cfg(feature = "board-f330")]
pub(crate) mod serial;
pub(crate) mod supervisor;
pub(crate) mod temperature;
#[cfg(feature = "board-f350")]
pub(crate) mod usb;
