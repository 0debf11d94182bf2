//! Every message, byte for byte, as it went over the wire in protocol 1.0; what a minor added has its
//! number in the name.
//!
//! These bytes never change within a major version. A change here is a new major, or a mistake.

use std::collections::BTreeSet;

use stspp_protocol::event::{BootEvent, FaultEvent, StateEvent, TimingEvent, TriggerEvent};
use stspp_protocol::fault::{FaultReason, FaultRecord, FaultReport, FaultSet};
use stspp_protocol::message::{Event, FromDevice, MESSAGE_TABLE, Reply, Request, encode_error};
use stspp_protocol::reply::*;
use stspp_protocol::request::*;
use stspp_protocol::timing::{Limits, ProjectionTiming, Slot, TimingError, TimingField};
use stspp_protocol::trigger::{ExternalTrigger, TriggerEdge, TriggerInput, TriggerSource};
use stspp_protocol::version::*;
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};

const SEQ: u16 = 0x0102;

fn timing() -> ProjectionTiming {
    ProjectionTiming {
        slots: [
            Slot::projector(0),
            Slot { projector_mask: 0x0381, floodlight: true },
            Slot::dark(),
        ]
        .into_iter()
        .collect(),
        ..ProjectionTiming::default()
    }
}

fn info() -> DeviceInfo {
    DeviceInfo {
        protocol: ProtocolVersion { major: 1, minor: 0 },
        firmware: FirmwareVersion { major: 0, minor: 1, patch: 2 },
        board: BoardKind::F350,
        serial: SerialNumber(*b"\x01\x23\x45\x67\x89\xAB\xCD\xEF\x00\x11\x22\x33"),
        capabilities: Capabilities(0x1F),
        limits: Limits::F350,
        reset_cause: ResetCause::Watchdog,
        latched: FaultSet::from_iter([FaultReason::Watchdog]),
    }
}

fn active() -> ActiveTiming {
    ActiveTiming { timing: timing(), timing_generation: 300, pending: true }
}

fn started() -> Started {
    Started { first_frame_sequence: 70_000, timing_generation: 2, start_time_us: 5_000_000_000 }
}

fn record() -> FaultRecord {
    FaultRecord { reason: FaultReason::OverTemperature, time_us: 123_456, value: 712, limit: 700 }
}

fn report() -> FaultReport {
    FaultReport {
        latched: FaultSet(0x05),
        active: FaultSet(0x04),
        first: Some(record()),
        last: None,
    }
}

fn external() -> TriggerSource {
    TriggerSource::External(ExternalTrigger { edge: TriggerEdge::Falling, delay_us: 250 })
}

fn requests() -> Vec<(Request, &'static str)> {
    vec![
        (Request::Hello(Hello { host: ProtocolVersion { major: 1, minor: 0 } }), "REQ_HELLO"),
        (Request::GetInfo(GetInfo), "REQ_GET_INFO"),
        (Request::Heartbeat(Heartbeat), "REQ_HEARTBEAT"),
        (Request::GetStatus(GetStatus), "REQ_GET_STATUS"),
        (Request::GetTiming(GetTiming), "REQ_GET_TIMING"),
        (Request::SetTiming(SetTiming { timing: timing() }), "REQ_SET_TIMING"),
        (Request::Arm(Arm), "REQ_ARM"),
        (Request::Disarm(Disarm), "REQ_DISARM"),
        (Request::StartStream(StartStream), "REQ_START_STREAM"),
        (Request::StopStream(StopStream), "REQ_STOP_STREAM"),
        (Request::StartBurst(StartBurst { frames: 1_000 }), "REQ_START_BURST"),
        (Request::FloodlightOn(FloodlightOn { duration_us: 250_000 }), "REQ_FLOODLIGHT_ON"),
        (Request::FloodlightOff(FloodlightOff), "REQ_FLOODLIGHT_OFF"),
        (Request::GetFaults(GetFaults), "REQ_GET_FAULTS"),
        (Request::ClearFaults(ClearFaults), "REQ_CLEAR_FAULTS"),
        (Request::SaveSettings(SaveSettings), "REQ_SAVE_SETTINGS"),
        (Request::LoadSettings(LoadSettings), "REQ_LOAD_SETTINGS"),
        (Request::LoadDefaults(LoadDefaults), "REQ_LOAD_DEFAULTS"),
        (Request::Reset(Reset), "REQ_RESET"),
        (
            Request::RebootToBootloader(RebootToBootloader { key: BOOTLOADER_KEY }),
            "REQ_REBOOT_TO_BOOTLOADER",
        ),
        (Request::SetTriggerSource(SetTriggerSource { source: external() }), "REQ_SET_TRIGGER_1_1"),
        (
            Request::SetTriggerSource(SetTriggerSource { source: TriggerSource::FreeRunning }),
            "REQ_SET_TRIGGER_FREE_1_1",
        ),
        (Request::GetTriggerSource(GetTriggerSource), "REQ_GET_TRIGGER_1_1"),
    ]
}

