//! The state machine over an engine that misbehaves, which the simulated one never does.

mod common;

use common::{Asked, Bench, MockFlash, slot};
use stspp_firmware_logic::controller::{Boot, FLOODLIGHT_MARGIN_US};
use stspp_firmware_logic::hardware::{Aborted, SlotDone, SystemAction};
use stspp_firmware_logic::outbox::OUTBOX_LEN;
use stspp_firmware_logic::sequencer::SUPERVISION_MARGIN_US;
use stspp_firmware_logic::timing::GateWord;
use stspp_protocol::fault::{FaultReason, FaultSet};
use stspp_protocol::message::Event;
use stspp_protocol::reply::{DeviceState, RequestError, StorageError};
use stspp_protocol::request::*;
use stspp_protocol::timing::{ProjectionTiming, Slot};
use stspp_protocol::version::{PROTOCOL_VERSION, ResetCause};

/// The one fault in `events`, with its value and limit.
fn the_fault(events: &[Event]) -> (FaultReason, i32, i32) {
    let faults: Vec<_> = events
        .iter()
        .filter_map(|event| match event {
            Event::FaultEvent(fault) => Some(fault.record),
            _ => None,
        })
        .collect();
    assert_eq!(faults.len(), 1, "{events:?}");
    (faults[0].reason, faults[0].value, faults[0].limit)
}

#[test]
fn comes_up_dark_with_a_plan_loaded() {
    let bench = Bench::new();
    assert_eq!(bench.logic.engine().asked, [Asked::ForceOff, Asked::Load(1)]);
    assert_eq!(bench.logic.state(), DeviceState::Idle);
    assert_eq!(bench.logic.next_deadline_us(), None);
}

#[test]
fn comes_up_faulted_with_what_it_carries() {
    let carried = FaultSet::from_iter([FaultReason::Panic, FaultReason::Interlock]);
    let boot = Boot { cause: ResetCause::Watchdog, carried };
    let mut bench = Bench::booted(boot, MockFlash::default());
    assert_eq!(bench.logic.state(), DeviceState::Faulted);
    bench.call(&Hello { host: PROTOCOL_VERSION }).unwrap();
    assert_eq!(bench.call(&Arm), Err(RequestError::Faulted { latched: carried }));
    let report = bench.call(&GetFaults).unwrap();
    assert_eq!((report.latched, report.active), (carried, FaultSet::EMPTY));
    assert!(bench.call(&ClearFaults).unwrap().latched.is_empty());
    bench.call(&Arm).unwrap();
}

#[test]
fn a_slot_out_of_order_is_a_fault() {
    for wrong in [0, 2, 3] {
        let mut bench = Bench::armed();
        bench.call(&StartStream).unwrap();
        bench.done(slot(0));
        bench.events();
        bench.done(slot(wrong));
        let events = bench.events();
        assert_eq!(the_fault(&events), (FaultReason::Engine, wrong as i32, 1));
        assert_eq!(bench.logic.state(), DeviceState::Faulted);
        assert_eq!(bench.logic.engine().asked.last(), Some(&Asked::ForceOff));
        let labelled = events.iter().any(|event| matches!(event, Event::TriggerEvent(_)));
        assert!(!labelled, "no label rather than a wrong one");
    }
}

#[test]
fn too_many_projectors_or_too_long_a_time_are_faults() {
    let four = GateWord::from_slot(Slot { projector_mask: 0xF, floodlight: false });
    for (done, fault) in [
        (SlotDone { gates: four, ..slot(0) }, (FaultReason::Engine, 4, 3)),
        (SlotDone { on_time_us: 40_001, ..slot(0) }, (FaultReason::OnTime, 40_001, 40_000)),
    ] {
        let mut bench = Bench::armed();
        bench.call(&StartStream).unwrap();
        bench.events();
        bench.done(done);
        assert_eq!(the_fault(&bench.events()), fault);
    }
}

#[test]
fn a_slot_that_does_not_come_is_a_fault_at_its_deadline() {
    let mut bench = Bench::armed();
    bench.logic.engine_mut().start_us = 50;
    bench.call(&StartStream).unwrap();
    bench.events();
    let deadline_us = 50 + 33_333 + SUPERVISION_MARGIN_US;
    assert_eq!(bench.logic.next_deadline_us(), Some(deadline_us));
    bench.poll_at(deadline_us - 1);
    assert_eq!(bench.logic.state(), DeviceState::Running);
    bench.poll_at(deadline_us);
    assert_eq!(the_fault(&bench.events()), (FaultReason::Engine, 0, 1));
}

