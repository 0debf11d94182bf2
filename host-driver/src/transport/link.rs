//! The protocol over a transport: requests answered by sequence number, events set aside, heartbeats.
//!
//! A request that gets no reply is sent again, with a new sequence number, when doing it twice is the
//! same as doing it once; a reply to the first copy still counts. Starting is not repeated.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use stspp_protocol::event::BootEvent;
use stspp_protocol::message::{Call, ERROR_ID, Event, FromDevice, REPLY_BIT, encode_request};
use stspp_protocol::reply::{Alive, RequestError};
use stspp_protocol::request::{
    Heartbeat, Hello, RebootToBootloader, Reset, StartBurst, StartStream,
};
use stspp_protocol::version::{DeviceInfo, PROTOCOL_VERSION};
use stspp_protocol::wire::{DecodeError, Frame, FrameDecoder, MAX_FRAME_LEN};

use super::{Transport, TransportError};
use crate::clock::{Clock, duration_ns};
use crate::error::{Error, Missing, Timeout};

/// How long a reply may take; the device answers within milliseconds.
const REPLY_TIMEOUT: Duration = Duration::from_millis(250);

/// How often a request is sent before it counts as unanswered.
const ATTEMPTS: u32 = 3;

/// Events that are kept for a host that does not fetch them.
const EVENTS_MAX: usize = 4096;

/// An event and when it reached the host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TimedEvent {
    /// The event.
    pub event: Event,
    /// Nanoseconds of the host's clock.
    pub arrival_host_ns: u64,
}

/// What went wrong on the link so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct LinkStats {
    /// Requests sent, repetitions included.
    pub requests: u64,
    /// Requests sent again because no reply came.
    pub repeated: u64,
    /// Frames dropped for CRC, encoding or length.
    pub frames_rejected: u64,
    /// Frames whose content could not be read.
    pub frames_unreadable: u64,
    /// Messages of a newer device, skipped.
    pub unknown_messages: u64,
    /// Replies that nobody waits for any more.
    pub stale_replies: u64,
    /// Events lost, seen by gaps in their count.
    pub events_lost: u64,
    /// Bytes that came.
    pub bytes_received: u64,
    /// Replies and events that came.
    pub messages: u64,
}

/// The device's clock against the host's, by the round trip of a heartbeat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceClock {
    /// Device time in microseconds.
    pub device_us: u64,
    /// Host time at the middle of the round trip, in nanoseconds.
    pub host_ns: u64,
    /// Half of the round trip: the estimate is off by no more.
    pub uncertainty_ns: u64,
}

/// A session with the device over a transport.
pub struct Link {
    transport: Box<dyn Transport>,
    clock: Arc<dyn Clock>,
    decoder: FrameDecoder,
    bytes: Vec<u8>,
    next_seq: u16,
    next_event_seq: Option<u16>,
    events: VecDeque<TimedEvent>,
    stats: LinkStats,
    heartbeat: Option<HeartbeatPlan>,
    last_sent_ns: u64,
    last_heard_ns: Option<u64>,
    device_clock: Option<DeviceClock>,
}

struct HeartbeatPlan {
    interval_ns: u64,
    in_flight: Option<(u16, u64)>,
}

/// A transport that was closed.
struct Closed(String);

impl Transport for Closed {
    fn write(&mut self, _bytes: &[u8], _timeout: Duration) -> Result<(), TransportError> {
        Err(TransportError::Gone { link: self.0.clone() })
    }

    fn read(&mut self, _into: &mut Vec<u8>, _timeout: Duration) -> Result<usize, TransportError> {
        Err(TransportError::Gone { link: self.0.clone() })
    }
}

/// A reply frame's body, kept while its caller looks at it.
struct RawReply {
    id: u8,
    body: Vec<u8>,
}

impl Link {
    /// A link without a session yet.
    pub fn new(transport: Box<dyn Transport>, clock: Arc<dyn Clock>) -> Self {
        Self {
            transport,
            clock,
            decoder: FrameDecoder::new(),
            bytes: Vec::new(),
            next_seq: 1,
            next_event_seq: None,
            events: VecDeque::new(),
            stats: LinkStats::default(),
            heartbeat: None,
            last_sent_ns: 0,
            last_heard_ns: None,
            device_clock: None,
        }
    }

    /// Gives the transport back.
    pub fn into_transport(self) -> Box<dyn Transport> {
        self.transport
    }

    /// Lets go of the transport: the link is gone from now on.
    pub fn close(&mut self, name: &str) {
        self.replace(Box::new(Closed(name.to_owned())));
    }

    /// Goes on over another transport, without a session. Counters go on.
    pub fn replace(&mut self, transport: Box<dyn Transport>) {
        self.transport = transport;
        self.stats.frames_rejected += u64::from(self.decoder.rejected());
        self.decoder = FrameDecoder::new();
        self.bytes.clear();
        self.events.clear();
        self.next_event_seq = None;
        self.heartbeat = None;
        self.device_clock = None;
    }