fn replies() -> Vec<(Reply, &'static str)> {
    let alive = Alive { device_time_us: 0x0123_4567_89AB, state: DeviceState::Running };
    let status = Status {
        state: DeviceState::Faulted,
        device_time_us: 1_000_000,
        session: true,
        latched: FaultSet(0x02),
        interlock_closed: true,
        temperature_dc: -55,
        timing_generation: 7,
        next_frame_sequence: 1_234,
        floodlight_on: false,
        events_dropped: 3,
        link: LinkCounters { frames_received: 100, frames_rejected: 2, bytes_overrun: 1 },
    };
    vec![
        (Reply::Hello(info()), "REP_HELLO"),
        (Reply::GetInfo(info()), "REP_GET_INFO"),
        (Reply::Heartbeat(alive), "REP_HEARTBEAT"),
        (Reply::GetStatus(status), "REP_GET_STATUS"),
        (Reply::GetTiming(active()), "REP_GET_TIMING"),
        (
            Reply::SetTiming(TimingAccepted { timing_generation: 301, pending: false }),
            "REP_SET_TIMING",
        ),
        (Reply::Arm(Done), "REP_ARM"),
        (Reply::Disarm(Done), "REP_DISARM"),
        (Reply::StartStream(started()), "REP_START_STREAM"),
        (Reply::StopStream(Stopping { end_frame_sequence: 70_010 }), "REP_STOP_STREAM"),
        (Reply::StartBurst(started()), "REP_START_BURST"),
        (Reply::FloodlightOn(Done), "REP_FLOODLIGHT_ON"),
        (Reply::FloodlightOff(Done), "REP_FLOODLIGHT_OFF"),
        (Reply::GetFaults(report()), "REP_GET_FAULTS"),
        (Reply::ClearFaults(report()), "REP_CLEAR_FAULTS"),
        (Reply::SaveSettings(Done), "REP_SAVE_SETTINGS"),
        (Reply::LoadSettings(active()), "REP_LOAD_SETTINGS"),
        (Reply::LoadDefaults(active()), "REP_LOAD_DEFAULTS"),
        (Reply::Reset(Done), "REP_RESET"),
        (Reply::RebootToBootloader(Done), "REP_REBOOT_TO_BOOTLOADER"),
        (Reply::SetTriggerSource(Done), "REP_SET_TRIGGER_1_1"),
        (
            Reply::GetTriggerSource(TriggerInput {
                source: external(),
                edges_taken: 300,
                edges_ignored: 2,
            }),
            "REP_GET_TRIGGER_1_1",
        ),
    ]
}

