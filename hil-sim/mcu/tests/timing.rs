//! Gates and triggers of the real binary, in cycles of virtual time.

mod common;

use stspp_hil_mcu::controller::McuController;
use stspp_hil_mcu::measure::faults::light_up;
use stspp_hil_mcu::measure::timing::{Pulse, grid_deviation_ns, is_projector, pulses};
use stspp_hil_mcu::session::Session;
use stspp_hil_mcu::soc::Variant;
use stspp_hil_mcu::trace::{write_csv, write_vcd};
use stspp_hil_sim::device::{Controller, Line};
use stspp_protocol::message::{Event, Request};
use stspp_protocol::request::{GetStatus, GetTiming, Heartbeat};
use stspp_protocol::timing::{ProjectionTiming, Slot};

/// One tick of the gate timer.
const TICK_NS: u64 = 1_000;

/// What a DMA transfer for the link can delay an edge by.
const BUS_NS: u64 = 100;

/// 1 ms slots with the light switched off for 10 us between two of them.
fn fast() -> ProjectionTiming {
    ProjectionTiming {
        slots: (0..10).map(Slot::projector).collect(),
        frame_period_us: 1_000,
        exposure_us: 970,
        trigger_delay_us: 12,
        gate_lead_us: 10,
        gate_lag_us: 10,
    }
}

/// Runs for `ns` while the link is kept full of requests; returns how many were answered.
fn flood(session: &mut Session<McuController>, ns: u64) -> usize {
    let end = session.controller.now_ns() + ns;
    let mut answered = 0;
    let mut outstanding: Vec<u16> = Vec::new();
    let mut turn = 0u32;
    while session.controller.now_ns() < end {
        // A host that sends the next request before the last is answered, but does not overrun.
        while outstanding.len() < 4 {
            turn += 1;
            let request = match turn % 3 {
                0 => Request::GetStatus(GetStatus),
                1 => Request::GetTiming(GetTiming),
                _ => Request::Heartbeat(Heartbeat),
            };
            outstanding.push(session.send(&request));
        }
        session.run_for(150_000);
        outstanding.retain(|seq| match session.take_reply(*seq) {
            Some(reply) => {
                reply.expect("a query is never refused");
                answered += 1;
                false
            }
            None => true,
        });
    }
    session.run_for(20_000_000);
    answered + outstanding.into_iter().filter(|seq| session.take_reply(*seq).is_some()).count()
}

fn check_slots(gates: &[Pulse], triggers: &[Pulse], timing: &ProjectionTiming) {
    let period_ns = u64::from(timing.frame_period_us) * 1_000;
    let rises: Vec<u64> = gates.iter().map(|p| p.rise_ns).collect();
    let falls: Vec<u64> = gates.iter().map(|p| p.fall_ns).collect();
    let jitter_ns = grid_deviation_ns(&rises, period_ns).max(grid_deviation_ns(&falls, period_ns));
    println!("{} slots, largest deviation of an edge from its grid {jitter_ns} ns", gates.len());
    assert!(jitter_ns <= TICK_NS, "edges deviate by {jitter_ns} ns");
    for (n, pair) in gates.windows(2).enumerate() {
        assert!(pair[1].rise_ns >= pair[0].fall_ns, "slots {n} and {} overlap: {pair:?}", n + 1);
    }
    let dead_ns: Vec<u64> =
        gates.windows(2).map(|pair| pair[1].rise_ns - pair[0].fall_ns).collect();
    println!("gate off to next gate on {:?}..={:?} ns", dead_ns.iter().min(), dead_ns.iter().max());
    for dead_ns in dead_ns {
        assert!(
            dead_ns.abs_diff(u64::from(timing.dead_time_us()) * 1_000) <= TICK_NS,
            "{dead_ns} ns between gates"
        );
    }
    let (lead_ns, exposure_ns) =
        (u64::from(timing.gate_lead_us) * 1_000, u64::from(timing.exposure_us) * 1_000);
    for (gate, trigger) in gates.iter().zip(triggers) {
        // Both edges are made by the same chain: only another DMA transfer can come between.
        assert!(
            (trigger.rise_ns - gate.rise_ns).abs_diff(lead_ns) <= BUS_NS,
            "trigger {} ns after the gate",
            trigger.rise_ns - gate.rise_ns
        );
        assert!((trigger.fall_ns - trigger.rise_ns).abs_diff(exposure_ns) <= BUS_NS);
    }
}

