//! A host in miniature: calls requests of the protocol over a [`Controller`] and keeps what comes
//! back, in virtual time. Tests and measurements use it with the emulated chip and with the
//! in-process simulator alike.

use std::collections::VecDeque;

use stspp_hil_sim::device::{Controller, PinEdge};
use stspp_protocol::message::{Event, FromDevice, Reply, Request};
use stspp_protocol::reply::RequestError;
use stspp_protocol::request::Hello;
use stspp_protocol::version::{PROTOCOL_VERSION, ProtocolVersion};
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};

/// How a call can fail.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// No reply came in time.
    #[error("no reply within {0} ns")]
    Timeout(u64),
    /// The device refused.
    #[error("refused: {0}")]
    Refused(RequestError),
}

/// An event, and when the host had it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received {
    /// Virtual time.
    pub time_ns: u64,
    /// Sequence number of the event.
    pub seq: u16,
    /// The event.
    pub event: Event,
}

/// The host.
pub struct Session<C> {
    /// The device.
    pub controller: C,
    /// Edges so far.
    pub edges: Vec<PinEdge>,
    /// Events so far.
    pub events: VecDeque<Received>,
    /// Replies that nobody waited for.
    pub stray_replies: u64,
    /// Frames that could not be read.
    pub bad_frames: u64,
    /// Time of the latest call from request to reply.
    pub last_call_ns: u64,
    decoder: FrameDecoder,
    replies: VecDeque<(u16, Result<Reply, RequestError>, u64)>,
    next_seq: u16,
    step_ns: u64,
}

/// A reply must come within this time.
const TIMEOUT_NS: u64 = 300_000_000;

impl<C: Controller> Session<C> {
    /// A host for `controller`; nothing is said yet.
    pub fn new(controller: C) -> Self {
        Self {
            controller,
            edges: Vec::new(),
            events: VecDeque::new(),
            stray_replies: 0,
            bad_frames: 0,
            last_call_ns: 0,
            decoder: FrameDecoder::new(),
            replies: VecDeque::new(),
            next_seq: 1,
            step_ns: 50_000,
        }
    }

    /// Lets `ns` pass, and takes what comes.
    pub fn run_for(&mut self, ns: u64) {
        let end = self.controller.now_ns() + ns;
        while self.controller.now_ns() < end {
            let until = end.min(self.controller.now_ns() + 10 * self.step_ns);
            self.step_until(until);
        }
    }

    fn step_until(&mut self, until_ns: u64) {
        self.controller.run_until(until_ns, &mut self.edges);
        self.take_bytes();
    }

    fn take_bytes(&mut self) {
        let mut bytes = Vec::new();
        self.controller.host_read(&mut bytes);
        let time_ns = self.controller.now_ns();
        let mut rest = &bytes[..];
        while let Some(frame) = self.decoder.next_frame(&mut rest) {
            let Ok(frame) = frame else {
                self.bad_frames += 1;
                continue;
            };
            match FromDevice::decode(&frame) {
                Ok(FromDevice::Reply { seq, reply }) => {
                    self.replies.push_back((seq, reply, time_ns))
                }
                Ok(FromDevice::Event { seq, event }) => {
                    self.events.push_back(Received { time_ns, seq, event })
                }
                Err(_) => self.bad_frames += 1,
            }
        }
    }

    /// Sends a request without waiting for its reply; returns its sequence number.
    pub fn send(&mut self, request: &Request) -> u16 {
        let seq = self.next_seq;
        self.next_seq = self.next_seq.wrapping_add(1);
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = request.encode(seq, &mut out).expect("MAX_FRAME_LEN holds every message");
        self.controller.host_write(bytes);
        seq
    }

    /// Takes a reply that has come for `seq`.
    pub fn take_reply(&mut self, seq: u16) -> Option<Result<Reply, RequestError>> {
        let position = self.replies.iter().position(|(s, ..)| *s == seq)?;
        self.replies.remove(position).map(|(_, reply, _)| reply)
    }

    /// Takes all replies that have come: how many.
    pub fn drop_replies(&mut self) -> usize {
        let count = self.replies.len();
        self.replies.clear();
        count
    }

    /// Calls a request and waits for its reply.
    ///
    /// # Errors
    /// The device refuses, or does not answer.
    pub fn call(&mut self, request: Request) -> Result<Reply, CallError> {
        let start_ns = self.controller.now_ns();
        let seq = self.send(&request);
        while self.controller.now_ns() < start_ns + TIMEOUT_NS {
            self.step_until(self.controller.now_ns() + self.step_ns);
            if let Some(reply) = self.take_reply(seq) {
                self.last_call_ns = self.controller.now_ns() - start_ns;
                return reply.map_err(CallError::Refused);
            }
        }
        Err(CallError::Timeout(TIMEOUT_NS))
    }

    /// Starts a session.
    ///
    /// # Errors
    /// As [`Session::call`].
    pub fn hello(&mut self) -> Result<Reply, CallError> {
        self.hello_as(PROTOCOL_VERSION)
    }

    /// Starts a session as a host of another version.
    ///
    /// # Errors
    /// As [`Session::call`].
    pub fn hello_as(&mut self, host: ProtocolVersion) -> Result<Reply, CallError> {
        self.call(Request::Hello(Hello { host }))
    }

    /// Takes all events so far.
    pub fn take_events(&mut self) -> Vec<Received> {
        self.events.drain(..).collect()
    }

    /// Takes all edges so far.
    pub fn take_edges(&mut self) -> Vec<PinEdge> {
        std::mem::take(&mut self.edges)
    }
}
