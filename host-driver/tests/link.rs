//! The protocol client against a scripted device: lost, late, wrong and damaged answers.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use stspp::Error;
use stspp::clock::{Clock, VirtualClock};
use stspp::error::{Missing, Timeout};
use stspp::transport::{Link, Transport, TransportError};
use stspp_protocol::event::TimingEvent;
use stspp_protocol::message::{Event, Request, encode_error, encode_reply};
use stspp_protocol::reply::{Alive, DeviceState, RequestError, Started};
use stspp_protocol::request::{GetTiming, Heartbeat, Hello, StartStream};
use stspp_protocol::version::{
    BoardKind, Capabilities, DeviceInfo, FirmwareVersion, PROTOCOL_VERSION, ProtocolVersion,
    ResetCause, SerialNumber,
};
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};

type Answer = Box<dyn FnMut(u16, Request) -> Vec<u8> + Send>;

/// A device that answers as told; reading without an answer lets simulated time pass.
struct Scripted {
    answer: Answer,
    decoder: FrameDecoder,
    clock: Arc<VirtualClock>,
    sent: VecDeque<u8>,
}

impl Transport for Scripted {
    fn write(&mut self, bytes: &[u8], _: Duration) -> Result<(), TransportError> {
        let mut rest = bytes;
        while let Some(frame) = self.decoder.next_frame(&mut rest) {
            let frame = frame.unwrap();
            self.sent.extend((self.answer)(frame.seq, Request::decode(&frame).unwrap()));
        }
        Ok(())
    }

    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError> {
        if self.sent.is_empty() {
            self.clock.advance_to_ns(self.clock.now_ns() + timeout.as_nanos() as u64);
        }
        let read = self.sent.len();
        into.extend(self.sent.drain(..));
        Ok(read)
    }
}

fn link(answer: impl FnMut(u16, Request) -> Vec<u8> + Send + 'static) -> (Link, Arc<VirtualClock>) {
    let clock = Arc::new(VirtualClock::new());
    let transport = Scripted {
        answer: Box::new(answer),
        decoder: FrameDecoder::new(),
        clock: Arc::clone(&clock),
        sent: VecDeque::new(),
    };
    (Link::new(Box::new(transport), Arc::clone(&clock) as Arc<dyn Clock>), clock)
}

fn frame(encode: impl FnOnce(&mut [u8]) -> usize) -> Vec<u8> {
    let mut out = [0; MAX_FRAME_LEN];
    let len = encode(&mut out);
    out[..len].to_vec()
}

fn alive(seq: u16, device_time_us: u64) -> Vec<u8> {
    let alive = Alive { device_time_us, state: DeviceState::Idle };
    frame(|out| encode_reply::<Heartbeat>(seq, &Ok(alive), out).unwrap().len())
}

fn event(seq: u16, generation: u16) -> Vec<u8> {
    let event = Event::from(TimingEvent { timing_generation: generation, first_frame_sequence: 0 });
    frame(|out| event.encode(seq, out).unwrap().len())
}

fn info(protocol: ProtocolVersion) -> DeviceInfo {
    DeviceInfo {
        protocol,
        firmware: FirmwareVersion { major: 0, minor: 1, patch: 0 },
        board: BoardKind::F350,
        serial: SerialNumber([1; 12]),
        capabilities: Capabilities::default(),
        limits: BoardKind::F350.limits(),
        reset_cause: ResetCause::PowerOn,
        latched: Default::default(),
    }
}

#[test]
fn a_lost_reply_is_asked_for_again() {
    let mut asked = 0;
    let (mut link, clock) = link(move |seq, _| {
        asked += 1;
        if asked < 3 { Vec::new() } else { alive(seq, 7) }
    });
    assert_eq!(link.call(&Heartbeat).unwrap().device_time_us, 7);
    assert_eq!((link.stats().requests, link.stats().repeated), (3, 2));
    assert!(clock.now_ns() >= 500_000_000);
}

#[test]
fn silence_ends_in_a_timeout_that_names_the_request() {
    let (mut link, clock) = link(|_, _| Vec::new());
    let Err(Error::Timeout(Timeout { missing, waited })) = link.call(&GetTiming) else { panic!() };
    assert_eq!(missing, Missing::Reply { request: "GetTiming" });
    assert_eq!(clock.now_ns(), waited.as_nanos() as u64);
}

#[test]
fn starting_is_never_repeated() {
    let (mut link, _) = link(|_, _| Vec::new());
    assert!(matches!(link.call(&StartStream), Err(Error::Timeout(_))));
    assert_eq!(link.stats().requests, 1);
}

