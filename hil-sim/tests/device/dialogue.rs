//! Whole dialogues over bytes.

use stspp_hil_sim::device::Controller;
use stspp_hil_sim::device::in_process::Injection;
use stspp_protocol::event::StateEvent;
use stspp_protocol::message::{Event, REPLY_BIT, Reply, Request};
use stspp_protocol::reply::{DeviceState, RequestError, RequestField, StorageError};
use stspp_protocol::request::*;
use stspp_protocol::timing::{Limits, ProjectionTiming, Slot, TimingField};
use stspp_protocol::trigger::TriggerSource;
use stspp_protocol::version::{
    BoardKind, Capabilities, PROTOCOL_VERSION, ProtocolVersion, ResetCause,
};
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN, encode_frame};

use crate::host::{Host, MS, S};

#[test]
fn hello_tells_who_is_there() {
    let mut host = Host::on(BoardKind::F350);
    let info = host.hello().unwrap();
    assert_eq!(info.protocol, PROTOCOL_VERSION);
    assert_eq!(info.board, BoardKind::F350);
    assert_eq!(info.limits, Limits::F350);
    assert_eq!(info.reset_cause, ResetCause::PowerOn);
    assert_eq!(info.firmware.to_string(), env!("CARGO_PKG_VERSION"));
    assert_eq!(info.serial.to_string().len(), 24);
    assert!(info.capabilities.contains(Capabilities::USB_SOF));
    assert!(matches!(host.events[..], [Event::BootEvent(boot)] if boot.latched.is_empty()));
    let info = Host::on(BoardKind::F330).hello().unwrap();
    assert!(!info.capabilities.contains(Capabilities::USB_SOF));
}

#[test]
fn minors_may_differ_and_majors_may_not() {
    let mut host = Host::connected();
    let version = |major, minor| Hello { host: ProtocolVersion { major, minor } };
    for minor in [0, 1, 999] {
        assert!(host.call(&version(PROTOCOL_VERSION.major, minor)).is_ok());
        host.call(&Arm).unwrap();
    }
    for major in [0, PROTOCOL_VERSION.major + 1, u16::MAX] {
        let mismatch = RequestError::VersionMismatch { device: PROTOCOL_VERSION };
        assert_eq!(host.call(&version(major, 0)), Err(mismatch));
        // It went dark, and serves nothing until a host speaks its version.
        assert_eq!(host.device.state(), Some(DeviceState::Idle));
        assert_eq!(host.call(&Arm), Err(mismatch));
        assert_eq!(host.call(&GetStatus), Err(mismatch));
        host.hello().unwrap();
        host.call(&Arm).unwrap();
    }
}

#[test]
fn nothing_changes_without_a_session() {
    let mut host = Host::on(BoardKind::F350);
    let refused = Err(RequestError::NoSession);
    assert_eq!(host.call(&Arm), refused);
    assert_eq!(host.call(&SaveSettings), refused);
    assert_eq!(host.call(&Reset), refused);
    assert_eq!(host.call(&FloodlightOn { duration_us: 1_000 }), refused);
    assert_eq!(host.call(&StartStream), Err(RequestError::NoSession));
    let timing = ProjectionTiming::default();
    assert_eq!(host.call(&SetTiming { timing }), Err(RequestError::NoSession));
    assert_eq!(host.call(&ClearFaults), Err(RequestError::NoSession));
    // Looking, and switching off, need none.
    assert!(!host.call(&GetStatus).unwrap().session);
    host.call(&GetInfo).unwrap();
    host.call(&GetTiming).unwrap();
    host.call(&GetFaults).unwrap();
    host.call(&Heartbeat).unwrap();
    host.call(&Disarm).unwrap();
    host.call(&FloodlightOff).unwrap();
    host.call(&StopStream).unwrap();
    assert!(host.edges.is_empty());
}

