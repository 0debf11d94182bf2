//! The control link over USB: the vendor interface of `stspp_protocol::usb`, through libusb.
//!
//! - [`pipes`]: what the link needs of a USB device, so that a simulated one can stand in for it;
//! - [`reader`]: one IN endpoint as a stream of whole frames: stalls cleared, glitches repeated;
//! - [`device`]: sensors on this machine's buses, and opening one (all calls of libusb);
//! - [`hotplug`]: sensors that come and go.
//!
//! Replies come over a bulk endpoint, events over an interrupt endpoint. A thread waits on each, so
//! that neither delays the other; both hand whole frames to one queue.

pub mod device;
pub mod hotplug;
pub mod pipes;
pub mod reader;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use stspp_protocol::usb::{ENDPOINT_EVENTS, ENDPOINT_REPLIES, ENDPOINT_REQUESTS};

use super::{Transport, TransportError};
use pipes::{PipeError, Pipes};
use reader::{HALTS_MAX, Reader};

/// How long a reader waits before it looks whether it should end.
const READ_SLICE: Duration = Duration::from_millis(100);

/// Transfers that wait for the link; the device sends at most a thousand a second.
const QUEUE: usize = 4096;

type Received = Result<Vec<u8>, TransportError>;

/// The control link of an open USB device.
pub struct UsbTransport {
    name: String,
    pipes: Arc<dyn Pipes>,
    received: Receiver<Received>,
    stop: Arc<AtomicBool>,
    halts: Arc<AtomicU64>,
    readers: Vec<JoinHandle<()>>,
}

impl UsbTransport {
    /// Starts reading from `pipes`; `name` is for messages.
    ///
    /// # Errors
    /// When the reading threads cannot be started.
    pub fn new(name: &str, pipes: Arc<dyn Pipes>) -> Result<Self, TransportError> {
        let (sender, received) = bounded(QUEUE);
        let mut transport = Self {
            name: name.to_owned(),
            pipes,
            received,
            stop: Arc::default(),
            halts: Arc::default(),
            readers: Vec::new(),
        };
        for (endpoint, thread) in
            [(ENDPOINT_REPLIES, "stspp-usb-replies"), (ENDPOINT_EVENTS, "stspp-usb-events")]
        {
            let halts = Arc::clone(&transport.halts);
            let reader = Reader::new(name, endpoint, Arc::clone(&transport.pipes), halts);
            let (stop, sender) = (Arc::clone(&transport.stop), sender.clone());
            let handle = std::thread::Builder::new()
                .name(thread.into())
                .spawn(move || read(reader, &stop, &sender))
                .map_err(|source| TransportError::Io { link: name.to_owned(), source })?;
            transport.readers.push(handle);
        }
        Ok(transport)
    }

    /// How often an endpoint was found halted and cleared.
    pub fn halts(&self) -> u64 {
        self.halts.load(Ordering::Relaxed)
    }
}

/// Reads until told to stop, nobody listens, or the device fails for good.
fn read(mut reader: Reader, stop: &AtomicBool, out: &Sender<Received>) {
    while !stop.load(Ordering::Acquire) {
        let received = reader.once(READ_SLICE);
        let last = received.is_err();
        let nothing = received.as_ref().is_ok_and(Vec::is_empty);
        if !nothing && out.send(received).is_err() || last {
            return;
        }
    }
}

impl Transport for UsbTransport {
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> Result<(), TransportError> {
        write(self.pipes.as_ref(), &self.name, bytes, timeout, &self.halts)
    }

    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError> {
        let before = into.len();
        let mut next = if timeout.is_zero() {
            self.received.try_recv().map_err(|_| RecvTimeoutError::Timeout)
        } else {
            self.received.recv_timeout(timeout)
        };
        loop {
            match next {
                Ok(Ok(bytes)) => into.extend(bytes),
                // What came before the failure is worth having.
                Ok(Err(_)) if into.len() > before => break,
                Ok(Err(error)) => return Err(error),
                Err(RecvTimeoutError::Timeout) => break,
                // Both readers have failed and were heard: the device is gone.
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(TransportError::Gone { link: self.name.clone() });
                }
            }
            next = self.received.try_recv().map_err(|_| RecvTimeoutError::Timeout);
        }
        Ok(into.len() - before)
    }
}

impl Drop for UsbTransport {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        // Full queues must not hold the readers.
        while self.received.try_recv().is_ok() {}
        for reader in self.readers.drain(..) {
            let _ = reader.join();
        }
    }
}

/// Writes all of `bytes` to the requests' endpoint. A halt is cleared, and the bytes sent again: the
/// device takes nothing of a refused transfer.
fn write(
    pipes: &dyn Pipes,
    name: &str,
    mut bytes: &[u8],
    timeout: Duration,
    halts: &AtomicU64,
) -> Result<(), TransportError> {
    let link = || name.to_owned();
    let mut attempts = 0;
    while !bytes.is_empty() {
        match pipes.write(ENDPOINT_REQUESTS, bytes, timeout) {
            Ok(0) | Err(PipeError::Timeout) => {
                return Err(TransportError::Stuck { link: link(), waited: timeout });
            }
            Ok(written) => bytes = &bytes[written.min(bytes.len())..],
            Err(PipeError::Halted) if attempts < HALTS_MAX => {
                attempts += 1;
                halts.fetch_add(1, Ordering::Relaxed);
                let _ = pipes.clear_halt(ENDPOINT_REQUESTS);
            }
            Err(PipeError::Halted) => {
                let endpoint = ENDPOINT_REQUESTS;
                return Err(TransportError::Halted { link: link(), endpoint, attempts });
            }
            Err(PipeError::Gone) => return Err(TransportError::Gone { link: link() }),
            Err(PipeError::Io(_)) if attempts < HALTS_MAX => attempts += 1,
            Err(PipeError::Io(source)) => return Err(TransportError::Io { link: link(), source }),
        }
    }
    Ok(())
}

/// The same link without threads, for a simulated device in simulated time: it is read when asked.
pub struct PolledUsb {
    name: String,
    pipes: Arc<dyn Pipes>,
    readers: [Reader; 2],
    halts: Arc<AtomicU64>,
}

impl PolledUsb {
    /// A link over `pipes`, whose reads let simulated time pass; `name` is for messages.
    pub fn new(name: &str, pipes: Arc<dyn Pipes>) -> Self {
        let halts = Arc::<AtomicU64>::default();
        let readers = [ENDPOINT_EVENTS, ENDPOINT_REPLIES]
            .map(|endpoint| Reader::new(name, endpoint, Arc::clone(&pipes), Arc::clone(&halts)));
        Self { name: name.to_owned(), pipes, readers, halts }
    }

    /// How often an endpoint was found halted and cleared.
    pub fn halts(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.halts)
    }
}

impl Transport for PolledUsb {
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> Result<(), TransportError> {
        write(self.pipes.as_ref(), &self.name, bytes, timeout, &self.halts)
    }

    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError> {
        const SLICE: Duration = Duration::from_millis(1);
        let before = into.len();
        let mut left = timeout;
        loop {
            for reader in &mut self.readers {
                into.extend(reader.once(Duration::ZERO)?);
            }
            if into.len() > before || left.is_zero() {
                return Ok(into.len() - before);
            }
            let slice = SLICE.min(left);
            left -= slice;
            into.extend(self.readers[0].once(slice)?);
        }
    }
}