fn gates_and_triggers(session: &mut Session<McuController>) -> (Vec<Pulse>, Vec<Pulse>) {
    let edges = session.take_edges();
    let triggers = pulses(&edges, |line| line == Line::CameraTrigger(0));
    assert_eq!(
        triggers.iter().map(|p| (p.rise_ns, p.fall_ns)).collect::<Vec<_>>(),
        pulses(&edges, |line| line == Line::CameraTrigger(1))
            .iter()
            .map(|p| (p.rise_ns, p.fall_ns))
            .collect::<Vec<_>>(),
        "both cameras are triggered at once"
    );
    (pulses(&edges, is_projector), triggers)
}

fn ten_thousand_slots_under_flood(variant: Variant) {
    let Some(mut session) = common::session(variant) else { return };
    let timing = fast();
    assert!(timing.dead_time_us() <= 10);
    light_up(&mut session, &timing).unwrap_or_else(|error| panic!("{variant:?}: {error}"));
    session.take_edges();
    session.take_events();
    session.run_for(2_000_000);
    let answered = flood(&mut session, 10_050_000_000);
    let resets = session.controller.chip().resets().to_vec();
    assert_eq!(resets.len(), 1, "{variant:?}: {resets:?}, log {:#?}", common::log(&mut session));
    let (gates, triggers) = gates_and_triggers(&mut session);
    println!("{variant:?}: {answered} requests answered");
    let events = session.take_events();
    let faults: Vec<_> =
        events.iter().filter(|e| matches!(e.event, Event::FaultEvent(_))).collect();
    assert!(faults.is_empty(), "{variant:?}: {faults:?}");
    assert!(gates.len() >= 10_000, "{} slots", gates.len());
    assert!(answered > 5_000, "{variant:?}: only {answered} requests were answered");
    // The first gate may be one whose trigger rose before the edges were taken.
    let offset = usize::from(triggers[0].rise_ns < gates[0].rise_ns);
    check_slots(&gates, &triggers[offset..], &timing);
    let labels: Vec<u32> = events
        .iter()
        .filter_map(|e| {
            if let Event::TriggerEvent(t) = &e.event { Some(t.frame_sequence) } else { None }
        })
        .collect();
    println!("{variant:?}: {} of {} trigger events arrived under flood", labels.len(), gates.len());
    assert!(labels.windows(2).all(|pair| pair[1] == pair[0] + 1), "events lost or out of order");
    // The last slot may not be over, and the events of those before the first were taken.
    assert!(labels.len() + 3 >= gates.len(), "{} of {} labels", labels.len(), gates.len());
    common::assert_all_modelled(&mut session);
}

#[test]
fn ten_thousand_slots_of_1_ms_under_flood_f330() {
    ten_thousand_slots_under_flood(Variant::F330);
}

#[test]
fn ten_thousand_slots_of_1_ms_under_flood_f350() {
    ten_thousand_slots_under_flood(Variant::F350);
}