/// An engine that lights one projector all the time runs its bucket over.
#[test]
fn an_overdrawn_bucket_is_a_fault() {
    let mut bench = Bench::armed();
    bench.call(&StartStream).unwrap();
    let always = GateWord::from_slot(Slot::projector(3));
    let mut number = 0;
    while bench.logic.state() == DeviceState::Running {
        bench.call(&Heartbeat).unwrap();
        bench.events();
        bench.done(SlotDone { gates: always, ..slot(number) });
        number += 1;
        assert!(number < 100);
    }
    let (reason, level_us, capacity_us) = the_fault(&bench.events());
    assert_eq!(reason, FaultReason::Duty);
    assert_eq!(capacity_us, 2_097_120 * 4 / 10);
    assert!(level_us > capacity_us && level_us < capacity_us + 32_100);
}

#[test]
fn a_floodlight_that_does_not_go_off_is_a_fault() {
    let mut bench = Bench::armed();
    bench.call(&FloodlightOn { duration_us: 1_000 }).unwrap();
    assert_eq!(bench.logic.engine().asked.last(), Some(&Asked::Floodlight(1_000)));
    bench.logic.engine_mut().floodlight_stuck = true;
    let late_us = 1_000 + FLOODLIGHT_MARGIN_US;
    assert_eq!(bench.logic.next_deadline_us(), Some(late_us));
    bench.poll_at(late_us - 1);
    assert_eq!(bench.logic.state(), DeviceState::Armed);
    bench.poll_at(late_us);
    assert_eq!(the_fault(&bench.events()), (FaultReason::OnTime, late_us as i32, 1_000));
    assert_eq!(bench.logic.engine().asked.last(), Some(&Asked::ForceOff));
}

#[test]
fn the_heartbeat_deadline_is_exact() {
    let mut bench = Bench::new();
    bench.now_us = 5_000;
    bench.call(&Hello { host: PROTOCOL_VERSION }).unwrap();
    bench.call(&Arm).unwrap();
    assert_eq!(bench.logic.next_deadline_us(), Some(1_005_000));
    bench.poll_at(1_004_999);
    assert_eq!(bench.logic.state(), DeviceState::Armed);
    bench.call(&GetStatus).unwrap();
    bench.poll_at(2_004_998);
    assert_eq!(bench.logic.state(), DeviceState::Armed);
    bench.events();
    bench.poll_at(2_004_999);
    assert_eq!(the_fault(&bench.events()), (FaultReason::HeartbeatLost, 1_000_000, 1_000_000));
}

/// A request that arrives together with the deadline comes too late.
#[test]
fn time_outs_come_before_requests() {
    let mut bench = Bench::armed();
    bench.now_us = 1_000_000;
    let latched = FaultSet::from_iter([FaultReason::HeartbeatLost]);
    assert_eq!(bench.call(&StartStream).unwrap_err(), RequestError::Faulted { latched });
}

#[test]
fn a_full_outbox_drops_triggers_and_shows_the_gap() {
    let mut bench = Bench::armed();
    bench.call(&StartStream).unwrap();
    let seq = bench.numbered_events().last().unwrap().0;
    for number in 0..OUTBOX_LEN as u32 + 5 {
        bench.call(&Heartbeat).unwrap();
        bench.done(slot(number));
    }
    assert_eq!(bench.call(&GetStatus).unwrap().events_dropped, 5);
    let seqs: Vec<u16> = bench.numbered_events().iter().map(|(seq, _)| *seq).collect();
    assert_eq!(seqs, (seq + 1..=seq + OUTBOX_LEN as u16).collect::<Vec<_>>());
    let next = seq + OUTBOX_LEN as u16 + 6;
    for number in 0..OUTBOX_LEN as u32 {
        bench.call(&Heartbeat).unwrap();
        bench.done(slot(OUTBOX_LEN as u32 + 5 + number));
    }
    // The change of state gets through; the oldest trigger makes room.
    bench.call(&Disarm).unwrap();
    let events = bench.numbered_events();
    assert_eq!(events[0].0, next + 1);
    assert!(matches!(events.last(), Some((_, Event::StateEvent(_)))));
    assert_eq!(bench.call(&GetStatus).unwrap().events_dropped, 6);
}

/// Reports that come after the outputs were forced off still label their frames.
#[test]
fn reports_after_the_end_are_not_lost() {
    let mut bench = Bench::armed();
    bench.call(&StartStream).unwrap();
    bench.done(slot(0));
    bench.logic.engine_mut().aborted =
        Aborted { slots_triggered: 3, gates: slot(2).gates, on_time_us: 10 };
    bench.logic.on_interlock(bench.now_us, false);
    bench.events();
    bench.done(slot(1));
    let events = bench.events();
    let [Event::TriggerEvent(trigger)] = events[..] else { panic!("{events:?}") };
    assert_eq!((trigger.frame_sequence, trigger.slot_index), (1, 1));
    // The third trigger was cut short; it has its number.
    assert_eq!(bench.call(&GetStatus).unwrap().next_frame_sequence, 3);
    assert_eq!(bench.logic.state(), DeviceState::Faulted);
}

