//! The socket: lists the devices and hands each to at most one host at a time.

use super::{session, wire};
use crate::front::usb::UsbFunction;
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A device on offer.
#[derive(Clone)]
pub struct Export {
    function: Arc<Mutex<dyn UsbFunction>>,
    in_use: Arc<AtomicBool>,
}

impl Export {
    /// Offers a device.
    pub fn new(function: Arc<Mutex<dyn UsbFunction>>) -> Self {
        Self { function, in_use: Arc::default() }
    }
}

/// Devices on offer, numbered from 1 in their order: bus ids `1-1`, `1-2`, ...
#[derive(Clone, Default)]
pub struct Server {
    exports: Vec<Export>,
    stop: Arc<AtomicBool>,
}

impl Server {
    /// Offers these devices.
    pub fn new(exports: Vec<Export>) -> Self {
        Self { exports, stop: Arc::default() }
    }

    /// Ends [`Server::listen`] and all sessions soon after it is set.
    pub fn stop_flag(&self) -> Arc<AtomicBool> {
        self.stop.clone()
    }

    /// Accepts hosts until stopped, each on a thread of its own; `report` is told what happens.
    ///
    /// # Errors
    /// The listener's.
    pub fn listen(
        &self,
        listener: &TcpListener,
        report: impl Fn(String) + Clone + Send + 'static,
    ) -> io::Result<()> {
        listener.set_nonblocking(true)?;
        while !self.stop.load(Ordering::Relaxed) {
            match listener.accept() {
                Ok((stream, peer)) => {
                    stream.set_nonblocking(false)?;
                    stream.set_nodelay(true)?;
                    let (server, report) = (self.clone(), report.clone());
                    std::thread::Builder::new().name("usbip".into()).spawn(move || match server
                        .converse(&stream)
                    {
                        Ok(said) => report(format!("{peer}: {said}")),
                        Err(e) => report(format!("{peer}: {e}")),
                    })?;
                }
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => {
                    std::thread::sleep(Duration::from_millis(20));
                }
                Err(e) => return Err(e),
            }
        }
        Ok(())
    }

    /// One connection: a listing, or an import and all that follows.
    fn converse(&self, stream: &TcpStream) -> io::Result<String> {
        let reader = stream.try_clone()?;
        let said = self.serve(reader, stream);
        // The thread that reads holds the socket too: only this closes it.
        let _ = stream.shutdown(Shutdown::Both);
        said
    }

    /// Serves one byte stream in both directions: an operation, then, if it was an import, the
    /// device until the stream ends. Says what it was about.
    ///
    /// # Errors
    /// The stream's, and `InvalidData` for what is not USB/IP.
    pub fn serve(
        &self,
        mut reader: impl Read + Send + 'static,
        mut writer: impl Write,
    ) -> io::Result<String> {
        let mut head = [0; 8];
        reader.read_exact(&mut head)?;
        match u16::from_be_bytes([head[2], head[3]]) {
            wire::OP_REQ_DEVLIST => {
                let mut reply = wire::operation_header(wire::OP_REP_DEVLIST, true);
                reply.extend((self.exports.len() as u32).to_be_bytes());
                for (number, export) in (1..).zip(&self.exports) {
                    let identity = lock(export)?.identity();
                    reply.extend(wire::device_record(number, &identity));
                    reply.extend(wire::interface_records(&identity));
                }
                writer.write_all(&reply)?;
                writer.flush()?;
                Ok("listed".into())
            }
            wire::OP_REQ_IMPORT => {
                let mut bus_id = [0; 32];
                reader.read_exact(&mut bus_id)?;
                let wanted = String::from_utf8_lossy(&bus_id);
                let wanted = wanted.trim_end_matches('\0');
                let found = (1..).zip(&self.exports).find(|(n, _)| wire::bus_id(*n) == wanted);
                let free = found.filter(|(_, e)| !e.in_use.swap(true, Ordering::AcqRel));
                let Some((number, export)) = free else {
                    writer.write_all(&wire::operation_header(wire::OP_REP_IMPORT, false))?;
                    return Ok(format!("{wanted} is not there or in use"));
                };
                let result = self.lend(number, export, reader, writer);
                export.in_use.store(false, Ordering::Release);
                result.map(|()| format!("{wanted} given back"))
            }
            _ => Err(wire::invalid("an unknown operation")),
        }
    }

    fn lend(
        &self,
        number: u32,
        export: &Export,
        reader: impl Read + Send + 'static,
        mut writer: impl Write,
    ) -> io::Result<()> {
        let (attached, identity) = {
            let mut function = lock(export)?;
            function.reset();
            (function.is_attached(), function.identity())
        };
        if !attached {
            writer.write_all(&wire::operation_header(wire::OP_REP_IMPORT, false))?;
            return Err(io::Error::other(format!("{} is unplugged", wire::bus_id(number))));
        }
        let mut reply = wire::operation_header(wire::OP_REP_IMPORT, true);
        reply.extend(wire::device_record(number, &identity));
        writer.write_all(&reply)?;
        writer.flush()?;
        let result = session::run(reader, writer, &export.function, &self.stop);
        lock(export)?.detach();
        result
    }
}

fn lock(export: &Export) -> io::Result<std::sync::MutexGuard<'_, dyn UsbFunction + 'static>> {
    export.function.lock().map_err(|_| io::Error::other("the simulated device has died"))
}