    /// Opens a session: versions are checked, the device stops and disarms, heartbeats begin.
    ///
    /// # Errors
    /// [`Error::Refused`] when the versions do not fit, [`Error::Timeout`] when nobody answers.
    pub fn hello(&mut self) -> Result<DeviceInfo, Error> {
        let info = self.identify(&Hello { host: PROTOCOL_VERSION })?;
        if !info.protocol.is_compatible_with(PROTOCOL_VERSION) {
            return Err(Error::Refused {
                request: "Hello",
                source: RequestError::VersionMismatch { device: info.protocol },
            });
        }
        self.events.clear();
        self.next_event_seq = None;
        self.set_heartbeat(Some(Duration::from_micros(
            u64::from(info.limits.heartbeat_timeout_us) / 4,
        )));
        Ok(info)
    }

    /// Asks who is there, where it may be something else altogether.
    ///
    /// # Errors
    /// [`TransportError::NotASensor`] when bytes come but no message, otherwise as [`Link::call`].
    pub fn identify<C: Call<Reply = DeviceInfo>>(
        &mut self,
        request: &C,
    ) -> Result<DeviceInfo, Error> {
        let answer = self.call(request);
        match self.stats {
            LinkStats { messages: 0, bytes_received: bytes @ 1.., .. }
                if matches!(answer, Err(Error::Timeout(_))) =>
            {
                Err(TransportError::NotASensor { bytes }.into())
            }
            _ => answer,
        }
    }

    /// Sends a heartbeat whenever nothing else was sent for `interval`; none when `None`.
    pub fn set_heartbeat(&mut self, interval: Option<Duration>) {
        self.heartbeat = interval
            .map(|interval| HeartbeatPlan { interval_ns: duration_ns(interval), in_flight: None });
    }

    /// Sends a request and waits for its reply. Events that come in between are kept.
    ///
    /// # Errors
    /// [`Error::Refused`], [`Error::Timeout`], [`Error::Transport`].
    pub fn call<C: Call>(&mut self, request: &C) -> Result<C::Reply, Error> {
        let name = request_name::<C>();
        let attempts = if is_repeatable::<C>() { ATTEMPTS } else { 1 };
        let mut seqs = Vec::new();
        for attempt in 0..attempts {
            self.stats.repeated += u64::from(attempt > 0);
            seqs.push(self.send(request)?);
            let deadline_ns = self.clock.now_ns() + duration_ns(REPLY_TIMEOUT);
            while let Some(reply) = self.wait_reply(&seqs, deadline_ns)? {
                if reply.id == ERROR_ID {
                    match postcard_body::<RequestError>(&reply) {
                        Some(source) => return Err(Error::Refused { request: name, source }),
                        None => self.stats.frames_unreadable += 1,
                    }
                } else if reply.id == C::ID | REPLY_BIT {
                    match postcard_body::<C::Reply>(&reply) {
                        Some(reply) => return Ok(reply),
                        None => self.stats.frames_unreadable += 1,
                    }
                } else {
                    self.stats.stale_replies += 1;
                }
            }
        }
        let waited = REPLY_TIMEOUT * attempts;
        Err(Timeout { waited, missing: Missing::Reply { request: name } }.into())
    }

    /// Takes in what has arrived, waiting up to `timeout` for something, and sends a heartbeat when
    /// one is due.
    ///
    /// # Errors
    /// [`Error::Transport`] when the link is gone.
    pub fn pump(&mut self, timeout: Duration) -> Result<(), Error> {
        self.beat()?;
        let stale = self.receive(timeout, &[])?.is_some();
        self.stats.stale_replies += u64::from(stale);
        self.beat()
    }

    /// Takes the oldest event that has not been taken.
    pub fn next_event(&mut self) -> Option<TimedEvent> {
        self.events.pop_front()
    }

    /// What went wrong so far.
    pub fn stats(&self) -> LinkStats {
        let rejected = self.stats.frames_rejected + u64::from(self.decoder.rejected());
        LinkStats { frames_rejected: rejected, ..self.stats }
    }

    /// When the device was last heard, in nanoseconds of the host's clock.
    pub fn last_heard_ns(&self) -> Option<u64> {
        self.last_heard_ns
    }

    /// The device's clock as of the last heartbeat.
    pub fn device_clock(&self) -> Option<DeviceClock> {
        self.device_clock
    }

    fn send<C: Call>(&mut self, request: &C) -> Result<u16, Error> {
        let seq = self.next_seq;
        self.next_seq = self.next_seq.wrapping_add(1);
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = encode_request(seq, request, &mut out)
            .expect("every request of the protocol fits into a frame");
        self.transport.write(bytes, REPLY_TIMEOUT)?;
        self.stats.requests += 1;
        self.last_sent_ns = self.clock.now_ns();
        Ok(seq)
    }

