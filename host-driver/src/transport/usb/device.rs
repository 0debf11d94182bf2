//! Sensors on this machine's USB buses, through libusb.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rusb::{Context, Device, DeviceHandle, Speed, UsbContext};
use serde::Serialize;
use stspp_protocol::usb as ids;

use super::UsbTransport;
use super::pipes::{PipeError, Pipes};
use crate::transport::TransportError;

/// What to do where the device's file may not be opened.
const UDEV_REMEDY: &str =
    "install the udev rule (udev/70-stspp.rules, see `stspp doctor`) and plug the sensor in again";

/// A sensor's control interface on a USB bus.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct UsbSensor {
    /// Serial number; empty where it could not be read.
    pub serial: String,
    /// Kernel name of the device: bus and ports, such as `1-2.3`.
    pub usb_path: String,
    /// The device's file, which must be writable to open it.
    pub node: PathBuf,
    /// Bus speed in Mbit/s; 0 where it is not known.
    pub speed_mbit_s: u32,
}

/// All sensors that are plugged in, by their ports. Devices count by their ids and the class of their
/// interface; none is opened unless its serial number cannot be had otherwise.
///
/// # Errors
/// When USB is not available at all.
pub fn sensors() -> Result<Vec<UsbSensor>, TransportError> {
    let context = context("usb:")?;
    Ok(found(&context)?.into_iter().map(|(sensor, _)| sensor).collect())
}

/// Opens the sensor with this serial number, or the only one there is.
///
/// # Errors
/// None or several there, no permission, in use.
pub fn open(serial: Option<&str>) -> Result<(UsbTransport, UsbSensor), TransportError> {
    let link = format!("usb:{}", serial.unwrap_or_default());
    let context = context(&link)?;
    let mut fitting = found(&context)?;
    fitting.retain(|(sensor, _)| serial.is_none_or(|wanted| sensor.serial == wanted));
    let (sensor, device) = match fitting.len() {
        0 => return Err(TransportError::NotFound { link }),
        1 => fitting.remove(0),
        _ => {
            let found = fitting.iter().map(|(s, _)| format!("usb:{}", s.serial)).collect();
            return Err(TransportError::Ambiguous { link, found });
        }
    };
    let failed = |error| open_error(&link, &sensor.node, error);
    let handle = device.open().map_err(failed)?;
    // Nothing but this program has a driver for the interface; where the system has none to detach, it
    // says so, which is as good.
    let _ = handle.set_auto_detach_kernel_driver(true);
    if handle.active_configuration().ok() != Some(1) {
        handle.set_active_configuration(1).map_err(failed)?;
    }
    handle.claim_interface(ids::INTERFACE_NUMBER).map_err(failed)?;
    let name = format!("usb:{}", sensor.serial);
    let transport = UsbTransport::new(&name, Arc::new(Handle(handle)))?;
    Ok((transport, sensor))
}

fn context(link: &str) -> Result<Context, TransportError> {
    Context::new().map_err(|error| io_error(link, error))
}

fn io_error(link: &str, error: rusb::Error) -> TransportError {
    TransportError::Io { link: link.to_owned(), source: std::io::Error::other(error) }
}

fn open_error(link: &str, node: &Path, error: rusb::Error) -> TransportError {
    let link = link.to_owned();
    match error {
        rusb::Error::Access => {
            TransportError::Permission { link, node: node.into(), remedy: UDEV_REMEDY }
        }
        rusb::Error::Busy => TransportError::Busy { link },
        rusb::Error::NoDevice | rusb::Error::NotFound => TransportError::Gone { link },
        other => io_error(&link, other),
    }
}

fn found(context: &Context) -> Result<Vec<(UsbSensor, Device<Context>)>, TransportError> {
    let devices = context.devices().map_err(|error| io_error("usb:", error))?;
    let mut found: Vec<_> =
        devices.iter().filter(is_sensor).map(|device| (describe(&device), device)).collect();
    found.sort_by(|a, b| a.0.usb_path.cmp(&b.0.usb_path));
    Ok(found)
}

fn is_sensor(device: &Device<Context>) -> bool {
    let ours = device
        .device_descriptor()
        .is_ok_and(|d| (d.vendor_id(), d.product_id()) == (ids::VENDOR_ID, ids::PRODUCT_ID));
    ours && device.config_descriptor(0).is_ok_and(|configuration| {
        configuration.interfaces().flat_map(|interface| interface.descriptors()).any(|i| {
            (i.class_code(), i.sub_class_code()) == (ids::INTERFACE_CLASS, ids::INTERFACE_SUBCLASS)
        })
    })
}

fn describe(device: &Device<Context>) -> UsbSensor {
    let ports = device.port_numbers().unwrap_or_default();
    let ports: Vec<String> = ports.iter().map(u8::to_string).collect();
    let usb_path = format!("{}-{}", device.bus_number(), ports.join("."));
    let node = format!("/dev/bus/usb/{:03}/{:03}", device.bus_number(), device.address());
    let of_kernel = std::fs::read_to_string(format!("/sys/bus/usb/devices/{usb_path}/serial"));
    let serial = match of_kernel {
        Ok(serial) => serial.trim().to_owned(),
        Err(_) => serial_by_opening(device).unwrap_or_default(),
    };
    let speed_mbit_s = match device.speed() {
        Speed::Low => 1,
        Speed::Full => 12,
        Speed::High => 480,
        Speed::Super => 5000,
        Speed::SuperPlus => 10_000,
        _ => 0,
    };
    UsbSensor { serial, usb_path, node: node.into(), speed_mbit_s }
}

fn serial_by_opening(device: &Device<Context>) -> Option<String> {
    let descriptor = device.device_descriptor().ok()?;
    device.open().ok()?.read_serial_number_string_ascii(&descriptor).ok()
}

/// An open device with its interface claimed; given back when dropped.
struct Handle(DeviceHandle<Context>);

fn pipe_error(error: rusb::Error) -> PipeError {
    match error {
        rusb::Error::Timeout => PipeError::Timeout,
        rusb::Error::Pipe => PipeError::Halted,
        rusb::Error::NoDevice => PipeError::Gone,
        other => PipeError::Io(std::io::Error::other(other)),
    }
}

/// libusb takes a timeout of zero for no limit at all.
fn bounded(timeout: Duration) -> Duration {
    timeout.max(Duration::from_millis(1))
}

impl Pipes for Handle {
    fn read(&self, endpoint: u8, buffer: &mut [u8], timeout: Duration) -> Result<usize, PipeError> {
        let timeout = bounded(timeout);
        let read = if endpoint == ids::ENDPOINT_EVENTS {
            self.0.read_interrupt(endpoint, buffer, timeout)
        } else {
            self.0.read_bulk(endpoint, buffer, timeout)
        };
        read.map_err(pipe_error)
    }

    fn write(&self, endpoint: u8, bytes: &[u8], timeout: Duration) -> Result<usize, PipeError> {
        self.0.write_bulk(endpoint, bytes, bounded(timeout)).map_err(pipe_error)
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), PipeError> {
        self.0.clear_halt(endpoint).map_err(pipe_error)
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        // A device that is gone has nothing to give back.
        let _ = self.0.release_interface(ids::INTERFACE_NUMBER);
    }
}
