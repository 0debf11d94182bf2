//! One imported device over one byte stream: transfers wait in order per endpoint until the device
//! answers, are given up when the host says so, and never block each other.

use super::wire::{self, Command, Submit};
use crate::front::usb::{Answer, BusError, Setup, UsbFunction};
use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex};
use std::time::Duration;

const EPIPE: i32 = -32;
const ECONNRESET: i32 = -104;
const EINVAL: i32 = -22;
const EPROTO: i32 = -71;
const EOVERFLOW: i32 = -75;
const ESHUTDOWN: i32 = -108;

/// How long the worker waits for a command before it lets the device run: a USB frame.
const TICK: Duration = Duration::from_millis(1);

/// Endpoint number, and whether data goes to the host (false for endpoint 0).
type Pipe = (u8, bool);

/// Transfers that the host has asked for and the device has not answered, and the bytes to send back.
#[derive(Default)]
pub struct Transfers {
    /// By endpoint number; control, OUT and IN of one number wait apart.
    waiting: Vec<(Pipe, VecDeque<Submit>)>,
    replies: Vec<u8>,
    /// Pipes whose foremost transfer was given up; the device has not been told.
    unlinked: Vec<Pipe>,
    /// Sequence number of the newest transfer.
    newest: u32,
    /// Transfers that were given up before they were asked for.
    given_up: Vec<u32>,
}

impl Transfers {
    /// Takes a command of the host.
    pub fn accept(&mut self, command: Command) {
        match command {
            Command::Submit(submit) if submit.isochronous => {
                // No simulated device has such an endpoint.
                self.replies.extend(wire::submit_reply(submit.sequence, EINVAL, 0, &[]));
            }
            Command::Submit(submit) if self.given_up.contains(&submit.sequence) => {
                self.given_up.retain(|sequence| *sequence != submit.sequence);
            }
            Command::Submit(submit) => {
                self.newest = submit.sequence;
                let key = (submit.endpoint, submit.endpoint != 0 && submit.is_in);
                match self.waiting.iter_mut().find(|(k, _)| *k == key) {
                    Some((_, queue)) => queue.push_back(submit),
                    None => self.waiting.push((key, VecDeque::from([submit]))),
                }
            }
            Command::Unlink { sequence, victim } => {
                let mut status = 0;
                for (pipe, queue) in &mut self.waiting {
                    let Some(at) = queue.iter().position(|s| s.sequence == victim) else {
                        continue;
                    };
                    queue.remove(at);
                    status = ECONNRESET;
                    if at == 0 {
                        self.unlinked.push(*pipe);
                    }
                }
                // Linux' vhci-hcd sends what it wants to give up before what it wants, where one comes
                // right after the other. An answer to such a transfer would end the connection.
                if status == 0 && victim.wrapping_sub(self.newest) as i32 > 0 {
                    self.given_up.push(victim);
                    status = ECONNRESET;
                }
                self.replies.extend(wire::unlink_reply(sequence, status));
            }
        }
    }

    /// Offers every waiting transfer to the device, as far as each endpoint goes.
    pub fn serve(&mut self, function: &mut dyn UsbFunction) {
        for (endpoint, is_in) in self.unlinked.drain(..) {
            function.unlinked(endpoint, is_in);
        }
        for (_, queue) in &mut self.waiting {
            while let Some(submit) = queue.front() {
                let Some(reply) = offer(function, submit) else { break };
                self.replies.extend(reply);
                queue.pop_front();
            }
        }
    }

    /// Whether any transfer waits.
    pub fn is_waiting(&self) -> bool {
        self.waiting.iter().any(|(_, queue)| !queue.is_empty())
    }

    /// Takes the replies so far.
    pub fn take_replies(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.replies)
    }
}

/// Offers one transfer; `None` while the device has no answer.
fn offer(function: &mut dyn UsbFunction, submit: &Submit) -> Option<Vec<u8>> {
    let sequence = submit.sequence;
    let refused = |status| Some(wire::submit_reply(sequence, status, 0, &[]));
    if submit.endpoint == 0 {
        let setup = Setup::parse(submit.setup);
        return match function.control(setup, &submit.data) {
            Answer::Done(mut data) => {
                if setup.is_in() {
                    data.truncate(submit.length);
                    Some(wire::submit_reply(sequence, 0, data.len(), &data))
                } else {
                    Some(wire::submit_reply(sequence, 0, submit.data.len(), &[]))
                }
            }
            Answer::Nak => None,
            Answer::Stall => refused(EPIPE),
            Answer::Broken(error) => refused(errno(error)),
        };
    }
    if submit.is_in {
        match function.transfer_in(submit.endpoint, submit.length) {
            Answer::Done(mut data) => {
                data.truncate(submit.length);
                Some(wire::submit_reply(sequence, 0, data.len(), &data))
            }
            Answer::Nak => None,
            Answer::Stall => refused(EPIPE),
            Answer::Broken(error) => refused(errno(error)),
        }
    } else {
        match function.transfer_out(submit.endpoint, &submit.data) {
            Answer::Done(length) => Some(wire::submit_reply(sequence, 0, length, &[])),
            Answer::Nak => None,
            Answer::Stall => refused(EPIPE),
            Answer::Broken(error) => refused(errno(error)),
        }
    }
}

/// What a Linux host controller says of an error on the bus.
fn errno(error: BusError) -> i32 {
    match error {
        BusError::NoAnswer => EPROTO,
        BusError::Babble => EOVERFLOW,
        BusError::Gone => ESHUTDOWN,
    }
}

/// Serves an imported device until the stream ends, the device is gone or `stop` is set. Reading has a thread of its own,
/// which ends with the stream.
///
/// # Errors
/// The stream's, other than its orderly end.
pub fn run(
    mut reader: impl Read + Send + 'static,
    mut writer: impl Write,
    function: &Arc<Mutex<dyn UsbFunction>>,
    stop: &AtomicBool,
) -> io::Result<()> {
    let (sender, commands) = mpsc::sync_channel(64);
    std::thread::Builder::new().name("usbip-read".into()).spawn(move || {
        loop {
            let command = wire::read_command(&mut reader);
            let last = command.is_err();
            if sender.send(command).is_err() || last {
                break;
            }
        }
    })?;
    let mut transfers = Transfers::default();
    loop {
        let mut next = commands.recv_timeout(TICK);
        loop {
            match next {
                Ok(Ok(command)) => transfers.accept(command),
                Ok(Err(e)) if e.kind() == io::ErrorKind::UnexpectedEof => return Ok(()),
                Ok(Err(e)) => return Err(e),
                Err(RecvTimeoutError::Timeout) => break,
                Err(RecvTimeoutError::Disconnected) => return Ok(()),
            }
            next = commands.try_recv().map_err(|e| match e {
                mpsc::TryRecvError::Empty => RecvTimeoutError::Timeout,
                mpsc::TryRecvError::Disconnected => RecvTimeoutError::Disconnected,
            });
        }
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        let attached = {
            let mut function =
                function.lock().map_err(|_| io::Error::other("the simulated device has died"))?;
            function.poll();
            transfers.serve(&mut *function);
            function.is_attached()
        };
        let replies = transfers.take_replies();
        if !replies.is_empty() {
            writer.write_all(&replies)?;
            writer.flush()?;
        }
        if !attached {
            // The end of the connection is how a host learns that the device was unplugged.
            return Ok(());
        }
    }
}
