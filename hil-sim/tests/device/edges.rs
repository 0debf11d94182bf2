//! Edges and events against the timing's definition, laid out here a second time.

use proptest::prelude::*;
use stspp_hil_sim::device::in_process::InProcessOptions;
use stspp_hil_sim::device::in_process::clock::DeviceClock;
use stspp_hil_sim::device::{Line, PinEdge};
use stspp_protocol::event::TriggerEvent;
use stspp_protocol::message::Event;
use stspp_protocol::request::{GetTiming, StartBurst, StartStream, StopStream};
use stspp_protocol::timing::{Limits, ProjectionTiming, Slot};
use stspp_protocol::version::BoardKind;

use crate::host::{Host, MS};

/// Valid timings with short periods.
pub fn timing() -> impl Strategy<Value = ProjectionTiming> {
    let slot = prop_oneof![
        6 => (0u8..10).prop_map(Slot::projector),
        1 => Just(Slot::dark()),
        1 => Just(Slot::floodlight()),
        2 => (0u16..1 << 10, any::<bool>())
            .prop_map(|(projector_mask, floodlight)| Slot { projector_mask, floodlight }),
    ];
    let slots = prop::collection::vec(slot, 1..=16);
    (slots, 1_000u32..20_000, 1u32..900, 0u32..900, 0u32..900, 0.0..1.0f64).prop_filter_map(
        "within the limits",
        |(slots, period, delay, lead, lag, fill)| {
            let room = period.checked_sub(delay + lag + 1)?;
            let timing = ProjectionTiming {
                slots: slots.into_iter().collect(),
                frame_period_us: period,
                exposure_us: 10 + (f64::from(room.saturating_sub(10)) * fill) as u32,
                trigger_delay_us: delay,
                gate_lead_us: lead.min(delay - 1),
                gate_lag_us: lag,
            };
            timing.validate(&Limits::F350).is_ok().then_some(timing)
        },
    )
}

/// The edges of `slots` slots from `start_us` on, by the definition in `protocol::timing`.
fn edges_by_definition(
    timing: &ProjectionTiming,
    start_us: u64,
    slots: u64,
) -> Vec<(u64, Line, bool)> {
    let mut edges = Vec::new();
    for n in 0..slots {
        let slot_start = start_us + n * u64::from(timing.frame_period_us);
        let slot = timing.slots[(n % timing.slots.len() as u64) as usize];
        let trigger_rise = slot_start + u64::from(timing.trigger_delay_us);
        let trigger_fall = trigger_rise + u64::from(timing.exposure_us);
        let gate_rise = trigger_rise - u64::from(timing.gate_lead_us);
        let gate_fall = trigger_fall + u64::from(timing.gate_lag_us);
        for camera in 0..2 {
            edges.push((trigger_rise, Line::CameraTrigger(camera), true));
            edges.push((trigger_fall, Line::CameraTrigger(camera), false));
        }
        for projector in (0..10u8).filter(|p| slot.projector_mask >> p & 1 == 1) {
            edges.push((gate_rise, Line::Projector(projector), true));
            edges.push((gate_fall, Line::Projector(projector), false));
        }
        if slot.floodlight {
            edges.push((gate_rise, Line::Floodlight, true));
            edges.push((gate_fall, Line::Floodlight, false));
        }
    }
    edges.sort_unstable();
    edges
}

fn in_us(edges: &[PinEdge]) -> Vec<(u64, Line, bool)> {
    let mut edges: Vec<_> = edges
        .iter()
        .map(|edge| {
            assert_eq!(edge.time_ns % 1_000, 0);
            (edge.time_ns / 1_000, edge.line, edge.high)
        })
        .collect();
    edges.sort_unstable();
    edges
}

