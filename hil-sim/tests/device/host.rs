//! A small host: requests as bytes, replies matched by sequence number, events and edges collected.

use stspp_hil_sim::device::in_process::{InProcess, InProcessOptions, LINK_LATENCY_NS};
use stspp_hil_sim::device::{Controller, Line, PinEdge};
use stspp_protocol::event::{FaultEvent, TriggerEvent};
use stspp_protocol::message::{
    Call, Event, FromDevice, Reply, Request, decode_reply, encode_request,
};
use stspp_protocol::reply::{RequestError, Started};
use stspp_protocol::request::{Arm, Heartbeat, Hello, SetTiming, StartBurst};
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::version::{BoardKind, DeviceInfo, PROTOCOL_VERSION};
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};

pub const MS: u64 = 1_000_000;
pub const S: u64 = 1_000 * MS;

pub struct Host {
    pub device: InProcess,
    pub events: Vec<Event>,
    pub event_seqs: Vec<u16>,
    pub edges: Vec<PinEdge>,
    pub bad_frames: u32,
    decoder: FrameDecoder,
    seq: u16,
}

impl Host {
    pub fn new(options: InProcessOptions) -> Self {
        Self {
            device: InProcess::new(options),
            events: Vec::new(),
            event_seqs: Vec::new(),
            edges: Vec::new(),
            bad_frames: 0,
            decoder: FrameDecoder::new(),
            seq: 0,
        }
    }

    pub fn on(board: BoardKind) -> Self {
        Self::new(InProcessOptions { board, ..InProcessOptions::default() })
    }

    /// A host in a session.
    pub fn connected() -> Self {
        let mut host = Self::new(InProcessOptions::default());
        host.hello().unwrap();
        host
    }

    /// A host in a session with the device armed.
    pub fn armed() -> Self {
        let mut host = Self::connected();
        host.call(&Arm).unwrap();
        host
    }

    pub fn now(&self) -> u64 {
        self.device.now_ns()
    }

    pub fn hello(&mut self) -> Result<DeviceInfo, RequestError> {
        self.call(&Hello { host: PROTOCOL_VERSION })
    }

    pub fn set_timing(&mut self, timing: &ProjectionTiming) -> u16 {
        let accepted = self.call(&SetTiming { timing: timing.clone() }).unwrap();
        accepted.timing_generation
    }

    pub fn burst(&mut self, frames: u16) -> Started {
        self.call(&StartBurst { frames }).unwrap()
    }

    /// Lets time pass and takes in what comes.
    pub fn run(&mut self, duration_ns: u64) {
        let until = self.now() + duration_ns;
        self.device.run_until(until, &mut self.edges);
        assert_eq!(self.now(), until);
        let replies = self.take_in(|_| None::<()>);
        assert!(replies.is_none());
    }

    /// Lets time pass with a heartbeat every 200 ms.
    pub fn run_alive(&mut self, duration_ns: u64) {
        let until = self.now() + duration_ns;
        while self.now() < until {
            self.call(&Heartbeat).unwrap();
            self.run(until.saturating_sub(self.now()).min(200 * MS));
        }
    }

    pub fn send_raw(&mut self, bytes: &[u8]) {
        self.device.host_write(bytes);
    }

    /// Sends a request and waits for its reply, which must come in time.
    pub fn call<C: Call>(&mut self, request: &C) -> Result<C::Reply, RequestError> {
        self.try_call(request).expect("a reply within the link's latency")
    }

    /// Sends a request; `None` where no reply comes.
    pub fn try_call<C: Call>(&mut self, request: &C) -> Option<Result<C::Reply, RequestError>> {
        let seq = self.next_seq();
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = encode_request(seq, request, &mut out).unwrap().to_vec();
        self.send_raw(&bytes);
        self.wait(|frame_seq, frame| {
            (frame_seq == seq).then(|| decode_reply::<C>(frame).expect("the reply's own type"))
        })
    }

    /// Sends any request and waits for its reply.
    pub fn ask(&mut self, request: &Request) -> Option<Result<Reply, RequestError>> {
        let seq = self.next_seq();
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = request.encode(seq, &mut out).unwrap().to_vec();
        self.send_raw(&bytes);
        self.wait(|frame_seq, frame| match FromDevice::decode(frame) {
            Ok(FromDevice::Reply { reply, .. }) if frame_seq == seq => Some(reply),
            _ => None,
        })
    }

    fn next_seq(&mut self) -> u16 {
        self.seq = self.seq.wrapping_add(1);
        self.seq
    }

    fn wait<T>(
        &mut self,
        mut is_it: impl FnMut(u16, &stspp_protocol::wire::Frame<'_>) -> Option<T>,
    ) -> Option<T> {
        let until = self.now() + 2 * LINK_LATENCY_NS;
        self.device.run_until(until, &mut self.edges);
        self.take_in(|frame| is_it(frame.seq, frame))
    }

    fn take_in<T>(
        &mut self,
        mut look: impl FnMut(&stspp_protocol::wire::Frame<'_>) -> Option<T>,
    ) -> Option<T> {
        let mut bytes = Vec::new();
        self.device.host_read(&mut bytes);
        let mut rest = bytes.as_slice();
        let mut found = None;
        while let Some(result) = self.decoder.next_frame(&mut rest) {
            let Ok(frame) = result else {
                self.bad_frames += 1;
                continue;
            };
            if let Ok(FromDevice::Event { seq, event }) = FromDevice::decode(&frame) {
                self.events.push(event);
                self.event_seqs.push(seq);
            } else if let Some(it) = look(&frame) {
                assert!(found.replace(it).is_none(), "two replies");
            }
        }
        found
    }

    pub fn triggers(&self) -> Vec<TriggerEvent> {
        self.events
            .iter()
            .filter_map(|event| match event {
                Event::TriggerEvent(trigger) => Some(*trigger),
                _ => None,
            })
            .collect()
    }

    pub fn faults(&self) -> Vec<FaultEvent> {
        self.events
            .iter()
            .filter_map(|event| match event {
                Event::FaultEvent(fault) => Some(*fault),
                _ => None,
            })
            .collect()
    }

    /// What is high now.
    pub fn high(&self) -> Vec<Line> {
        let mut high = Vec::new();
        for edge in &self.edges {
            high.retain(|line| *line != edge.line);
            if edge.high {
                high.push(edge.line);
            }
        }
        high
    }

    /// When the last output fell.
    pub fn last_fall_ns(&self) -> u64 {
        self.edges.iter().rev().find(|edge| !edge.high).map_or(0, |edge| edge.time_ns)
    }
}