/// Every request of the table, in an order in which each is granted.
#[test]
fn every_request_is_served() {
    let mut host = Host::on(BoardKind::F350);
    let timing = ProjectionTiming { exposure_us: 20_000, ..ProjectionTiming::default() };
    let requests = [
        Request::Hello(Hello { host: PROTOCOL_VERSION }),
        Request::GetInfo(GetInfo),
        Request::Heartbeat(Heartbeat),
        Request::GetStatus(GetStatus),
        Request::GetTiming(GetTiming),
        Request::SetTiming(SetTiming { timing: timing.clone() }),
        Request::SaveSettings(SaveSettings),
        Request::LoadDefaults(LoadDefaults),
        Request::LoadSettings(LoadSettings),
        Request::SetTriggerSource(SetTriggerSource { source: TriggerSource::default() }),
        Request::GetTriggerSource(GetTriggerSource),
        Request::Arm(Arm),
        Request::FloodlightOn(FloodlightOn { duration_us: 1_000 }),
        Request::FloodlightOff(FloodlightOff),
        Request::StartStream(StartStream),
        Request::StopStream(StopStream),
        Request::StartBurst(StartBurst { frames: 2 }),
        Request::Disarm(Disarm),
        Request::GetFaults(GetFaults),
        Request::ClearFaults(ClearFaults),
        Request::Reset(Reset),
        Request::Hello(Hello { host: PROTOCOL_VERSION }),
        Request::RebootToBootloader(RebootToBootloader { key: BOOTLOADER_KEY }),
    ];
    let mut served = std::collections::HashSet::new();
    for request in &requests {
        let reply = host.ask(request).expect("a reply").unwrap_or_else(|error| {
            panic!("{request:?} was refused: {error}");
        });
        served.insert(std::mem::discriminant(request));
        if let Reply::LoadSettings(loaded) = reply {
            assert_eq!(loaded.timing, timing);
        }
        host.run(50 * MS);
    }
    assert!(host.device.is_in_bootloader());
    let requests_in_table =
        stspp_protocol::message::MESSAGE_TABLE.iter().filter(|row| !row.reply.is_empty()).count();
    assert_eq!(served.len(), requests_in_table);
}

#[test]
fn states_follow_the_drawing() {
    let mut host = Host::connected();
    let wrong = |state, needed| Err(RequestError::WrongState { state, needed });
    use DeviceState::{Armed, Idle, Running};
    assert_eq!(host.call(&StartStream).map(|_| ()), wrong(Idle, Armed));
    assert_eq!(host.call(&StartBurst { frames: 1 }).map(|_| ()), wrong(Idle, Armed));
    assert_eq!(host.call(&FloodlightOn { duration_us: 1 }).map(|_| ()), wrong(Idle, Armed));
    host.call(&Arm).unwrap();
    host.call(&Arm).unwrap();
    assert_eq!(host.call(&SaveSettings).map(|_| ()), wrong(Armed, Idle));
    host.call(&StartStream).unwrap();
    assert_eq!(host.call(&StartStream).map(|_| ()), wrong(Running, Armed));
    assert_eq!(host.call(&LoadSettings).map(|_| ()), wrong(Running, Idle));
    assert_eq!(host.call(&FloodlightOn { duration_us: 1 }).map(|_| ()), wrong(Running, Armed));
    host.run(10 * MS);
    host.call(&StopStream).unwrap();
    assert_eq!(host.device.state(), Some(Running), "until the slot is done");
    host.run(40 * MS);
    assert_eq!(host.device.state(), Some(Armed));
    host.call(&StartBurst { frames: 2 }).unwrap();
    host.run(70 * MS);
    assert_eq!(host.device.state(), Some(Armed));
    host.call(&StartStream).unwrap();
    host.run(10 * MS);
    let falls_at = host.now() + 50_000;
    host.call(&Disarm).unwrap();
    assert_eq!(host.last_fall_ns(), falls_at, "at once, in the middle of a slot");
    assert!(host.high().is_empty());
    let changes: Vec<(DeviceState, DeviceState)> = host
        .events
        .iter()
        .filter_map(|event| match event {
            Event::StateEvent(StateEvent { from, to, .. }) => Some((*from, *to)),
            _ => None,
        })
        .collect();
    let expected = [
        (Idle, Armed),
        (Armed, Running),
        (Running, Armed),
        (Armed, Running),
        (Running, Armed),
        (Armed, Running),
        (Running, Idle),
    ];
    assert_eq!(changes, expected);
}