fn events_by_definition(
    timing: &ProjectionTiming,
    start_us: u64,
    first: u32,
    generation: u16,
    slots: u32,
) -> Vec<TriggerEvent> {
    (0..slots)
        .map(|n| {
            let slot_index = n as usize % timing.slots.len();
            let slot = timing.slots[slot_index];
            let slot_start = start_us + u64::from(n) * u64::from(timing.frame_period_us);
            let trigger_time_us = slot_start + u64::from(timing.trigger_delay_us);
            TriggerEvent {
                frame_sequence: first + n,
                slot_index: slot_index as u8,
                projector_mask: slot.projector_mask,
                floodlight: slot.floodlight,
                trigger_time_us,
                usb_sof: Some((trigger_time_us / 1_000 % 2_048) as u16),
                timing_generation: generation,
            }
        })
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn a_burst_is_what_the_timing_says(timing in timing(), frames in 1u16..60) {
        let mut host = Host::armed();
        let generation = host.set_timing(&timing);
        let started = host.burst(frames);
        let length_us = u64::from(frames) * u64::from(timing.frame_period_us);
        host.run_alive(length_us * 1_000 + 2 * MS);
        prop_assert_eq!(
            in_us(&host.edges),
            edges_by_definition(&timing, started.start_time_us, u64::from(frames))
        );
        let first = started.first_frame_sequence;
        let events =
            events_by_definition(&timing, started.start_time_us, first, generation, u32::from(frames));
        prop_assert_eq!(host.triggers(), events);
        prop_assert!(host.edges.is_sorted_by_key(|edge| edge.time_ns));
        prop_assert!(host.event_seqs.iter().enumerate().all(|(at, &seq)| usize::from(seq) == at));
    }

    /// A new timing takes over at the next cycle boundary: before it all is the old, after it the new.
    #[test]
    fn a_change_while_running_waits_for_the_cycle(
        before in timing(), after in timing(), at_us in 100u64..100_000,
    ) {
        let mut host = Host::armed();
        let old = host.set_timing(&before);
        let started = host.call(&StartStream).unwrap();
        host.run(at_us * 1_000);
        let asked_us = host.now() / 1_000;
        let new = host.set_timing(&after);
        prop_assert_eq!(new, old + 1);
        prop_assert!(host.call(&GetTiming).unwrap().timing == after);
        host.run_alive((before.cycle_us() + 2 * after.cycle_us()) * 1_000);
        let stop = host.call(&StopStream).unwrap();
        host.run_alive(100 * MS);

        let triggers = host.triggers();
        let split = triggers.iter().position(|event| event.timing_generation == new).unwrap();
        prop_assert_eq!(split % before.slots.len(), 0, "a whole number of cycles");
        let boundary_us =
            started.start_time_us + split as u64 * u64::from(before.frame_period_us);
        prop_assert!(boundary_us >= asked_us);
        prop_assert!(boundary_us <= asked_us + before.cycle_us() + 200, "the very next boundary");
        let first = started.first_frame_sequence;
        let count = stop.end_frame_sequence - first;
        let mut events =
            events_by_definition(&before, started.start_time_us, first, old, split as u32);
        events.extend(events_by_definition(
            &after, boundary_us, first + split as u32, new, count - split as u32,
        ));
        prop_assert_eq!(&triggers, &events);
        let mut edges = edges_by_definition(&before, started.start_time_us, split as u64);
        edges.extend(edges_by_definition(&after, boundary_us, u64::from(count) - split as u64));
        edges.sort_unstable();
        prop_assert_eq!(in_us(&host.edges), edges);
        let said = host.events.iter().find_map(|event| match event {
            Event::TimingEvent(timing) => Some((timing.timing_generation, timing.first_frame_sequence)),
            _ => None,
        });
        prop_assert_eq!(said, Some((new, first + split as u32)));
    }

    /// Trigger times are in the device's clock; the edges show how far that is off.
    #[test]
    fn the_devices_clock_drifts(seed: u64, frames in 1u16..40) {
        let options = InProcessOptions::seeded(seed);
        let clock = DeviceClock::new(0, options.clock_error_ppm);
        let mut host = Host::new(options);
        host.hello().unwrap();
        host.call(&stspp_protocol::request::Arm).unwrap();
        host.burst(frames);
        host.run_alive(u64::from(frames) * 33_400_000);
        let rises: Vec<u64> = host
            .edges
            .iter()
            .filter(|edge| edge.line == Line::CameraTrigger(0) && edge.high)
            .map(|edge| edge.time_ns)
            .collect();
        let events: Vec<u64> =
            host.triggers().iter().map(|event| clock.ns_from_us(event.trigger_time_us)).collect();
        prop_assert_eq!(rises, events);
    }
}

