//! The control link through a serial port: 8N1 at 2 Mbaud, as the F330's USB-UART bridge has it.
//!
//! Ports are driven by the crate `serial2` (BSD/Apache); `serialport`, the better known one, is under
//! the MPL, which what ships here is to be free of. A port is locked while it is open, so that two
//! programs never share one.

use std::fs::{File, TryLockError};
use std::io::ErrorKind;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serial2::{CharSize, FlowControl, Parity, SerialPort, Settings, StopBits};
use stspp_protocol::request::GetInfo;
use stspp_protocol::usb::SERIAL_BAUD;
use stspp_protocol::version::DeviceInfo;

use super::{Link, Transport, TransportError};
use crate::Error;
use crate::clock::MonotonicClock;

/// Bytes of one read: at 2 Mbaud, 20 ms.
const READ: usize = 4096;

/// What to do where the port may not be opened.
const GROUP_REMEDY: &str = "add yourself to its group (on Debian: adduser $USER dialout, then log in \
                            again) or install the udev rule";

/// An open serial port.
pub struct SerialTransport {
    name: String,
    port: SerialPort,
    /// Holds the lock.
    _lock: File,
}

impl SerialTransport {
    /// Opens a port, locks it and sets its speed.
    ///
    /// # Errors
    /// Not there, no permission, in use, or not a serial port.
    pub fn open(path: &Path) -> Result<Self, TransportError> {
        let name = format!("serial:{}", path.display());
        let failed = |source: std::io::Error| open_error(&name, path, source);
        let port = SerialPort::open(path, settings).map_err(failed)?;
        let lock = File::from(port.as_fd().try_clone_to_owned().map_err(failed)?);
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(TransportError::Busy { link: name }),
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
        // What an earlier program left behind belongs to no request of ours.
        port.discard_buffers().map_err(failed)?;
        Ok(Self { name, port, _lock: lock })
    }

    fn error(&self, source: std::io::Error) -> TransportError {
        let link = self.name.clone();
        match source.raw_os_error() {
            // What a bridge says that was pulled out, and a pseudo-terminal whose other end is closed.
            Some(libc::EIO | libc::ENXIO | libc::ENODEV) => TransportError::Gone { link },
            _ if matches!(source.kind(), ErrorKind::BrokenPipe | ErrorKind::NotConnected) => {
                TransportError::Gone { link }
            }
            _ => TransportError::Io { link, source },
        }
    }
}

fn settings(mut settings: Settings) -> std::io::Result<Settings> {
    settings.set_raw();
    settings.set_baud_rate(SERIAL_BAUD)?;
    settings.set_char_size(CharSize::Bits8);
    settings.set_stop_bits(StopBits::One);
    settings.set_parity(Parity::None);
    settings.set_flow_control(FlowControl::None);
    Ok(settings)
}

fn open_error(name: &str, path: &Path, source: std::io::Error) -> TransportError {
    let link = name.to_owned();
    match source.kind() {
        ErrorKind::NotFound => TransportError::NotFound { link },
        ErrorKind::PermissionDenied => {
            TransportError::Permission { link, node: path.into(), remedy: GROUP_REMEDY }
        }
        ErrorKind::ResourceBusy => TransportError::Busy { link },
        _ => match source.raw_os_error() {
            Some(libc::EIO | libc::ENXIO | libc::ENODEV) => TransportError::Gone { link },
            _ => TransportError::NotAPort { link, source },
        },
    }
}

/// Waits are in whole milliseconds here; a short one must not become none, nor none a short one.
fn whole_milliseconds(timeout: Duration) -> Duration {
    Duration::from_millis(timeout.as_nanos().div_ceil(1_000_000).min(60_000) as u64)
}

impl Transport for SerialTransport {
    fn write(&mut self, mut bytes: &[u8], timeout: Duration) -> Result<(), TransportError> {
        let deadline = std::time::Instant::now() + timeout;
        while !bytes.is_empty() {
            let left = deadline.saturating_duration_since(std::time::Instant::now());
            let set = self.port.set_write_timeout(whole_milliseconds(left));
            set.map_err(|e| self.error(e))?;
            match self.port.write(bytes) {
                Ok(written) if written > 0 => bytes = &bytes[written..],
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) if !matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock) => {
                    return Err(self.error(e));
                }
                _ if left.is_zero() => {
                    let link = self.name.clone();
                    return Err(TransportError::Stuck { link, waited: timeout });
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError> {
        let set = self.port.set_read_timeout(whole_milliseconds(timeout));
        set.map_err(|e| self.error(e))?;
        let mut buffer = [0; READ];
        match self.port.read(&mut buffer) {
            // Readable without bytes: the line was hung up.
            Ok(0) => Err(TransportError::Gone { link: self.name.clone() }),
            Ok(read) => {
                into.extend_from_slice(&buffer[..read]);
                Ok(read)
            }
            Err(e) => match e.kind() {
                ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => Ok(0),
                _ => Err(self.error(e)),
            },
        }
    }
}

/// Serial ports that may have a sensor: those of USB bridges. Others are left alone.
pub fn ports() -> Vec<PathBuf> {
    let mut ports = SerialPort::available_ports().unwrap_or_default();
    ports.retain(|port| {
        let name = port.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("ttyUSB") || name.starts_with("ttyACM")
    });
    ports.sort();
    ports
}

/// Asks whoever is at a port who it is, without opening a session: less than a second, whatever is
/// there.
///
/// # Errors
/// The port's, and [`TransportError::NotASensor`] when something else answers.
pub fn probe(port: &Path) -> Result<DeviceInfo, Error> {
    let transport = Box::new(SerialTransport::open(port)?);
    let mut link = Link::new(transport, Arc::new(MonotonicClock::new()));
    link.identify(&GetInfo)
}

/// The port of the only sensor at a serial port, by probing all bridges' ports.
///
/// # Errors
/// None or several answer.
pub fn discover() -> Result<PathBuf, TransportError> {
    let mut found: Vec<PathBuf> = ports().into_iter().filter(|p| probe(p).is_ok()).collect();
    let link = "serial:".to_owned();
    match found.len() {
        0 => Err(TransportError::NotFound { link }),
        1 => Ok(found.remove(0)),
        _ => {
            let found = found.iter().map(|p| format!("serial:{}", p.display())).collect();
            Err(TransportError::Ambiguous { link, found })
        }
    }
}

/// Kernel name of the USB device that a serial port belongs to, such as `1-2.1`.
pub fn usb_path(port: &Path) -> Option<String> {
    let real = std::fs::canonicalize(port).ok()?;
    let name = real.file_name()?;
    let device =
        std::fs::canonicalize(Path::new("/sys/class/tty").join(name).join("device")).ok()?;
    device
        .ancestors()
        .find(|folder| folder.join("idVendor").exists())
        .and_then(|folder| Some(folder.file_name()?.to_string_lossy().into_owned()))
}