/// A trigger that was cut short has a number of its own and no event: the host can tell.
#[test]
fn a_frame_cut_short_is_accounted_for() {
    let mut host = Host::armed();
    host.call(&StartStream).unwrap();
    host.run(40 * MS);
    host.call(&Disarm).unwrap();
    assert_eq!(host.triggers().len(), 1);
    assert_eq!(host.call(&GetStatus).unwrap().next_frame_sequence, 2);
    host.call(&Arm).unwrap();
    assert_eq!(host.burst(1).first_frame_sequence, 2);
}

#[test]
fn refused_numbers_come_with_their_range() {
    let mut host = Host::armed();
    assert_eq!(
        host.call(&StartBurst { frames: 0 }),
        Err(RequestError::OutOfRange {
            field: RequestField::BurstFrames,
            value: 0,
            min: 1,
            max: 65_535
        })
    );
    for value in [0, 500_001] {
        assert_eq!(
            host.call(&FloodlightOn { duration_us: value }),
            Err(RequestError::OutOfRange {
                field: RequestField::FloodlightDurationUs,
                value,
                min: 1,
                max: 500_000
            })
        );
    }
    let key = BOOTLOADER_KEY ^ 1;
    let refused = host.call(&RebootToBootloader { key }).unwrap_err();
    assert!(matches!(refused, RequestError::OutOfRange { field: RequestField::BootloaderKey, .. }));
    let before = host.call(&GetTiming).unwrap();
    let timing = ProjectionTiming { frame_period_us: 10, ..ProjectionTiming::default() };
    let Err(RequestError::Timing(error)) = host.call(&SetTiming { timing }) else {
        panic!("accepted");
    };
    assert_eq!((error.field, error.value, error.min), (TimingField::FramePeriodUs, 10, 1_000));
    assert_eq!(host.call(&GetTiming).unwrap(), before, "a refused request has changed nothing");
    host.call(&Disarm).unwrap();
    assert_eq!(host.call(&LoadSettings).unwrap_err(), RequestError::Storage(StorageError::Empty));
}

#[test]
fn the_floodlight_is_bounded() {
    let mut host = Host::armed();
    let asked = host.now() + 50_000;
    host.call(&FloodlightOn { duration_us: 100_000 }).unwrap();
    assert!(host.call(&GetStatus).unwrap().floodlight_on);
    host.run(S / 2);
    assert_eq!(host.last_fall_ns(), asked + 100 * MS);
    assert!(!host.call(&GetStatus).unwrap().floodlight_on);
    // Asking again restarts the time, but one on-time stays within the limit.
    host.call(&FloodlightOn { duration_us: 400_000 }).unwrap();
    host.run(300 * MS);
    host.call(&FloodlightOn { duration_us: 150_000 }).unwrap();
    let refused = host.call(&FloodlightOn { duration_us: 400_000 }).unwrap_err();
    assert!(
        matches!(refused, RequestError::OutOfRange { max: 199_000..=200_000, .. }),
        "{refused}"
    );
    host.call(&FloodlightOff).unwrap();
    assert!(host.high().is_empty());
    // Starting a run ends it.
    host.run_alive(2 * S);
    host.call(&FloodlightOn { duration_us: 400_000 }).unwrap();
    host.burst(1);
    assert!(!host.high().contains(&stspp_hil_sim::device::Line::Floodlight));
}

