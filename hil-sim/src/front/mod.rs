//! Faces of the simulated sensor towards other programs: the same device, reached another way.
//!
//! [`usb`] is what a USB device is to its host; [`control`] the controller as such a device, [`uvc`] a
//! camera, whose pictures are made in [`eyes`], [`plug`] a cable that can be pulled; [`bench`](mod@bench) is the sensor that they are parts
//! of; [`usbip`] serves any such devices to a Linux kernel.

pub mod bench;
pub mod control;
pub mod eyes;
pub mod plug;
pub mod usb;
pub mod usbip;
pub mod uvc;
