//! Sensors that are plugged in and unplugged, told by libusb.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, unbounded};
use rusb::{Context, Device, Hotplug, HotplugBuilder, UsbContext};
use stspp_protocol::usb as ids;

use super::device::{self, UsbSensor};
use crate::transport::TransportError;

/// How often the list is looked at besides: a device is announced before its file can be opened, and
/// some systems announce none.
const LOOK: Duration = Duration::from_millis(250);

/// A device with a sensor's ids came or went.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// Plugged in, at this bus and these ports, such as `1-2.3`.
    Arrived(String),
    /// Unplugged from there.
    Left(String),
}

/// Watches the buses; ends when dropped.
pub struct Monitor {
    changes: Receiver<Change>,
    stop: Arc<AtomicBool>,
    context: Context,
    thread: Option<JoinHandle<()>>,
}

struct Reporter(Sender<Change>);

fn usb_path(device: &Device<Context>) -> String {
    let ports = device.port_numbers().unwrap_or_default();
    let ports: Vec<String> = ports.iter().map(u8::to_string).collect();
    format!("{}-{}", device.bus_number(), ports.join("."))
}

impl Hotplug<Context> for Reporter {
    fn device_arrived(&mut self, device: Device<Context>) {
        // Without a listener there is nobody to tell.
        let _ = self.0.send(Change::Arrived(usb_path(&device)));
    }

    fn device_left(&mut self, device: Device<Context>) {
        let _ = self.0.send(Change::Left(usb_path(&device)));
    }
}

impl Monitor {
    /// Watches from now on; devices that are there already are reported as arrived.
    ///
    /// # Errors
    /// When USB is not available, or this system does not tell of changes.
    pub fn new() -> Result<Self, TransportError> {
        let failed = |error: rusb::Error| TransportError::Io {
            link: "usb:".into(),
            source: std::io::Error::other(error),
        };
        let context = Context::new().map_err(failed)?;
        let (sender, changes) = unbounded();
        let mut builder = HotplugBuilder::new();
        builder.vendor_id(ids::VENDOR_ID).product_id(ids::PRODUCT_ID).enumerate(true);
        let registration =
            builder.register::<Context, _>(&context, Box::new(Reporter(sender))).map_err(failed)?;
        let stop = Arc::<AtomicBool>::default();
        let (stopped, events) = (Arc::clone(&stop), context.clone());
        let run = move || {
            let _registration = registration;
            while !stopped.load(Ordering::Acquire) {
                if events.handle_events(Some(LOOK)).is_err() {
                    std::thread::sleep(LOOK);
                }
            }
        };
        let thread = std::thread::Builder::new()
            .name("stspp-hotplug".into())
            .spawn(run)
            .map_err(|source| TransportError::Io { link: "usb:".into(), source })?;
        Ok(Self { changes, stop, context, thread: Some(thread) })
    }

    /// The next change, waiting up to `timeout`.
    pub fn next(&self, timeout: Duration) -> Option<Change> {
        self.changes.recv_timeout(timeout).ok()
    }
}

impl Drop for Monitor {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.context.interrupt_handle_events();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Waits up to `timeout` for a sensor with this serial number (any, when `None`) to be plugged in.
///
/// # Errors
/// [`TransportError::NotFound`] when none came in time.
pub fn wait_for(serial: Option<&str>, timeout: Duration) -> Result<UsbSensor, TransportError> {
    let deadline = Instant::now() + timeout;
    let monitor = Monitor::new().ok();
    loop {
        let there = device::sensors()?
            .into_iter()
            .find(|sensor| serial.is_none_or(|wanted| sensor.serial == wanted));
        if let Some(sensor) = there {
            return Ok(sensor);
        }
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            let link = format!("usb:{}", serial.unwrap_or_default());
            return Err(TransportError::NotFound { link });
        }
        match &monitor {
            Some(monitor) => drop(monitor.next(left.min(LOOK))),
            None => std::thread::sleep(left.min(LOOK)),
        }
    }
}
