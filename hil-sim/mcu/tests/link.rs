//! Both links: every message, the USB device as an operating system sees it, and noise.

mod common;

use std::collections::BTreeSet;

use stspp_hil_mcu::session::{CallError, Session};
use stspp_hil_mcu::soc::Variant;
use stspp_hil_mcu::usb::descriptors::TransferType;
use stspp_hil_sim::device::Controller;
use stspp_protocol::message::{Event, MESSAGE_TABLE, Reply, Request};
use stspp_protocol::reply::{DeviceState, RequestError};
use stspp_protocol::request::{
    Arm, BOOTLOADER_KEY, ClearFaults, Disarm, FloodlightOff, FloodlightOn, GetFaults, GetInfo,
    GetStatus, GetTiming, GetTriggerSource, Heartbeat, Hello, LoadDefaults, LoadSettings,
    RebootToBootloader, Reset, SaveSettings, SetTiming, SetTriggerSource, StartBurst, StartStream,
    StopStream,
};
use stspp_protocol::timing::{ProjectionTiming, Slot};
use stspp_protocol::trigger::TriggerSource;
use stspp_protocol::usb;
use stspp_protocol::version::PROTOCOL_VERSION;
use stspp_protocol::wire::MAX_FRAME_LEN;

fn short() -> ProjectionTiming {
    ProjectionTiming { frame_period_us: 5_000, exposure_us: 3_000, ..ProjectionTiming::default() }
}

/// One request of each kind, in an order in which each is served.
fn all_requests() -> Vec<Request> {
    vec![
        Request::Hello(Hello { host: PROTOCOL_VERSION }),
        Request::GetInfo(GetInfo),
        Request::Heartbeat(Heartbeat),
        Request::GetStatus(GetStatus),
        Request::LoadDefaults(LoadDefaults),
        Request::SetTiming(SetTiming { timing: short() }),
        Request::GetTiming(GetTiming),
        Request::SaveSettings(SaveSettings),
        Request::LoadSettings(LoadSettings),
        Request::SetTriggerSource(SetTriggerSource { source: TriggerSource::default() }),
        Request::GetTriggerSource(GetTriggerSource),
        Request::Arm(Arm),
        Request::FloodlightOn(FloodlightOn { duration_us: 2_000 }),
        Request::FloodlightOff(FloodlightOff),
        Request::StartBurst(StartBurst { frames: 3 }),
        Request::StopStream(StopStream),
        Request::GetFaults(GetFaults),
        Request::ClearFaults(ClearFaults),
        Request::Disarm(Disarm),
        Request::Arm(Arm),
        Request::StartStream(StartStream),
    ]
}

