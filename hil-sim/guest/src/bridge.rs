//! From a virtio port to the kernel's virtual USB host controller (vhci-hcd).
//!
//! The kernel takes a connected socket and speaks USB/IP over it. A virtio port is no socket, so one
//! end of a socket pair goes to the kernel and two threads copy between the other end and the port.

use crate::{ports, sys};
use std::io::{self, Read, Write};
use std::net::Shutdown;
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;

const VHCI: &str = "/sys/devices/platform/vhci_hcd.0";

/// Imports device `bus_id` over the virtio port `name` and plugs it in.
/// Says which port of the controller it got.
///
/// # Errors
/// When the far side refuses the device or the controller has no free port.
pub fn attach(name: &str, bus_id: &str) -> io::Result<u32> {
    let mut port = ports::open(name)?;
    let mut request = vec![0x01, 0x11, 0x80, 0x03, 0, 0, 0, 0];
    request.extend(bus_id.as_bytes());
    request.resize(40, 0);
    port.write_all(&request)?;
    let mut head = [0; 8];
    port.read_exact(&mut head)?;
    if head[4..] != [0; 4] {
        return Err(io::Error::other(format!("device {bus_id} is refused")));
    }
    let mut record = [0; 312];
    port.read_exact(&mut record)?;
    let word = |at: usize| u32::from_be_bytes([0, 1, 2, 3].map(|i| record[at + i]));
    let (bus, device, speed) = (word(288), word(292), word(296));

    let (kernel_end, our_end) = sys::socket_pair()?;
    let rhport = free_port()?;
    let line = format!("{rhport} {} {} {speed}", kernel_end.as_raw_fd(), (bus << 16) | device);
    std::fs::write(format!("{VHCI}/attach"), line)
        .map_err(|e| io::Error::other(format!("vhci attach: {e}")))?;
    let ours = UnixStream::from(our_end);
    let (to_kernel, end) = (ours.try_clone()?, ours.try_clone()?);
    // Unplugged at the far end: the kernel learns it from its socket's end, and the port is free again.
    copy("to-kernel", port.try_clone()?, to_kernel, move || drop(end.shutdown(Shutdown::Both)))?;
    copy("from-kernel", ours, port, || {})?;
    Ok(rhport)
}

/// Unplugs what is at a port of the controller.
///
/// # Errors
/// When nothing is there.
pub fn detach(rhport: u32) -> io::Result<()> {
    std::fs::write(format!("{VHCI}/detach"), rhport.to_string())
}

/// First free high-speed port: the controller lets slower devices in there too.
fn free_port() -> io::Result<u32> {
    let status = std::fs::read_to_string(format!("{VHCI}/status"))?;
    status
        .lines()
        .find_map(|line| {
            let mut fields = line.split_whitespace();
            let (hub, port, state) = (fields.next()?, fields.next()?, fields.next()?);
            // State 4 is "not connected".
            (hub == "hs" && state == "004").then(|| port.parse().ok())?
        })
        .ok_or_else(|| io::Error::other("no free port at the virtual host controller"))
}

fn copy(
    name: &str,
    mut from: impl Read + Send + 'static,
    mut to: impl Write + Send + 'static,
    finally: impl FnOnce() + Send + 'static,
) -> io::Result<()> {
    std::thread::Builder::new().name(name.into()).spawn(move || {
        let mut buffer = vec![0; 256 * 1024];
        while let Ok(count @ 1..) = from.read(&mut buffer) {
            if to.write_all(&buffer[..count]).is_err() {
                break;
            }
        }
        finally();
    })?;
    Ok(())
}