#[test]
fn a_stop_that_finds_nothing_under_way_ends_the_run_at_once() {
    let mut bench = Bench::armed();
    bench.call(&StartStream).unwrap();
    bench.done(slot(0));
    bench.logic.engine_mut().stops_after = 1;
    assert_eq!(bench.call(&StopStream).unwrap().end_frame_sequence, 1);
    assert_eq!(bench.logic.state(), DeviceState::Armed);
    // Asking twice is no harm.
    assert_eq!(bench.call(&StopStream).unwrap().end_frame_sequence, 1);
    assert_eq!(bench.logic.engine().asked.iter().filter(|&a| *a == Asked::Stop).count(), 1);
}

#[test]
fn a_burst_ends_with_its_last_slot() {
    let mut bench = Bench::armed();
    bench.call(&StartBurst { frames: 2 }).unwrap();
    assert_eq!(bench.logic.engine().asked.last(), Some(&Asked::Start(Some(2))));
    bench.done(slot(0));
    assert_eq!(bench.logic.state(), DeviceState::Running);
    bench.done(slot(1));
    assert_eq!(bench.logic.state(), DeviceState::Armed);
    assert!(bench.logic.next_deadline_us().is_some(), "the heartbeat's");
}

#[test]
fn reset_and_bootloader_go_dark_and_wait_for_the_reply() {
    for (request_is_reset, action) in
        [(true, SystemAction::Reset), (false, SystemAction::Bootloader)]
    {
        let mut bench = Bench::armed();
        bench.call(&StartStream).unwrap();
        assert_eq!(bench.logic.take_action(), None);
        if request_is_reset {
            bench.call(&Reset).unwrap();
        } else {
            bench.call(&RebootToBootloader { key: BOOTLOADER_KEY }).unwrap();
        }
        assert_eq!(bench.logic.engine().asked.last(), Some(&Asked::ForceOff));
        assert_eq!(bench.logic.state(), DeviceState::Idle);
        assert_eq!(bench.logic.take_action(), Some(action));
        assert_eq!(bench.logic.take_action(), None);
    }
}

#[test]
fn settings_that_cannot_be_had_are_named() {
    let refusing = MockFlash { refuse_reads: true, ..MockFlash::default() };
    let boot = Boot { cause: ResetCause::PowerOn, carried: FaultSet::EMPTY };
    let mut bench = Bench::booted(boot, refusing);
    bench.call(&Hello { host: PROTOCOL_VERSION }).unwrap();
    let storage = |error| RequestError::Storage(error);
    assert_eq!(bench.call(&LoadSettings).unwrap_err(), storage(StorageError::Read));
    assert_eq!(bench.call(&GetTiming).unwrap().timing, ProjectionTiming::default());

    let refusing = MockFlash { refuse_writes: true, ..MockFlash::default() };
    let mut bench = Bench::booted(boot, refusing);
    bench.call(&Hello { host: PROTOCOL_VERSION }).unwrap();
    assert_eq!(bench.call(&SaveSettings).unwrap_err(), storage(StorageError::Write));
    assert_eq!(bench.call(&LoadSettings).unwrap_err(), storage(StorageError::Empty));
}

#[test]
fn overruns_are_counted() {
    let mut bench = Bench::new();
    bench.logic.on_overrun(3);
    bench.logic.on_overrun(4);
    assert_eq!(bench.call(&GetStatus).unwrap().link.bytes_overrun, 7);
}

#[test]
fn a_lost_link_forgets_half_a_frame() {
    let mut bench = Bench::new();
    let mut out = [0; stspp_protocol::wire::MAX_FRAME_LEN];
    assert_eq!(bench.logic.receive(0, &mut &[5, 1, 2][..], &mut out), None);
    bench.logic.on_link_lost(1);
    bench.logic.on_link_up(2);
    bench.call(&Hello { host: PROTOCOL_VERSION }).unwrap();
    assert_eq!(bench.call(&GetStatus).unwrap().link.frames_rejected, 0);
}

#[test]
fn faults_of_the_board_latch() {
    for reason in [FaultReason::DebugHalt, FaultReason::HardFault, FaultReason::LinkLost] {
        let mut bench = Bench::armed();
        bench.call(&StartStream).unwrap();
        bench.logic.on_fault(9, reason, 1, 2);
        assert_eq!(bench.logic.latched(), FaultSet::from_iter([reason]));
        assert_eq!(bench.logic.state(), DeviceState::Faulted);
        // The same again is the same fault.
        let events = bench.events().len();
        bench.logic.on_fault(10, reason, 1, 2);
        assert!(bench.events().is_empty() && events > 0);
    }
}

/// Device time never goes back, whatever the owner passes.
#[test]
fn time_is_monotonic() {
    let mut bench = Bench::new();
    bench.poll_at(1_000);
    bench.logic.poll(500);
    bench.now_us = 400;
    assert_eq!(bench.call(&Heartbeat).unwrap().device_time_us, 1_000);
}
