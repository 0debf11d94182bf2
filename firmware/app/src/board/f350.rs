//! Board with the GD32F350: native USB on PA11 and PA12.

use stspp_protocol::version::{BoardKind, Capabilities};

/// Which board this is.
pub(crate) const BOARD: BoardKind = BoardKind::F350;

/// What it can do.
pub(crate) const CAPABILITIES: Capabilities = Capabilities::SETTINGS_STORE
    .union(Capabilities::BOOTLOADER)
    .union(Capabilities::FLOODLIGHT)
    .union(Capabilities::TEMPERATURE)
    .union(Capabilities::TRIGGER_IN)
    .union(Capabilities::USB_SOF);

/// Whether the chip of this board has a USB core.
pub(crate) const HAS_USB: bool = true;

/// Number of the host's last start-of-frame packet.
pub(crate) fn usb_sof() -> Option<u16> {
    Some(embassy_gd32f3x0::usb::frame_number())
}

/// Starts the link's tasks.
macro_rules! spawn_link {
    ($spawner:ident, $p:ident) => {{
        interrupt::USBFS.set_priority(Priority::P2);
        let usb = tasks::usb::build($p.USBFS, $p.PA11, $p.PA12, Irqs);
        $spawner.spawn(tasks::usb::device(usb.device).expect("spawned once"));
        $spawner.spawn(tasks::usb::events(usb.events).expect("spawned once"));
        $spawner.spawn(tasks::usb::link(usb.requests, usb.replies).expect("spawned once"));
    }};
}
pub(crate) use spawn_link;