#[test]
fn every_message_passes_over_both_links() {
    for variant in common::BOARDS {
        let Some(mut session) = common::session(variant) else { continue };
        let mut names = BTreeSet::new();
        for request in all_requests() {
            names.insert(format!("{request:?}").split('(').next().unwrap_or_default().to_string());
            let reply = session
                .call(request.clone())
                .unwrap_or_else(|e| panic!("{variant:?}, {request:?}: {e}"));
            match (&request, &reply) {
                (Request::Hello(_), Reply::Hello(info)) => {
                    assert_eq!(format!("{:?}", info.board), format!("{variant:?}"));
                    assert_eq!(info.serial.0, session.controller.chip().soc().unique_id);
                }
                (Request::GetTiming(_), Reply::GetTiming(active)) => {
                    assert_eq!(active.timing, short())
                }
                (Request::LoadSettings(_), Reply::LoadSettings(active)) => {
                    assert_eq!(active.timing, short())
                }
                (Request::GetStatus(_), Reply::GetStatus(status)) => {
                    assert_eq!(status.state, DeviceState::Idle);
                    assert!(
                        (240..=260).contains(&status.temperature_dc),
                        "{}",
                        status.temperature_dc
                    );
                    assert!(status.interlock_closed);
                }
                _ => {}
            }
            // Flash operations stall the core; what follows is asked in peace.
            session.run_for(30_000_000);
        }
        session.run_for(50_000_000);
        // While running, a new timing takes over at a cycle boundary: its event.
        let other = ProjectionTiming { exposure_us: 2_000, ..short() };
        session.call(Request::SetTiming(SetTiming { timing: other })).unwrap();
        session.run_for(120_000_000);
        session.controller.set_interlock_closed(false);
        session.run_for(20_000_000);
        session.controller.set_interlock_closed(true);
        assert!(matches!(
            session.call(Request::RebootToBootloader(RebootToBootloader { key: 1 })),
            Err(CallError::Refused(RequestError::OutOfRange { .. }))
        ));
        session.call(Request::Reset(Reset)).unwrap();
        session.run_for(500_000_000);
        let events: Vec<Event> = session.take_events().into_iter().map(|e| e.event).collect();
        for (name, seen) in [
            ("TriggerEvent", events.iter().any(|e| matches!(e, Event::TriggerEvent(_)))),
            ("FaultEvent", events.iter().any(|e| matches!(e, Event::FaultEvent(_)))),
            ("StateEvent", events.iter().any(|e| matches!(e, Event::StateEvent(_)))),
            ("TimingEvent", events.iter().any(|e| matches!(e, Event::TimingEvent(_)))),
            ("BootEvent", events.iter().any(|e| matches!(e, Event::BootEvent(_)))),
        ] {
            assert!(seen, "{variant:?}: no {name}");
            names.insert(name.to_string());
        }
        assert_eq!(session.controller.chip().resets().len(), 2, "{variant:?}");
        session.hello().unwrap();
        session
            .call(Request::RebootToBootloader(RebootToBootloader { key: BOOTLOADER_KEY }))
            .unwrap();
        names.extend(["Reset".to_string(), "RebootToBootloader".to_string()]);
        let table: BTreeSet<String> =
            MESSAGE_TABLE.iter().map(|row| row.name.to_string()).collect();
        assert_eq!(names, table, "{variant:?}: messages of the table that were not exercised");
        assert_eq!(session.bad_frames, 0);
        common::assert_all_modelled(&mut session);
    }
}

#[test]
fn the_usb_device_is_what_the_protocol_says() {
    let Some(session) = common::session(Variant::F350) else { return };
    let device = session.controller.enumerated().expect("the F350 is enumerated").clone();
    println!("{device}");
    assert_eq!(
        (device.device.vendor_id, device.device.product_id),
        (usb::VENDOR_ID, usb::PRODUCT_ID)
    );
    assert_eq!(device.strings[0], usb::MANUFACTURER);
    assert_eq!(device.strings[1], usb::PRODUCT);
    let serial = session.controller.enumerated().map(|d| d.strings[2].clone());
    assert_eq!(serial.map(|s| s.len()), Some(24));
    let [interface] = &device.configuration.interfaces[..] else { panic!("{device}") };
    assert_eq!(
        interface.class,
        [usb::INTERFACE_CLASS, usb::INTERFACE_SUBCLASS, usb::INTERFACE_PROTOCOL]
    );
    let endpoints: Vec<_> = interface
        .endpoints
        .iter()
        .map(|e| (e.address, e.transfer, usize::from(e.max_packet)))
        .collect();
    assert_eq!(
        endpoints,
        [
            (usb::ENDPOINT_REQUESTS, TransferType::Bulk, usb::MAX_PACKET_LEN),
            (usb::ENDPOINT_REPLIES, TransferType::Bulk, usb::MAX_PACKET_LEN),
            (usb::ENDPOINT_EVENTS, TransferType::Interrupt, usb::MAX_PACKET_LEN),
        ]
    );
    assert!(device.configuration.max_power_ma <= usb::MAX_POWER_MA);
    let ms_os = device.ms_os.expect("Windows finds its driver");
    assert_eq!(ms_os.compatible_id, "WINUSB");
    assert_eq!(ms_os.interface_guids, usb::MS_OS_INTERFACE_GUID);
    let text = format!("{}", session.controller.enumerated().unwrap());
    assert!(text.contains("Endpoint 0x82 EP 2 IN: Interrupt, 64 bytes, interval 1"), "{text}");
}