#[test]
fn the_duty_of_repeated_bursts_is_limited() {
    let mut host = Host::armed();
    let mut bursts = 0;
    let refused = loop {
        match host.call(&StartBurst { frames: 1 }) {
            Ok(_) => host.run_alive(33 * MS),
            Err(error) => break error,
        }
        bursts += 1;
        assert!(bursts < 1_000, "projector 0 may not be on for nearly all of the time");
    };
    let RequestError::DutyBudget { emitter: 0, retry_after_us } = refused else {
        panic!("{refused}");
    };
    // Half a microsecond's truth: too early is refused, then it is granted.
    host.run(u64::from(retry_after_us) * 1_000 - 300_000);
    assert!(host.call(&StartBurst { frames: 1 }).is_err());
    host.run(300_000);
    host.call(&StartBurst { frames: 1 }).unwrap();
    // Another projector was never tired.
    host.run_alive(100 * MS);
    host.set_timing(&ProjectionTiming {
        slots: [Slot::projector(1), Slot::dark(), Slot::dark()].into_iter().collect(),
        ..ProjectionTiming::default()
    });
    host.call(&StartBurst { frames: 1 }).unwrap();
}

#[test]
fn unknown_and_malformed_messages_are_answered() {
    let mut host = Host::connected();
    let mut out = [0; MAX_FRAME_LEN];
    for (id, body, expected) in [
        (0x3F, &[0u8; 0][..], RequestError::UnknownMessage { id: 0x3F }),
        (0x40, &[], RequestError::UnknownMessage { id: 0x40 }),
        (0x83, &[], RequestError::UnknownMessage { id: 0x83 }),
        (0x07, &[1, 2], RequestError::Malformed { id: 0x07 }),
        (0x0B, &[0x80], RequestError::Malformed { id: 0x0B }),
        (0x06, &[17], RequestError::Malformed { id: 0x06 }),
    ] {
        // A byte at a time in postcard is that byte: a tuple of bytes has no length in front.
        let bytes = match body {
            [] => encode_frame(id, 9, &(), &mut out),
            [a] => encode_frame(id, 9, a, &mut out),
            [a, b] => encode_frame(id, 9, &(*a, *b), &mut out),
            _ => unreachable!("bodies above are short"),
        };
        let bytes = bytes.unwrap().to_vec();
        host.send_raw(&bytes);
        host.device.run_until(host.now() + MS, &mut Vec::new());
        let mut reply = Vec::new();
        host.device.host_read(&mut reply);
        let mut decoder = FrameDecoder::new();
        let mut rest = reply.as_slice();
        let frame = decoder.next_frame(&mut rest).unwrap().unwrap();
        assert_eq!((frame.id, frame.seq), (0xFF, 9));
        assert_eq!(frame.body_as::<RequestError>(), Ok(expected));
        assert_ne!(frame.id & REPLY_BIT, 0);
    }
    host.call(&Arm).unwrap();
}