#[test]
fn order_mask_and_period_show_in_edges_and_events() {
    let mut host = Host::armed();
    let mut seen = Vec::new();
    let reversed: Vec<u8> = (0..10).rev().collect();
    for (order, period) in [(&[0u8, 1, 2][..], 2_000), (&[2, 0, 1], 2_000), (&reversed, 5_000)] {
        host.edges.clear();
        host.events.clear();
        host.set_timing(&ProjectionTiming {
            slots: order.iter().map(|&p| Slot::projector(p)).collect(),
            frame_period_us: period,
            exposure_us: 1_000,
            ..ProjectionTiming::default()
        });
        host.burst(12);
        host.run(100 * MS);
        let lit: Vec<u8> = host
            .edges
            .iter()
            .filter_map(|edge| match edge.line {
                Line::Projector(p) if edge.high => Some(p),
                _ => None,
            })
            .collect();
        let expected: Vec<u8> = order.iter().copied().cycle().take(12).collect();
        assert_eq!(lit, expected);
        let labels: Vec<u16> = host.triggers().iter().map(|event| event.projector_mask).collect();
        assert_eq!(labels, expected.iter().map(|&p| 1 << p).collect::<Vec<u16>>());
        let times: Vec<u64> = host.triggers().iter().map(|event| event.trigger_time_us).collect();
        assert!(times.windows(2).all(|pair| pair[1] - pair[0] == u64::from(period)));
        seen.push(host.triggers()[0].timing_generation);
    }
    assert!(seen.windows(2).all(|pair| pair[1] == pair[0] + 1), "{seen:?}");
}

/// A kilohertz, and two microseconds from gate off to gate on.
#[test]
fn the_fastest_pattern_rate() {
    let mut host = Host::armed();
    host.set_timing(&ProjectionTiming {
        frame_period_us: 1_000,
        exposure_us: 998,
        trigger_delay_us: 1,
        gate_lead_us: 0,
        gate_lag_us: 0,
        ..ProjectionTiming::default()
    });
    host.call(&StartStream).unwrap();
    host.run_alive(1_000 * MS);
    let gates: Vec<&PinEdge> =
        host.edges.iter().filter(|edge| matches!(edge.line, Line::Projector(_))).collect();
    assert!(gates.len() > 1_900);
    for pair in gates.windows(2).filter(|pair| !pair[0].high) {
        assert!(pair[1].high && pair[1].line != pair[0].line);
        assert_eq!(pair[1].time_ns - pair[0].time_ns, 2_000);
    }
    assert!(
        host.triggers().windows(2).all(|p| p[1].trigger_time_us - p[0].trigger_time_us == 1_000)
    );
}

#[test]
fn a_stop_completes_the_slot_under_way_and_names_the_end() {
    for at_ms in [0, 1, 20, 33, 34, 100] {
        let mut host = Host::armed();
        let started = host.call(&StartStream).unwrap();
        host.run(at_ms * MS);
        let stop = host.call(&StopStream).unwrap();
        host.run(100 * MS);
        let triggers = host.triggers();
        let last = triggers.last().unwrap();
        assert_eq!(last.frame_sequence + 1, stop.end_frame_sequence);
        assert_eq!(triggers.len() as u32, stop.end_frame_sequence - started.first_frame_sequence);
        let slots = triggers.len() as u64;
        let timing = ProjectionTiming::default();
        let edges = edges_by_definition(&timing, started.start_time_us, slots);
        assert_eq!(in_us(&host.edges), edges);
        // Numbers go on where they ended.
        assert_eq!(host.burst(1).first_frame_sequence, stop.end_frame_sequence);
    }
}

#[test]
fn a_bridge_board_has_no_sof_number() {
    let mut host = Host::on(BoardKind::F330);
    host.hello().unwrap();
    host.call(&stspp_protocol::request::Arm).unwrap();
    host.call(&StartBurst { frames: 3 }).unwrap();
    host.run(200 * MS);
    assert_eq!(host.triggers().len(), 3);
    assert!(host.triggers().iter().all(|event| event.usb_sof.is_none()));
}
