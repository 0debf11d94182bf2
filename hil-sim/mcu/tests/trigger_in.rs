//! Trigger-in of the real binary: each edge starts a slot, to the tick, and nothing else does.

mod common;

use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::measure::timing::{is_light, is_projector, pulses};
use stspp_hil_mcu::session::{CallError, Session};
use stspp_hil_mcu::soc::Variant;
use stspp_hil_sim::device::{Controller, Line};
use stspp_protocol::fault::FaultReason;
use stspp_protocol::message::{Event, Reply, Request};
use stspp_protocol::reply::{DeviceState, RequestError};
use stspp_protocol::request::{
    Arm, Disarm, GetStatus, GetTriggerSource, Heartbeat, SetTiming, SetTriggerSource, StartBurst,
    StartStream, StopStream,
};
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::trigger::{ExternalTrigger, TriggerEdge, TriggerInput, TriggerSource};

/// A tick of the gate timer, plus what the interrupt and the DMA take.
const TICK_NS: u64 = 1_000 + 500;

fn timing() -> ProjectionTiming {
    ProjectionTiming {
        frame_period_us: 2_000,
        exposure_us: 1_500,
        trigger_delay_us: 20,
        gate_lead_us: 10,
        gate_lag_us: 10,
        ..ProjectionTiming::default()
    }
}

fn ready(variant: Variant, edge: TriggerEdge, delay_us: u32) -> Option<Session<McuController>> {
    let mut session = common::session(variant)?;
    session.hello().unwrap();
    session.call(Request::SetTiming(SetTiming { timing: timing() })).unwrap();
    let source = TriggerSource::External(ExternalTrigger { edge, delay_us });
    session.call(Request::SetTriggerSource(SetTriggerSource { source })).unwrap();
    session.call(Request::Arm(Arm)).unwrap();
    session.take_edges();
    session.take_events();
    Some(session)
}

/// A pulse of 20 us at trigger-in; the times of its edges.
fn pulse(session: &mut Session<McuController>) -> (u64, u64) {
    let rise_ns = session.controller.now_ns();
    session.controller.set_trigger_in(true);
    session.run_for(20_000);
    let fall_ns = session.controller.now_ns();
    session.controller.set_trigger_in(false);
    (rise_ns, fall_ns)
}

fn input(session: &mut Session<McuController>) -> TriggerInput {
    match session.call(Request::GetTriggerSource(GetTriggerSource)).unwrap() {
        Reply::GetTriggerSource(input) => input,
        other => panic!("the reply to GetTriggerSource is {other:?}"),
    }
}

fn state(session: &mut Session<McuController>) -> DeviceState {
    match session.call(Request::GetStatus(GetStatus)).unwrap() {
        Reply::GetStatus(status) => status.state,
        other => panic!("the reply to GetStatus is {other:?}"),
    }
}

#[test]
fn every_edge_starts_a_slot_to_the_tick() {
    for variant in common::BOARDS {
        for (edge, delay_us) in [(TriggerEdge::Rising, 60), (TriggerEdge::Falling, 443)] {
            let Some(mut session) = ready(variant, edge, delay_us) else { continue };
            session.call(Request::StartStream(StartStream)).unwrap();
            session.run_for(50_000_000);
            assert!(session.take_edges().is_empty(), "{variant:?}: light without an edge");
            let mut expected_ns = Vec::new();
            for n in 0..60u64 {
                let (rise_ns, fall_ns) = pulse(&mut session);
                expected_ns.push(if edge == TriggerEdge::Rising { rise_ns } else { fall_ns });
                // Irregular, and no round number of ticks.
                session.run_for(2_100_000 + n * n * 1_337);
                session.send(&Request::Heartbeat(Heartbeat));
            }
            session.run_for(5_000_000);
            session.drop_replies();
            let edges = session.take_edges();
            let triggers = pulses(&edges, |line| line == Line::CameraTrigger(0));
            let gates = pulses(&edges, is_projector);
            assert_eq!((triggers.len(), gates.len()), (60, 60), "{variant:?}");
            let offset_ns = u64::from(delay_us + 20) * 1_000;
            let late_ns: Vec<i64> = triggers
                .iter()
                .zip(&expected_ns)
                .map(|(t, edge_ns)| t.rise_ns as i64 - (edge_ns + offset_ns) as i64)
                .collect();
            let (least, most) = (late_ns.iter().min().unwrap(), late_ns.iter().max().unwrap());
            println!(
                "{variant:?}, {edge:?} edge: trigger-in to exposure {delay_us} + 20 us {least:+}..={most:+} ns"
            );
            assert!((most - least) as u64 <= TICK_NS && least.unsigned_abs() <= TICK_NS);
            for (n, (gate, trigger)) in gates.iter().zip(&triggers).enumerate() {
                assert_eq!(gate.line, Line::Projector((n % 10) as u8));
                assert!(gate.rise_ns < trigger.rise_ns && trigger.fall_ns < gate.fall_ns);
            }
            let labels: Vec<u32> = session
                .take_events()
                .into_iter()
                .filter_map(|e| match e.event {
                    Event::TriggerEvent(t) => Some(t.frame_sequence),
                    _ => None,
                })
                .collect();
            assert_eq!(labels, (0..60).collect::<Vec<_>>());
            let counted = input(&mut session);
            assert_eq!((counted.edges_taken, counted.edges_ignored), (60, 0));
            session.call(Request::StopStream(StopStream)).unwrap();
            assert_eq!(state(&mut session), DeviceState::Armed, "{variant:?}");
            pulse(&mut session);
            session.run_for(20_000_000);
            assert!(session.take_edges().is_empty(), "{variant:?}: light after the end");
            common::assert_all_modelled(&mut session);
        }
    }
}