/// A million bytes of noise and of frames with something changed: no light, and still answering.
#[test]
fn garbage_is_survived() {
    for board in [BoardKind::F330, BoardKind::F350] {
        let mut host = Host::on(board);
        host.hello().unwrap();
        let mut noise = 0x1234_5678_9ABC_DEF0_u64;
        let mut next = || {
            noise ^= noise << 13;
            noise ^= noise >> 7;
            noise ^= noise << 17;
            noise
        };
        let mut out = [0; MAX_FRAME_LEN];
        let requests = [
            Request::Arm(Arm),
            Request::StartStream(StartStream),
            Request::SetTiming(SetTiming { timing: ProjectionTiming::default() }),
            Request::FloodlightOn(FloodlightOn { duration_us: 400_000 }),
        ];
        let mut sent = 0;
        while sent < 1_000_000 {
            let mut bytes = Vec::new();
            if next().is_multiple_of(2) {
                bytes.extend((0..next() % 2_000).map(|_| next() as u8));
            } else {
                for _ in 0..next() % 40 {
                    let request = &requests[(next() % 4) as usize];
                    let mut frame = request.encode(next() as u16, &mut out).unwrap().to_vec();
                    // One bit of one byte, but never so that the frame is cut: a good half of two
                    // frames would be a frame.
                    let at = (next() % (frame.len() as u64 - 1)) as usize;
                    let flipped = frame[at] ^ 1 << (next() % 8);
                    frame[at] = if flipped == 0 { frame[at] ^ 0x81 } else { flipped };
                    bytes.append(&mut frame);
                }
            }
            sent += bytes.len();
            host.send_raw(&bytes);
            host.run(MS);
        }
        // A zero ends whatever the noise began.
        host.send_raw(&[0]);
        let status = host.call(&GetStatus).unwrap();
        assert!(host.edges.is_empty(), "no light from noise");
        assert_eq!(status.state, DeviceState::Idle);
        assert!(status.link.frames_rejected > 10_000, "{:?}", status.link);
        host.call(&Arm).unwrap();
        host.burst(1);
        host.run(50 * MS);
        assert_eq!(host.triggers().len(), 1);
    }
}

/// More events than their count of 16 bits has room for, and time far beyond 32 bits of nanoseconds.
#[test]
fn event_numbers_wrap() {
    let mut host = Host::armed();
    host.set_timing(&ProjectionTiming {
        frame_period_us: 1_000,
        exposure_us: 500,
        ..ProjectionTiming::default()
    });
    host.call(&StartStream).unwrap();
    host.run_alive(70 * S);
    let stop = host.call(&StopStream).unwrap();
    host.run(2 * MS);
    let frames: Vec<u32> = host.triggers().iter().map(|event| event.frame_sequence).collect();
    assert!(frames.iter().copied().eq(0..stop.end_frame_sequence));
    assert!(frames.len() > 69_000);
    let steps = host.event_seqs.windows(2);
    assert!(steps.into_iter().all(|pair| pair[1] == pair[0].wrapping_add(1)));
}

#[test]
fn requests_may_come_in_pieces_or_all_at_once() {
    let mut host = Host::connected();
    let mut out = [0; MAX_FRAME_LEN];
    let mut stream = Vec::new();
    for seq in 1000..1010 {
        stream.extend_from_slice(Request::Heartbeat(Heartbeat).encode(seq, &mut out).unwrap());
    }
    let count = |host: &mut Host| {
        let mut bytes = Vec::new();
        host.device.run_until(host.now() + MS, &mut Vec::new());
        host.device.host_read(&mut bytes);
        bytes.iter().filter(|&&byte| byte == 0).count()
    };
    host.send_raw(&stream);
    assert_eq!(count(&mut host), 10);
    for byte in &stream {
        host.send_raw(&[*byte]);
    }
    assert_eq!(count(&mut host), 10);
}

#[test]
fn link_faults_show_as_gaps_repeats_and_bad_frames() {
    let mut host = Host::armed();
    host.events.clear();
    host.event_seqs.clear();
    host.burst(20);
    host.run(50 * MS);
    host.device.inject(Injection::LoseNextEvent);
    host.run(100 * MS);
    host.device.inject(Injection::DuplicateNextEvent);
    host.run(100 * MS);
    host.device.inject(Injection::CorruptNextFrame);
    host.run(600 * MS);
    let frames: Vec<u32> = host.triggers().iter().map(|event| event.frame_sequence).collect();
    assert_eq!(frames.len(), 20 - 1 + 1 - 1, "{frames:?}");
    assert_eq!(host.bad_frames, 1);
    let steps: Vec<u16> =
        host.event_seqs.windows(2).map(|pair| pair[1].wrapping_sub(pair[0])).collect();
    assert_eq!(steps.iter().filter(|&&step| step == 2).count(), 2, "{steps:?}");
    assert_eq!(steps.iter().filter(|&&step| step == 0).count(), 1, "{steps:?}");
}