#[test]
fn a_late_reply_to_the_first_copy_counts() {
    let first = Arc::new(Mutex::new(None));
    let (mut link, _) = link(move |seq, _| match first.lock().unwrap().replace(seq) {
        None => Vec::new(),
        Some(first) => alive(first, 11),
    });
    assert_eq!(link.call(&Heartbeat).unwrap().device_time_us, 11);
}

#[test]
fn replies_to_others_are_set_aside_and_counted() {
    let (mut link, _) = link(|seq, _| {
        let started = Started { first_frame_sequence: 1, timing_generation: 1, start_time_us: 1 };
        // A stranger's number, the right number on another kind of reply, then the reply.
        let mut bytes = alive(seq.wrapping_add(900), 1);
        bytes.extend(frame(|out| {
            encode_reply::<StartStream>(seq, &Ok(started), out).unwrap().len()
        }));
        bytes.extend(alive(seq, 2));
        bytes
    });
    assert_eq!(link.call(&Heartbeat).unwrap().device_time_us, 2);
    assert_eq!(link.stats().stale_replies, 2);
}

#[test]
fn events_between_request_and_reply_are_kept_in_order_and_gaps_counted() {
    let (mut link, _) = link(|seq, _| {
        let mut bytes = event(10, 1);
        bytes.extend(event(11, 2));
        bytes.extend(alive(seq, 1));
        bytes.extend(event(14, 3));
        bytes
    });
    link.call(&Heartbeat).unwrap();
    link.pump(Duration::ZERO).unwrap();
    let generations: Vec<_> = std::iter::from_fn(|| link.next_event())
        .map(|timed| match timed.event {
            Event::TimingEvent(event) => event.timing_generation,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(generations, [1, 2, 3]);
    assert_eq!(link.stats().events_lost, 2);
}

#[test]
fn damaged_frames_are_counted_and_asked_for_again() {
    let mut asked = 0;
    let (mut link, _) = link(move |seq, _| {
        asked += 1;
        let mut bytes = alive(seq, 3);
        if asked == 1 {
            bytes[2] ^= 0x10;
        }
        bytes
    });
    assert_eq!(link.call(&Heartbeat).unwrap().device_time_us, 3);
    assert_eq!(link.stats().frames_rejected, 1);
}

#[test]
fn a_refusal_is_not_repeated() {
    let (mut link, _) =
        link(|seq, _| frame(|out| encode_error(seq, &RequestError::NoSession, out).unwrap().len()));
    let Err(Error::Refused { request, source }) = link.call(&GetTiming) else { panic!() };
    assert_eq!((request, source), ("GetTiming", RequestError::NoSession));
    assert_eq!(link.stats().requests, 1);
}

#[test]
fn another_major_version_is_refused_on_either_side() {
    let newer = ProtocolVersion { major: PROTOCOL_VERSION.major + 1, minor: 0 };
    let (mut by_host, _) = link(move |seq, _| {
        frame(|out| encode_reply::<Hello>(seq, &Ok(info(newer)), out).unwrap().len())
    });
    let error = by_host.hello().unwrap_err();
    assert!(error.to_string().contains("update the older one"), "{error}");
    let (mut by_device, _) = link(move |seq, _| {
        let refusal = RequestError::VersionMismatch { device: newer };
        frame(|out| encode_error(seq, &refusal, out).unwrap().len())
    });
    assert!(matches!(by_device.hello(), Err(Error::Refused { .. })));
}

#[test]
fn heartbeats_go_out_while_waiting_and_set_the_device_clock() {
    let (mut link, clock) = link(|seq, request| match request {
        Request::Hello(_) => {
            frame(|out| encode_reply::<Hello>(seq, &Ok(info(PROTOCOL_VERSION)), out).unwrap().len())
        }
        Request::Heartbeat(_) => alive(seq, 123_456),
        _ => Vec::new(),
    });
    link.hello().unwrap();
    let timeout_ns = u64::from(BoardKind::F350.limits().heartbeat_timeout_us) * 1000;
    let mut last_requests = link.stats().requests;
    let mut silent_since_ns = clock.now_ns();
    while clock.now_ns() < 5 * timeout_ns {
        link.pump(Duration::from_millis(10)).unwrap();
        if link.stats().requests > last_requests {
            last_requests = link.stats().requests;
            silent_since_ns = clock.now_ns();
        }
        assert!(clock.now_ns() - silent_since_ns < timeout_ns / 2, "silent for too long");
    }
    assert!(last_requests >= 10);
    assert_eq!(link.device_clock().unwrap().device_us, 123_456);
}