#[test]
fn edges_too_soon_are_ignored_and_a_burst_ends() {
    for variant in common::BOARDS {
        let Some(mut session) = ready(variant, TriggerEdge::Rising, 100) else { continue };
        session.call(Request::StartBurst(StartBurst { frames: 5 })).unwrap();
        // Every third edge is due: the period is 2 ms.
        for _ in 0..18 {
            pulse(&mut session);
            session.run_for(730_000);
        }
        session.run_for(5_000_000);
        let gates = pulses(&session.take_edges(), is_projector);
        assert_eq!(gates.len(), 5, "{variant:?}");
        for pair in gates.windows(2) {
            assert!(pair[1].rise_ns - pair[0].rise_ns >= 2_000_000, "{variant:?}: {pair:?}");
        }
        assert_eq!(state(&mut session), DeviceState::Armed);
        let counted = input(&mut session);
        assert_eq!(counted.edges_taken, 5);
        assert!((8..=10).contains(&counted.edges_ignored), "{variant:?}: {counted:?}");
        // A new session knows nothing of it.
        session.hello().unwrap();
        assert_eq!(input(&mut session).source, TriggerSource::FreeRunning);
    }
}

#[test]
fn an_input_gone_wild_changes_nothing_but_its_slots() {
    for variant in common::BOARDS {
        let Some(mut session) = ready(variant, TriggerEdge::Rising, 60) else { continue };
        // At rest, the pin is not listened to.
        for _ in 0..1_000 {
            session.controller.set_trigger_in(true);
            session.run_for(500);
            session.controller.set_trigger_in(false);
            session.run_for(500);
        }
        session.call(Request::StartStream(StartStream)).unwrap();
        let start_ns = session.controller.now_ns();
        let mut slowest_ns = 0;
        for n in 0..60_000u32 {
            session.controller.set_trigger_in(n % 2 == 0);
            session.run_for(1_000);
            if n % 6_000 == 0 {
                session.call(Request::Heartbeat(Heartbeat)).unwrap();
                slowest_ns = slowest_ns.max(session.last_call_ns);
            }
        }
        let span_ns = session.controller.now_ns() - start_ns;
        let gates = pulses(&session.take_edges(), is_projector);
        println!(
            "{variant:?}: 500 kHz at trigger-in for {} ms: {} slots, slowest reply {} us",
            span_ns / 1_000_000,
            gates.len(),
            slowest_ns / 1_000
        );
        assert!(gates.len() as u64 <= span_ns / 2_000_000 + 1, "more slots than the period lets");
        assert!(!gates.is_empty());
        assert!(slowest_ns < 3_000_000, "{variant:?}: {slowest_ns} ns");
        for pair in gates.windows(2) {
            assert!(pair[1].rise_ns - pair[0].rise_ns >= 2_000_000 - 100);
        }
        // The interlock shares the vector with trigger-in, and goes first.
        while !session.controller.light_is_on() {
            session.controller.set_trigger_in(true);
            session.run_for(1_000);
            session.controller.set_trigger_in(false);
            session.run_for(1_000);
        }
        session.run_for(100_000);
        session.take_edges();
        let open_ns = session.controller.now_ns();
        session.controller.set_trigger_in(true);
        session.controller.set_interlock_closed(false);
        session.run_for(1_000_000);
        let fall_ns =
            session.take_edges().iter().filter(|e| is_light(e.line)).map(|e| e.time_ns).max();
        let dark_ns = fall_ns.expect("it went dark") - open_ns;
        println!("{variant:?}: interlock and trigger-in at once: dark after {dark_ns} ns");
        assert!(dark_ns <= 10_000);
        session.run_for(10_000_000);
        assert!(!session.controller.light_is_on());
        let faults: Vec<_> = session
            .take_events()
            .into_iter()
            .filter_map(|e| match e.event {
                Event::FaultEvent(fault) => Some(fault.record.reason),
                _ => None,
            })
            .collect();
        assert_eq!(faults, [FaultReason::Interlock], "{variant:?}");
    }
}

#[test]
fn the_source_is_chosen_at_rest_and_within_its_range() {
    let Some(mut session) = ready(Variant::F330, TriggerEdge::Rising, 60) else { return };
    for delay_us in [0, 59, 901, u32::MAX] {
        let external = ExternalTrigger { edge: TriggerEdge::Rising, delay_us };
        let source = TriggerSource::External(external);
        let refused = session.call(Request::SetTriggerSource(SetTriggerSource { source }));
        assert!(matches!(refused, Err(CallError::Refused(RequestError::OutOfRange { .. }))));
    }
    session.call(Request::StartStream(StartStream)).unwrap();
    let free = SetTriggerSource { source: TriggerSource::FreeRunning };
    let refused = session.call(Request::SetTriggerSource(free));
    assert!(matches!(refused, Err(CallError::Refused(RequestError::WrongState { .. }))));
    session.call(Request::Disarm(Disarm)).unwrap();
    session.call(Request::SetTriggerSource(free)).unwrap();
    session.call(Request::Arm(Arm)).unwrap();
    session.call(Request::StartStream(StartStream)).unwrap();
    session.run_for(50_000_000);
    assert!(pulses(&session.take_edges(), is_projector).len() > 20, "free-running again");
}
