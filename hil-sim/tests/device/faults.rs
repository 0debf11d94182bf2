//! Each cause of a fault: light off within its bound, the reason latched, no light until armed again.

use stspp_hil_sim::device::Controller;
use stspp_hil_sim::device::in_process::{
    BOOT_NS, Injection, LINK_LATENCY_NS, SUSPEND_NS, WATCHDOG_NS,
};
use stspp_protocol::fault::{FaultReason, FaultSet};
use stspp_protocol::message::Event;
use stspp_protocol::reply::{DeviceState, RequestError};
use stspp_protocol::request::*;
use stspp_protocol::timing::Limits;
use stspp_protocol::version::{BoardKind, ResetCause};

use crate::host::{Host, MS, S};

const HEARTBEAT_NS: u64 = Limits::F350.heartbeat_timeout_us as u64 * 1_000;
/// A microsecond of the device's clock, to which its deadlines are rounded.
const TICK_NS: u64 = 1_000;

fn streaming(board: BoardKind) -> Host {
    let mut host = Host::on(board);
    host.hello().unwrap();
    host.call(&Arm).unwrap();
    host.call(&StartStream).unwrap();
    // In the middle of a slot's light.
    host.run(110 * MS);
    assert!(!host.high().is_empty());
    host
}

struct Case {
    name: &'static str,
    board: BoardKind,
    cause: fn(&mut Host),
    cure: fn(&mut Host),
    reason: FaultReason,
    bound_ns: u64,
    /// Whether the bound counts from the last request, not from the cause.
    since_last_request: bool,
    resets: bool,
}

const CASES: [Case; 9] = [
    Case {
        name: "interlock opens",
        board: BoardKind::F350,
        cause: |host| host.device.set_interlock_closed(false),
        cure: |host| host.device.set_interlock_closed(true),
        reason: FaultReason::Interlock,
        bound_ns: 10_000,
        since_last_request: false,
        resets: false,
    },
    Case {
        name: "too hot",
        board: BoardKind::F350,
        cause: |host| host.device.set_temperature_c(70.1),
        cure: |host| host.device.set_temperature_c(60.0),
        reason: FaultReason::OverTemperature,
        bound_ns: 10_000,
        since_last_request: false,
        resets: false,
    },
    Case {
        name: "temperature sensor open",
        board: BoardKind::F330,
        cause: |host| host.device.set_temperature_c(-80.0),
        cure: |host| host.device.set_temperature_c(20.0),
        reason: FaultReason::TemperatureSensor,
        bound_ns: 10_000,
        since_last_request: false,
        resets: false,
    },
    Case {
        name: "host silent",
        board: BoardKind::F350,
        cause: |_| {},
        cure: |_| {},
        reason: FaultReason::HeartbeatLost,
        bound_ns: HEARTBEAT_NS + LINK_LATENCY_NS + TICK_NS,
        since_last_request: true,
        resets: false,
    },
    Case {
        name: "cable pulled, USB",
        board: BoardKind::F350,
        cause: |host| host.device.set_link_connected(false),
        cure: |host| host.device.set_link_connected(true),
        reason: FaultReason::LinkLost,
        bound_ns: SUSPEND_NS,
        since_last_request: false,
        resets: false,
    },
    Case {
        name: "cable pulled, serial",
        board: BoardKind::F330,
        cause: |host| host.device.set_link_connected(false),
        cure: |host| host.device.set_link_connected(true),
        reason: FaultReason::HeartbeatLost,
        bound_ns: HEARTBEAT_NS + LINK_LATENCY_NS + TICK_NS,
        since_last_request: true,
        resets: false,
    },
    Case {
        name: "panic",
        board: BoardKind::F350,
        cause: |host| host.device.inject(Injection::Panic),
        cure: |_| {},
        reason: FaultReason::Panic,
        bound_ns: 10_000,
        since_last_request: false,
        resets: true,
    },
    Case {
        name: "hard fault",
        board: BoardKind::F350,
        cause: |host| host.device.inject(Injection::HardFault),
        cure: |_| {},
        reason: FaultReason::HardFault,
        bound_ns: 10_000,
        since_last_request: false,
        resets: true,
    },
    Case {
        name: "hang",
        board: BoardKind::F350,
        cause: |host| host.device.inject(Injection::Hang),
        cure: |_| {},
        reason: FaultReason::Watchdog,
        bound_ns: WATCHDOG_NS,
        since_last_request: false,
        resets: true,
    },
];