fn events() -> Vec<(Event, &'static str)> {
    let trigger = TriggerEvent {
        frame_sequence: 70_001,
        slot_index: 9,
        projector_mask: 0x0200,
        floodlight: false,
        trigger_time_us: 5_000_033_433,
        usb_sof: Some(2_047),
        timing_generation: 2,
    };
    let state = StateEvent {
        from: DeviceState::Running,
        to: DeviceState::Armed,
        time_us: 6_000_000,
        next_frame_sequence: 70_010,
    };
    let boot = BootEvent {
        protocol: ProtocolVersion { major: 1, minor: 0 },
        reset_cause: ResetCause::PowerOn,
        latched: FaultSet::EMPTY,
    };
    vec![
        (Event::TriggerEvent(trigger), "EVT_TRIGGER"),
        (
            Event::TriggerEvent(TriggerEvent { usb_sof: None, floodlight: true, ..trigger }),
            "EVT_TRIGGER_F330",
        ),
        (Event::FaultEvent(FaultEvent { record: record(), latched: FaultSet(0x04) }), "EVT_FAULT"),
        (
            Event::FaultEvent(FaultEvent {
                record: FaultRecord { reason: FaultReason::EdgeDma, ..record() },
                latched: FaultSet(0x1004),
            }),
            "EVT_FAULT_EDGE_DMA_1_1",
        ),
        (
            Event::FaultEvent(FaultEvent {
                record: FaultRecord { reason: FaultReason::WrongBoard, ..record() },
                latched: FaultSet(0x2000),
            }),
            "EVT_FAULT_WRONG_BOARD_1_1",
        ),
        (
            Event::FaultEvent(FaultEvent {
                record: FaultRecord { reason: FaultReason::Clock, ..record() },
                latched: FaultSet(0x4000),
            }),
            "EVT_FAULT_CLOCK_1_1",
        ),
        (Event::StateEvent(state), "EVT_STATE"),
        (
            Event::TimingEvent(TimingEvent { timing_generation: 3, first_frame_sequence: 70_020 }),
            "EVT_TIMING",
        ),
        (Event::BootEvent(boot), "EVT_BOOT"),
    ]
}

fn errors() -> Vec<(RequestError, &'static str)> {
    let timing = TimingError {
        field: TimingField::ExposureUs,
        index: None,
        value: 41_000,
        min: 10,
        max: 39_900,
    };
    let duty = TimingError {
        field: TimingField::ProjectorDutyPermille,
        index: Some(7),
        value: 964,
        min: 0,
        max: 400,
    };
    let device = ProtocolVersion { major: 1, minor: 0 };
    vec![
        (RequestError::VersionMismatch { device }, "ERR_VERSION_MISMATCH"),
        (RequestError::UnknownMessage { id: 0x3F }, "ERR_UNKNOWN_MESSAGE"),
        (RequestError::Malformed { id: 0x06 }, "ERR_MALFORMED"),
        (RequestError::NoSession, "ERR_NO_SESSION"),
        (
            RequestError::WrongState { state: DeviceState::Idle, needed: DeviceState::Armed },
            "ERR_WRONG_STATE",
        ),
        (RequestError::Timing(timing), "ERR_TIMING"),
        (RequestError::Timing(duty), "ERR_TIMING_INDEXED"),
        (RequestError::Faulted { latched: FaultSet(0x402) }, "ERR_FAULTED"),
        (RequestError::InterlockOpen, "ERR_INTERLOCK_OPEN"),
        (
            RequestError::OutOfRange {
                field: RequestField::FloodlightDurationUs,
                value: 600_000,
                min: 1,
                max: 500_000,
            },
            "ERR_OUT_OF_RANGE",
        ),
        (
            RequestError::OutOfRange {
                field: RequestField::TriggerDelayUs,
                value: 10,
                min: 60,
                max: 900,
            },
            "ERR_TRIGGER_DELAY_1_1",
        ),
        (RequestError::DutyBudget { emitter: 10, retry_after_us: 12_345 }, "ERR_DUTY_BUDGET"),
        (RequestError::Storage(StorageError::Write), "ERR_STORAGE"),
        (RequestError::Unsupported, "ERR_UNSUPPORTED"),
    ]
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(digits: &str) -> Vec<u8> {
    (0..digits.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&digits[at..at + 2], 16).expect("hexadecimal"))
        .collect()
}

fn frozen(name: &str) -> &'static str {
    include_str!("frozen_bytes.txt")
        .lines()
        .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))
        .unwrap_or_else(|| panic!("no frozen bytes for {name}"))
        .trim()
}

