//! The in-process simulator and the real binary on the emulated chip: the same trigger events and
//! the same edges for the same commands, over random valid timings.

mod common;

use stspp_hil_mcu::session::Session;
use stspp_hil_mcu::soc::Variant;
use stspp_hil_sim::device::in_process::{InProcess, InProcessOptions};
use stspp_hil_sim::device::{Controller, Line};
use stspp_protocol::event::TriggerEvent;
use stspp_protocol::message::{Event, Request};
use stspp_protocol::request::{Arm, Disarm, SetTiming, StartBurst};
use stspp_protocol::timing::{Limits, ProjectionTiming, Slot};
use stspp_protocol::version::BoardKind;

/// What a bus transfer for the link can add to an edge.
const BUS_NS: u64 = 100;

struct Random(u64);

impl Random {
    fn below(&mut self, limit: u32) -> u32 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) as u32) % limit
    }

    fn timing(&mut self) -> ProjectionTiming {
        loop {
            let spread = 1 << (1 + self.below(14));
            let period = 1_000 + self.below(spread);
            let lead = self.below(40);
            let lag = self.below(40);
            let timing = ProjectionTiming {
                slots: (0..1 + self.below(16))
                    .map(|_| {
                        let projectors = match self.below(4) {
                            0 => 0,
                            1 => 1 << self.below(10) | 1 << self.below(10) | 1 << self.below(10),
                            _ => 1 << self.below(10),
                        };
                        Slot { projector_mask: projectors, floodlight: self.below(3) == 0 }
                    })
                    .collect(),
                frame_period_us: period,
                exposure_us: 10 + self.below(period),
                trigger_delay_us: lead + 1 + self.below(60),
                gate_lead_us: lead,
                gate_lag_us: lag,
            };
            if timing.validate(&Limits::F330).is_ok() {
                return timing;
            }
        }
    }
}

/// Edges relative to the first trigger, in order of time then line, and the trigger events.
type Account = (Vec<(u64, Line, bool)>, Vec<TriggerEvent>);

fn burst<C: Controller>(
    session: &mut Session<C>,
    timing: &ProjectionTiming,
    frames: u16,
) -> Account {
    session.hello().unwrap();
    session
        .call(Request::SetTiming(SetTiming { timing: timing.clone() }))
        .unwrap_or_else(|e| panic!("{timing:?}: {e}"));
    session.call(Request::Arm(Arm)).unwrap();
    session.take_edges();
    session.take_events();
    session
        .call(Request::StartBurst(StartBurst { frames }))
        .unwrap_or_else(|e| panic!("{timing:?}: {e}"));
    let burst_ns = u64::from(timing.frame_period_us) * 1_000 * u64::from(frames);
    let mut left_ns = burst_ns + 30_000_000;
    while left_ns > 0 {
        let step_ns = left_ns.min(200_000_000);
        session.run_for(step_ns);
        session.send(&Request::Heartbeat(stspp_protocol::request::Heartbeat));
        left_ns -= step_ns;
    }
    session.run_for(10_000_000);
    session.drop_replies();
    let edges = session.take_edges();
    let origin =
        edges.iter().find(|e| e.high && e.line == Line::CameraTrigger(0)).map_or(0, |e| e.time_ns);
    // Gates of slot 0 rise before its trigger: an offset keeps the times positive.
    let mut account: Vec<_> =
        edges.iter().map(|e| (e.time_ns + 1_000_000_000 - origin, e.line, e.high)).collect();
    account.sort_by_key(|(time_ns, line, high)| ((time_ns + 500) / 1_000, *line, *high));
    let triggers = session
        .take_events()
        .into_iter()
        .filter_map(|e| if let Event::TriggerEvent(t) = e.event { Some(t) } else { None })
        .collect();
    session.call(Request::Disarm(Disarm)).unwrap();
    // The duty budget of both rests alike.
    session.run_for(3_000_000_000);
    (account, triggers)
}

/// Random timings a board.
const ROUNDS: u32 = 120;

fn is_dark(timing: &ProjectionTiming) -> bool {
    timing.slots.iter().all(|slot| slot.projector_mask == 0 && !slot.floodlight)
}

#[test]
fn random_timings_come_out_alike_on_the_f330() {
    come_out_alike(Variant::F330);
}

#[test]
fn random_timings_come_out_alike_on_the_f350() {
    come_out_alike(Variant::F350);
}

fn come_out_alike(variant: Variant) {
    let Some(mut chip) = common::session(variant) else { return };
    let board = if variant == Variant::F330 { BoardKind::F330 } else { BoardKind::F350 };
    let mut logic =
        Session::new(InProcess::new(InProcessOptions { board, ..InProcessOptions::default() }));
    logic.run_for(20_000_000);
    let mut random = Random(0x0dd5_eed5);
    let (mut compared, mut labels) = (0, 0);
    for round in 0..ROUNDS {
        let timing = random.timing();
        let frames = (2 * timing.slots.len() + 1) as u16;
        let (edges, triggers) = burst(&mut chip, &timing, frames);
        let (expected_edges, expected_triggers) = burst(&mut logic, &timing, frames);
        let name = format!("{variant:?}, round {round}, {timing:?}");
        assert_eq!(edges.len(), expected_edges.len(), "number of edges: {name}");
        for (got, want) in edges.iter().zip(&expected_edges) {
            assert_eq!((got.1, got.2), (want.1, want.2), "{got:?} against {want:?}: {name}");
            assert!(got.0.abs_diff(want.0) <= BUS_NS, "{got:?} against {want:?}: {name}");
        }
        compared += edges.len();
        labels += triggers.len();
        assert!(edges.iter().any(|e| !matches!(e.1, Line::CameraTrigger(_))) || is_dark(&timing));
        assert_eq!(triggers.len(), usize::from(frames), "{name}");
        assert_eq!(expected_triggers.len(), usize::from(frames), "{name}");
        for (got, want) in triggers.iter().zip(&expected_triggers) {
            let relative = |t: &TriggerEvent, first: &TriggerEvent| {
                (
                    t.frame_sequence - first.frame_sequence,
                    t.slot_index,
                    t.projector_mask,
                    t.floodlight,
                    t.trigger_time_us - first.trigger_time_us,
                )
            };
            assert_eq!(
                relative(got, &triggers[0]),
                relative(want, &expected_triggers[0]),
                "{name}"
            );
            assert_eq!(got.usb_sof.is_some(), want.usb_sof.is_some(), "{name}");
        }
    }
    println!(
        "{variant:?}: {ROUNDS} random timings, {compared} edges of gates and triggers and {labels} events as the in-process simulator's, within {BUS_NS} ns"
    );
    common::assert_all_modelled(&mut chip);
}