#[test]
fn replies_come_within_a_millisecond() {
    for variant in common::BOARDS {
        let Some(mut session) = common::session(variant) else { continue };
        session.hello().unwrap();
        let mut slowest_ns = 0;
        for _ in 0..50 {
            for request in [
                Request::GetStatus(GetStatus),
                Request::Heartbeat(Heartbeat),
                Request::GetInfo(GetInfo),
            ] {
                session.call(request).unwrap();
                slowest_ns = slowest_ns.max(session.last_call_ns);
                session.run_for(730_000);
            }
        }
        println!("{variant:?}: slowest reply {} us", slowest_ns / 1000);
        assert!(slowest_ns < 1_000_000, "{variant:?}: {slowest_ns} ns");
    }
}

#[test]
fn a_replugged_or_resumed_device_works_again() {
    let Some(mut session) = common::session(Variant::F350) else { return };
    session.hello().unwrap();
    session.controller.set_bus_suspended(true);
    session.run_for(200_000_000);
    session.controller.set_bus_suspended(false);
    session.run_for(100_000_000);
    session.call(Request::GetStatus(GetStatus)).expect("answers after a resume");
    session.controller.set_link_connected(false);
    session.run_for(300_000_000);
    session.controller.set_link_connected(true);
    session.run_for(600_000_000);
    session.hello().expect("answers after it was plugged in again");
    common::assert_all_modelled(&mut session);
}

/// Xorshift: the bytes are the same in every run.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }
}

fn a_million_bytes_of_noise(variant: Variant) {
    const BYTES: usize = 1_000_000;
    let Some(mut session) = common::session(variant) else { return };
    let mut noise = Noise(0x5eed_0000 + variant as u64);
    let mut requests = all_requests();
    // A timing of the largest size.
    let timing =
        ProjectionTiming { slots: (0..16).map(|n| Slot::projector(n % 10)).collect(), ..short() };
    requests.push(Request::SetTiming(SetTiming { timing }));
    let mut sent = 0;
    while sent < BYTES {
        let mut chunk = Vec::new();
        while chunk.len() < 1_000 {
            if noise.next().is_multiple_of(3) {
                chunk.extend((0..1 + noise.next() % 100).map(|_| noise.next() as u8));
            } else {
                // A valid frame with some of its bytes changed, cut or doubled.
                let request = &requests[noise.next() as usize % requests.len()];
                let mut out = [0; MAX_FRAME_LEN];
                let mut frame = request.encode(noise.next() as u16, &mut out).unwrap().to_vec();
                for _ in 0..1 + noise.next() % 3 {
                    let at = noise.next() as usize % frame.len();
                    match noise.next() % 4 {
                        0 => frame[at] ^= 1 << (noise.next() % 8),
                        1 => frame[at] = noise.next() as u8,
                        2 => frame.truncate(at.max(1)),
                        _ => frame.insert(at, noise.next() as u8),
                    }
                }
                chunk.extend(frame);
            }
        }
        sent += chunk.len();
        session.controller.host_write(&chunk);
        // The serial line takes 5 us a byte; USB is faster.
        let ns = if variant == Variant::F330 { 5_100 * chunk.len() as u64 } else { 2_000_000 };
        session.run_for(ns);
        session.drop_replies();
        session.events.clear();
    }
    session.run_for(100_000_000);
    session.drop_replies();
    let edges = session.take_edges();
    let lit =
        edges.iter().filter(|e| e.high && stspp_hil_mcu::measure::timing::is_light(e.line)).count();
    assert_eq!(lit, 0, "{variant:?}: light from noise");
    assert_eq!(
        session.controller.chip().resets().len(),
        1,
        "{variant:?}: {:?}",
        session.controller.chip().resets()
    );
    // The decoder may be in the middle of a frame: a delimiter ends it.
    session.controller.host_write(&[0]);
    session.run_for(5_000_000);
    session.drop_replies();
    let Reply::GetStatus(status) =
        session.hello().and_then(|_| session.call(Request::GetStatus(GetStatus))).unwrap()
    else {
        panic!("the reply to GetStatus is another");
    };
    println!("{variant:?}: {sent} bytes sent, {:?}", status.link);
    assert!(status.link.frames_rejected > 1_000);
    common::assert_all_modelled(&mut session);
}