#[test]
fn the_papers_timing_has_every_label() {
    for variant in common::BOARDS {
        let Some(mut session) = common::session(variant) else { continue };
        let timing = ProjectionTiming::default();
        light_up(&mut session, &timing).unwrap();
        for _ in 0..20 {
            session.run_for(100_000_000);
            session.send(&Request::Heartbeat(Heartbeat));
        }
        let edges = session.edges.clone();
        let (gates, triggers) = gates_and_triggers(&mut session);
        assert!(gates.len() >= 58, "{} slots in two seconds", gates.len());
        check_slots(&gates, &triggers, &timing);
        // Every trigger has its event, in order, with the projector that was lit.
        let events: Vec<_> = session
            .take_events()
            .into_iter()
            .filter_map(|e| if let Event::TriggerEvent(t) = e.event { Some(t) } else { None })
            .collect();
        assert!(events.len() + 2 >= gates.len());
        for (n, (event, gate)) in events.iter().zip(&gates).enumerate() {
            assert_eq!(event.frame_sequence, n as u32);
            assert_eq!(Line::Projector(event.slot_index), gate.line);
            assert_eq!(event.projector_mask, 1 << event.slot_index);
            assert_eq!(event.usb_sof.is_some(), variant == Variant::F350);
        }
        let mut vcd = Vec::new();
        write_vcd(&edges, &mut vcd).unwrap();
        let mut csv = Vec::new();
        write_csv(&edges, &mut csv).unwrap();
        let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR"));
        let name = format!("{variant:?}").to_lowercase();
        std::fs::write(folder.join(format!("{name}_default.vcd")), vcd).unwrap();
        std::fs::write(folder.join(format!("{name}_default.csv")), csv).unwrap();
        println!("pin traces are in {}", folder.display());
        common::assert_all_modelled(&mut session);
    }
}

#[test]
fn simultaneous_gates_rise_and_fall_together_and_the_floodlight_joins() {
    let Some(mut session) = common::session(Variant::F330) else { return };
    let mut timing = ProjectionTiming {
        exposure_us: 2_000,
        frame_period_us: 5_000,
        ..ProjectionTiming::default()
    };
    timing.slots.clear();
    for slot in
        [Slot { projector_mask: 0b1001, floodlight: true }, Slot::dark(), Slot::projector(2)]
    {
        timing.slots.push(slot).unwrap();
    }
    light_up(&mut session, &timing).unwrap();
    session.run_for(60_000_000);
    let edges = session.take_edges();
    let three = |line| pulses(&edges, move |l| l == line);
    let (a, b, flood) =
        (three(Line::Projector(0)), three(Line::Projector(3)), three(Line::Floodlight));
    assert!(a.len() >= 3);
    for ((a, b), flood) in a.iter().zip(&b).zip(&flood) {
        assert_eq!((a.rise_ns, a.fall_ns), (b.rise_ns, b.fall_ns));
        assert_eq!((a.rise_ns, a.fall_ns), (flood.rise_ns, flood.fall_ns));
    }
    // The dark slot triggers the cameras without light.
    let triggers = three(Line::CameraTrigger(0));
    assert!(triggers.len() >= a.len() + three(Line::Projector(2)).len() + 2);
}

#[test]
fn the_timers_wrap_is_crossed_while_running() {
    for variant in common::BOARDS {
        let Some(mut session) = common::session(variant) else { continue };
        let timing = ProjectionTiming {
            exposure_us: 900,
            frame_period_us: 1_000,
            trigger_delay_us: 20,
            gate_lead_us: 10,
            gate_lag_us: 10,
            ..ProjectionTiming::default()
        };
        // The time driver's 32-bit microsecond counter is set to a second before its wrap, as if the
        // device had run for 71 minutes. Twice: its half-way point is a special case of the driver.
        for before_us in [0x8000_0000u32 - 500_000, u32::MAX - 500_000] {
            use stspp_hil_mcu::soc::peripheral::TimerId;
            session.run_for(1_000_000);
            session.controller.chip().advance_timer(TimerId::T1, before_us);
            session.run_for(50_000_000);
            light_up(&mut session, &timing)
                .unwrap_or_else(|e| panic!("{variant:?} at {before_us:#x}: {e}"));
            session.take_edges();
            for _ in 0..10 {
                session.run_for(100_000_000);
                session.call(Request::Heartbeat(Heartbeat)).unwrap();
            }
            let (gates, triggers) = gates_and_triggers(&mut session);
            assert!(gates.len() > 950, "{variant:?}: {} slots across the wrap", gates.len());
            let offset = usize::from(triggers[0].rise_ns < gates[0].rise_ns);
            check_slots(&gates, &triggers[offset..], &timing);
            session.call(Request::Disarm(stspp_protocol::request::Disarm)).unwrap();
        }
    }
}