#[test]
fn each_cause_ends_the_light_and_latches() {
    for case in &CASES {
        let name = case.name;
        let mut host = streaming(case.board);
        let since = if case.since_last_request {
            host.call(&Heartbeat).unwrap();
            host.now() - 2 * LINK_LATENCY_NS
        } else {
            host.now()
        };
        (case.cause)(&mut host);
        host.run(2 * S);
        assert!(host.high().is_empty(), "{name}");
        let took_ns = host.last_fall_ns() - since;
        assert!(took_ns <= case.bound_ns, "{name}: {took_ns} ns");

        (case.cure)(&mut host);
        host.run(BOOT_NS + MS);
        let edges = host.edges.len();
        // Latched, whether or not the controller went through a reset: no arming.
        host.hello().unwrap();
        let latched = FaultSet::from_iter([case.reason]);
        assert_eq!(host.call(&GetStatus).unwrap().latched, latched, "{name}");
        assert_eq!(host.call(&Arm), Err(RequestError::Faulted { latched }), "{name}");
        assert_eq!(host.call(&StartStream).map(|_| ()), Err(RequestError::Faulted { latched }));
        let first = host.call(&GetFaults).unwrap().first.expect(name);
        assert_eq!(first.reason, case.reason, "{name}");
        assert_eq!(host.call(&GetInfo).unwrap().latched, latched);
        // Clearing alone brings no light, and allows none.
        assert!(host.call(&ClearFaults).unwrap().latched.is_empty(), "{name}");
        assert_eq!(host.device.state(), Some(DeviceState::Idle));
        assert!(host.call(&StartStream).is_err());
        host.run(100 * MS);
        assert_eq!(host.edges.len(), edges, "{name}: dark all along");
        // A reset leaves the buckets full: they need their rest.
        host.run(2 * S);
        host.call(&Arm).unwrap();
        host.call(&StartStream).unwrap();
        host.run(100 * MS);
        assert!(host.edges.len() > edges, "{name}");
        let boots = host.events.iter().filter(|event| matches!(event, Event::BootEvent(_))).count();
        assert_eq!(boots, 1 + usize::from(case.resets), "{name}");
        if !case.resets && case.reason != FaultReason::LinkLost && case.board == BoardKind::F350 {
            assert_eq!(host.faults()[0].record.reason, case.reason, "{name}");
        }
    }
}

#[test]
fn a_fault_that_persists_cannot_be_cleared() {
    let mut host = streaming(BoardKind::F350);
    host.device.set_interlock_closed(false);
    host.device.set_temperature_c(90.0);
    host.run(MS);
    host.call(&ClearFaults).unwrap();
    let report = host.call(&GetFaults).unwrap();
    assert_eq!(
        report.latched,
        FaultSet::from_iter([FaultReason::Interlock, FaultReason::OverTemperature])
    );
    assert_eq!(report.active, report.latched);
    assert_eq!(report.first.unwrap().reason, FaultReason::Interlock);
    assert_eq!(report.last.unwrap().reason, FaultReason::OverTemperature);
    assert_eq!(report.last.unwrap().value, 900);
    // Cooler, but not by the hysteresis.
    host.device.set_temperature_c(68.0);
    host.device.set_interlock_closed(true);
    let report = host.call(&ClearFaults).unwrap();
    assert_eq!(report.latched, FaultSet::from_iter([FaultReason::OverTemperature]));
    assert_eq!(report.first.unwrap().reason, FaultReason::OverTemperature);
    host.device.set_temperature_c(65.0);
    assert!(host.call(&ClearFaults).unwrap().latched.is_empty());
    host.call(&Arm).unwrap();
}