#[test]
fn every_message_encodes_to_its_frozen_bytes() {
    let mut out = [0; MAX_FRAME_LEN];
    let mut wrong = String::new();
    let mut check = |name: &str, bytes: &[u8]| {
        if frozen(name) != hex(bytes) {
            wrong += &format!("{name} {}\n", hex(bytes));
        }
    };
    for (request, name) in requests() {
        check(name, request.encode(SEQ, &mut out).unwrap());
    }
    for (reply, name) in replies() {
        check(name, reply.encode(SEQ, &mut out).unwrap());
    }
    for (event, name) in events() {
        check(name, event.encode(SEQ, &mut out).unwrap());
    }
    for (error, name) in errors() {
        check(name, encode_error(SEQ, &error, &mut out).unwrap());
    }
    assert!(wrong.is_empty(), "these changed:\n{wrong}");
}

#[test]
fn the_frozen_bytes_decode_to_their_messages() {
    let with_frame = |name: &str, look: &dyn Fn(&stspp_protocol::wire::Frame<'_>)| {
        let bytes = unhex(frozen(name));
        let mut decoder = FrameDecoder::new();
        look(&decoder.next_frame(&mut bytes.as_slice()).expect(name).expect(name));
    };
    for (request, name) in requests() {
        with_frame(name, &|frame| {
            assert_eq!(Request::decode(frame), Ok(request.clone()), "{name}")
        });
    }
    for (reply, name) in replies() {
        let expected = FromDevice::Reply { seq: SEQ, reply: Ok(reply) };
        with_frame(name, &|frame| {
            assert_eq!(FromDevice::decode(frame), Ok(expected.clone()), "{name}");
        });
    }
    for (event, name) in events() {
        let expected = FromDevice::Event { seq: SEQ, event };
        with_frame(name, &|frame| {
            assert_eq!(FromDevice::decode(frame), Ok(expected.clone()), "{name}");
        });
    }
    for (error, name) in errors() {
        let expected = FromDevice::Reply { seq: SEQ, reply: Err(error) };
        with_frame(name, &|frame| {
            assert_eq!(FromDevice::decode(frame), Ok(expected.clone()), "{name}");
        });
    }
}

#[test]
fn no_message_is_missing_here() {
    let mut out = [0; MAX_FRAME_LEN];
    let id_of = |bytes: &[u8]| {
        let mut decoder = FrameDecoder::new();
        let mut rest = bytes;
        decoder.next_frame(&mut rest).unwrap().unwrap().id
    };
    let mut seen = BTreeSet::new();
    for (request, _) in requests() {
        seen.insert(id_of(request.encode(SEQ, &mut out).unwrap()));
    }
    for (reply, _) in replies() {
        seen.insert(id_of(reply.encode(SEQ, &mut out).unwrap()));
    }
    for (event, _) in events() {
        seen.insert(id_of(event.encode(SEQ, &mut out).unwrap()));
    }
    for row in MESSAGE_TABLE {
        assert!(seen.contains(&row.id), "{} is not frozen", row.name);
        if !row.reply.is_empty() {
            assert!(seen.contains(&(row.id | 0x80)), "the reply to {} is not frozen", row.name);
        }
    }
}

/// One frame taken apart by hand, so that the layout in `docs/protocol.md` is held, too.
#[test]
fn a_heartbeat_reply_is_laid_out_as_documented() {
    let bytes = unhex(frozen("REP_HEARTBEAT"));
    // COBS of: 83 | 02 01 | varint(0x0123456789AB) = ab 93 9e ab b4 24 .., state 2 | crc
    let mut packet = Vec::new();
    let mut at = 0;
    while bytes[at] != 0 {
        let run = usize::from(bytes[at]);
        packet.extend_from_slice(&bytes[at + 1..at + run]);
        at += run;
        if bytes[at] != 0 {
            packet.push(0);
        }
    }
    assert_eq!(packet[0], 0x83);
    assert_eq!(packet[1..3], [0x02, 0x01]);
    let mut number = 0u64;
    let mut len = 0;
    for byte in &packet[3..] {
        number |= u64::from(byte & 0x7F) << (7 * len);
        len += 1;
        if byte & 0x80 == 0 {
            break;
        }
    }
    assert_eq!(number, 0x0123_4567_89AB);
    assert_eq!(packet[3 + len], 2, "Running is the third state");
    assert_eq!(packet.len(), 3 + len + 1 + 2);
}