#[test]
fn a_million_bytes_of_noise_f330() {
    a_million_bytes_of_noise(Variant::F330);
}

#[test]
fn a_million_bytes_of_noise_f350() {
    a_million_bytes_of_noise(Variant::F350);
}

/// What is refused changes nothing, and makes no light.
#[test]
fn requests_beyond_the_limits_are_refused_in_the_dark() {
    for variant in common::BOARDS {
        let Some(mut session) = common::session(variant) else { continue };
        let timing = short();
        assert!(matches!(
            session.call(Request::Arm(Arm)),
            Err(CallError::Refused(RequestError::NoSession))
        ));
        session.hello().unwrap();
        assert!(matches!(
            session.call(Request::StartStream(StartStream)),
            Err(CallError::Refused(RequestError::WrongState { .. }))
        ));
        session.call(Request::SetTiming(SetTiming { timing: timing.clone() })).unwrap();
        let too_long =
            ProjectionTiming { exposure_us: 41_000, frame_period_us: 60_000, ..timing.clone() };
        let one_slot = ProjectionTiming {
            slots: [Slot::projector(0)].into_iter().collect(),
            ..timing.clone()
        };
        let crowd = ProjectionTiming {
            slots: [Slot { projector_mask: 0x3ff, floodlight: false }, Slot::dark()]
                .into_iter()
                .collect(),
            ..timing.clone()
        };
        for bad in [too_long, one_slot, crowd] {
            let refused = session.call(Request::SetTiming(SetTiming { timing: bad }));
            assert!(
                matches!(refused, Err(CallError::Refused(RequestError::Timing(_)))),
                "{variant:?}: {refused:?}"
            );
        }
        let Reply::GetTiming(active) = session.call(Request::GetTiming(GetTiming)).unwrap() else {
            panic!()
        };
        assert_eq!(active.timing, timing);
        session.take_edges();
        // The floodlight, again and again: the duty budget ends it.
        session.call(Request::Arm(Arm)).unwrap();
        let mut spent = None;
        for round in 0..40 {
            match session.call(Request::FloodlightOn(FloodlightOn { duration_us: 500_000 })) {
                Ok(_) => session.run_for(510_000_000),
                Err(CallError::Refused(RequestError::DutyBudget { .. })) => {
                    spent = Some(round);
                    break;
                }
                Err(other) => panic!("{variant:?}: {other}"),
            }
        }
        let spent =
            spent.unwrap_or_else(|| panic!("{variant:?}: the floodlight was never refused"));
        println!("{variant:?}: the floodlight's budget was spent after {spent} pulses of 0.5 s");
    }
}

#[test]
fn two_hosts_versions_are_told_apart() {
    let Some(mut session) = common::session(Variant::F330) else { return };
    let newer =
        stspp_protocol::version::ProtocolVersion { major: PROTOCOL_VERSION.major + 1, minor: 0 };
    let refused = Session::hello_as(&mut session, newer);
    let arm = session.call(Request::Arm(Arm));
    assert!(
        refused.is_err()
            || matches!(arm, Err(CallError::Refused(RequestError::VersionMismatch { .. }))),
        "{refused:?} {arm:?}"
    );
}
