//! USB/IP: simulated USB devices for a Linux kernel (kernel documentation, `usbip_protocol`).
//!
//! [`wire`] is the byte layout, [`session`] one imported device over one byte stream, [`server`] the
//! socket that lists devices and hands them out, [`client`] the host's side of it.

pub mod client;
pub mod server;
pub mod session;
pub mod wire;