#[test]
fn an_open_interlock_at_rest_is_no_fault_but_no_arming() {
    let mut host = Host::connected();
    host.device.set_interlock_closed(false);
    host.run(MS);
    assert!(host.call(&GetFaults).unwrap().latched.is_empty());
    assert!(!host.call(&GetStatus).unwrap().interlock_closed);
    assert_eq!(host.call(&Arm), Err(RequestError::InterlockOpen));
    host.device.set_interlock_closed(true);
    host.call(&Arm).unwrap();
}

#[test]
fn heat_latches_at_rest_too() {
    let mut host = Host::connected();
    host.device.set_temperature_c(80.0);
    host.run(MS);
    host.device.set_temperature_c(25.0);
    let latched = FaultSet::from_iter([FaultReason::OverTemperature]);
    assert_eq!(host.call(&Arm), Err(RequestError::Faulted { latched }));
}

#[test]
fn any_request_is_a_heartbeat_and_noise_is_none() {
    let mut host = Host::armed();
    for _ in 0..5 {
        host.run(900 * MS);
        host.call(&GetStatus).unwrap();
    }
    assert_eq!(host.device.state(), Some(DeviceState::Armed));
    for _ in 0..12 {
        host.send_raw(&[0xA5, 0x5A, 0]);
        host.run(100 * MS);
    }
    assert_eq!(host.device.state(), Some(DeviceState::Faulted));
    assert_eq!(host.faults()[0].record.limit, 1_000_000);
}

#[test]
fn a_stalled_engine_is_found() {
    let mut host = streaming(BoardKind::F350);
    host.device.inject(Injection::EngineStall);
    host.run_alive(200 * MS);
    assert!(host.high().is_empty());
    assert_eq!(host.faults()[0].record.reason, FaultReason::Engine);
}

/// Reset and power cycle: what survives, and what must not be got around.
#[test]
fn what_a_reset_keeps() {
    let mut host = streaming(BoardKind::F350);
    host.device.set_interlock_closed(false);
    host.run(MS);
    host.device.set_interlock_closed(true);
    host.call(&Reset).unwrap();
    host.run(10 * MS);
    let info = host.hello().unwrap();
    assert_eq!(info.reset_cause, ResetCause::Software);
    assert_eq!(info.latched, FaultSet::from_iter([FaultReason::Interlock]));
    assert!(host.call(&GetStatus).unwrap().device_time_us < 10_000, "device time starts again");
    host.call(&ClearFaults).unwrap();
    host.call(&Arm).unwrap();
    // The duty before the reset is unknown to the firmware, so the emitters must rest.
    let Err(RequestError::DutyBudget { retry_after_us, .. }) = host.call(&StartStream) else {
        panic!("started");
    };
    host.run_alive(u64::from(retry_after_us) * 1_000);
    host.call(&StartStream).unwrap();

    host.device.inject(Injection::PowerCycle);
    host.run(10 * MS);
    assert!(host.high().is_empty());
    let info = host.hello().unwrap();
    assert_eq!((info.reset_cause, info.latched), (ResetCause::PowerOn, FaultSet::EMPTY));
    host.call(&Arm).unwrap();
    host.call(&StartStream).unwrap();
}

#[test]
fn a_new_host_finds_the_device_dark() {
    let mut host = streaming(BoardKind::F350);
    let at = host.now() + LINK_LATENCY_NS;
    host.hello().unwrap();
    assert_eq!(host.last_fall_ns(), at);
    assert!(host.high().is_empty());
    assert_eq!(host.device.state(), Some(DeviceState::Idle));
}

#[test]
fn a_pulled_cable_ends_the_session() {
    let mut host = Host::connected();
    host.device.set_link_connected(false);
    host.run(10 * MS);
    host.device.set_link_connected(true);
    assert!(!host.call(&GetStatus).unwrap().session);
    assert_eq!(host.call(&Arm), Err(RequestError::NoSession));
    // Bytes on the way when the cable was pulled are gone.
    host.send_raw(&[1, 2, 3]);
    host.device.set_link_connected(false);
    host.device.set_link_connected(true);
    host.hello().unwrap();
    assert_eq!(host.call(&GetStatus).unwrap().link.frames_rejected, 0);
}