    fn beat(&mut self) -> Result<(), Error> {
        let Some(plan) = &self.heartbeat else { return Ok(()) };
        if self.clock.now_ns().saturating_sub(self.last_sent_ns) < plan.interval_ns {
            return Ok(());
        }
        let seq = self.send(&Heartbeat)?;
        let sent_ns = self.last_sent_ns;
        if let Some(plan) = &mut self.heartbeat {
            plan.in_flight = Some((seq, sent_ns));
        }
        Ok(())
    }

    fn wait_reply(&mut self, seqs: &[u16], deadline_ns: u64) -> Result<Option<RawReply>, Error> {
        loop {
            let left_ns = deadline_ns.saturating_sub(self.clock.now_ns());
            if let Some(reply) = self.receive(Duration::from_nanos(left_ns), seqs)? {
                return Ok(Some(reply));
            }
            if self.clock.now_ns() >= deadline_ns {
                return Ok(None);
            }
        }
    }

    /// Handles arrived bytes up to a reply to one of `seqs`; reads at most once when there are none.
    fn receive(&mut self, timeout: Duration, seqs: &[u16]) -> Result<Option<RawReply>, Error> {
        let mut bytes = std::mem::take(&mut self.bytes);
        if bytes.is_empty() {
            match self.transport.read(&mut bytes, timeout) {
                Ok(read) => self.stats.bytes_received += read as u64,
                Err(error) => {
                    self.bytes = bytes;
                    return Err(error.into());
                }
            }
        }
        let now_ns = self.clock.now_ns();
        let mut decoder = std::mem::take(&mut self.decoder);
        let mut rest = bytes.as_slice();
        let mut found = None;
        while let Some(frame) = decoder.next_frame(&mut rest) {
            // Frames with a bad CRC are counted by the decoder.
            let Ok(frame) = frame else { continue };
            self.last_heard_ns = Some(now_ns);
            found = self.handle(&frame, now_ns, seqs);
            if found.is_some() {
                break;
            }
        }
        self.decoder = decoder;
        let used = bytes.len() - rest.len();
        bytes.drain(..used);
        self.bytes = bytes;
        Ok(found)
    }

    fn handle(&mut self, frame: &Frame<'_>, now_ns: u64, seqs: &[u16]) -> Option<RawReply> {
        if frame.id & REPLY_BIT != 0 {
            self.stats.messages += 1;
            if seqs.contains(&frame.seq) {
                return Some(RawReply { id: frame.id, body: frame.body.to_vec() });
            }
            self.handle_heartbeat_reply(frame, now_ns);
            return None;
        }
        match FromDevice::decode(frame) {
            Ok(FromDevice::Event { seq, event }) => {
                self.stats.messages += 1;
                if let Some(expected) = self.next_event_seq {
                    // A restarted device counts from the beginning.
                    if !matches!(event, Event::BootEvent(BootEvent { .. })) {
                        self.stats.events_lost += u64::from(seq.wrapping_sub(expected));
                    }
                }
                self.next_event_seq = Some(seq.wrapping_add(1));
                if self.events.len() == EVENTS_MAX {
                    self.events.pop_front();
                    self.stats.events_lost += 1;
                }
                self.events.push_back(TimedEvent { event, arrival_host_ns: now_ns });
            }
            Ok(FromDevice::Reply { .. }) => self.stats.stale_replies += 1,
            Err(DecodeError::UnknownId { .. }) => self.stats.unknown_messages += 1,
            Err(DecodeError::Body { .. }) => self.stats.frames_unreadable += 1,
        }
        None
    }

    fn handle_heartbeat_reply(&mut self, frame: &Frame<'_>, now_ns: u64) {
        let in_flight = self
            .heartbeat
            .as_mut()
            .and_then(|plan| plan.in_flight.take_if(|(seq, _)| *seq == frame.seq));
        let alive = frame.body_as::<Alive>().ok().filter(|_| frame.id == Heartbeat::ID | REPLY_BIT);
        match (in_flight, alive) {
            (Some((_, sent_ns)), Some(alive)) => {
                let half_ns = now_ns.saturating_sub(sent_ns) / 2;
                self.device_clock = Some(DeviceClock {
                    device_us: alive.device_time_us,
                    host_ns: sent_ns + half_ns,
                    uncertainty_ns: half_ns,
                });
            }
            _ => self.stats.stale_replies += 1,
        }
    }
}

fn postcard_body<T: serde::de::DeserializeOwned>(reply: &RawReply) -> Option<T> {
    Frame { id: reply.id, seq: 0, body: &reply.body }.body_as().ok()
}

fn is_repeatable<C: Call>() -> bool {
    ![StartStream::ID, StartBurst::ID, Reset::ID, RebootToBootloader::ID].contains(&C::ID)
}

fn request_name<C: Call>() -> &'static str {
    stspp_protocol::message::MESSAGE_TABLE
        .iter()
        .find(|row| row.id == C::ID)
        .map_or("request", |row| row.name)
}
