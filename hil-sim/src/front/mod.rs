//! Faces of the simulated sensor towards other programs: the same device, reached another way.
//!
//! [`usb`] is what a USB device is to its host; [`uvc`] a camera as such a device; [`usbip`] serves
//! any such devices to a Linux kernel.

pub mod usb;
pub mod usbip;
pub mod uvc;
