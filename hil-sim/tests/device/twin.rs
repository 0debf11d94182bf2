//! Two engines under one logic: the simulator's, which computes edges slot by slot, and the runner that
//! the chip uses, which commits edges ahead and takes them back. Over an ideal queue, they must say and
//! do the same, byte for byte and edge for edge.

use proptest::prelude::*;
use stspp_firmware_logic::controller::{Boot, Controller as Logic, Identity};
use stspp_firmware_logic::hardware::{Aborted, GateEngine, SlotDone, TriggerEdges};
use stspp_firmware_logic::runner::{Edge, EdgeQueue, Refused, Runner};
use stspp_firmware_logic::timing::{GateWord, SlotPlan};
use stspp_hil_sim::device::in_process::flash::MemoryFlash;
use stspp_hil_sim::device::in_process::{InProcess, InProcessOptions, LINK_LATENCY_NS};
use stspp_hil_sim::device::{Controller, Line};
use stspp_protocol::fault::FaultSet;
use stspp_protocol::message::Request;
use stspp_protocol::request::*;
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::trigger::{ExternalTrigger, TriggerEdge, TriggerSource};
use stspp_protocol::version::{BoardKind, PROTOCOL_VERSION, ResetCause};
use stspp_protocol::wire::MAX_FRAME_LEN;

use crate::edges::timing;

/// Timed writes without any delay of their own.
#[derive(Debug, Default)]
struct IdealQueue {
    now_us: u64,
    edges: Vec<Edge>,
    happened: usize,
}

impl EdgeQueue for IdealQueue {
    fn now_us(&self) -> u64 {
        self.now_us
    }

    fn restart(&mut self) {
        self.edges.clear();
        self.happened = 0;
    }

    fn queue(&mut self, edges: &[Edge]) -> Result<u32, Refused> {
        assert!(edges.iter().all(|edge| edge.at_us > self.now_us), "never too late without delays");
        self.edges.extend(edges);
        Ok((self.edges.len() - edges.len()) as u32)
    }

    fn retract(&mut self, first: u32) -> Result<(), Refused> {
        if (first as usize) < self.happened {
            return Err(Refused);
        }
        self.edges.truncate(first as usize);
        Ok(())
    }
}

#[derive(Debug, Default)]
struct RunnerEngine {
    runner: Runner,
    queue: IdealQueue,
    floodlight_until_us: Option<u64>,
    gates: GateWord,
    triggers: bool,
    trace: Vec<(u64, Line, bool)>,
}

impl RunnerEngine {
    fn next_us(&self) -> Option<u64> {
        let queued = self.queue.edges.get(self.queue.happened).map(|edge| edge.at_us);
        queued.into_iter().chain(self.floodlight_until_us).min()
    }

    fn step(&mut self) -> Option<SlotDone> {
        let now_us = self.next_us()?;
        self.queue.now_us = now_us;
        if self.floodlight_until_us == Some(now_us) {
            self.floodlight_until_us = None;
            self.set(GateWord::DARK, false);
            return None;
        }
        let effect = self.queue.edges[self.queue.happened].effect;
        self.queue.happened += 1;
        self.set(effect.gates.unwrap_or(self.gates), effect.triggers.unwrap_or(self.triggers));
        let mut report = None;
        let sof = || Some((now_us / 1_000 % 2_048) as u16);
        let happened = self.queue.happened as u32;
        self.runner.on_events(happened, sof, |done| report = Some(done), &mut self.queue);
        report
    }

    fn set(&mut self, gates: GateWord, triggers: bool) {
        let now_us = self.queue.now_us;
        for p in 0..16u8 {
            let (was, is) = (self.gates.projector_mask() >> p & 1, gates.projector_mask() >> p & 1);
            if was != is {
                self.trace.push((now_us, Line::Projector(p), is == 1));
            }
        }
        if self.gates.floodlight() != gates.floodlight() {
            self.trace.push((now_us, Line::Floodlight, gates.floodlight()));
        }
        if self.triggers != triggers {
            for camera in 0..2 {
                self.trace.push((now_us, Line::CameraTrigger(camera), triggers));
            }
        }
        (self.gates, self.triggers) = (gates, triggers);
    }
}

impl GateEngine for RunnerEngine {
    fn ticks_per_us(&self) -> u32 {
        1
    }

    fn load(&mut self, plan: &SlotPlan) {
        self.runner.load(plan, &mut self.queue);
    }

    fn start(&mut self, slots: Option<u32>) -> u64 {
        self.runner.start(slots, &mut self.queue)
    }

    fn stop(&mut self) -> u32 {
        self.runner.stop(&mut self.queue)
    }

    fn force_off(&mut self) -> Aborted {
        let aborted = self.runner.abort(self.queue.happened as u32, self.queue.now_us);
        self.queue.restart();
        self.floodlight_until_us = None;
        self.set(GateWord::DARK, false);
        aborted
    }

    fn set_floodlight(&mut self, duration_us: u32) {
        let is_on = duration_us != 0;
        self.floodlight_until_us = is_on.then(|| self.queue.now_us + u64::from(duration_us));
        self.set(if is_on { GateWord::FLOODLIGHT_ONLY } else { GateWord::DARK }, false);
    }

    fn floodlight_is_on(&self) -> bool {
        self.gates.floodlight()
    }

    fn set_trigger_source(&mut self, source: TriggerSource) {
        self.runner.set_trigger_source(source);
    }

    fn trigger_edges(&self) -> TriggerEdges {
        self.runner.trigger_edges()
    }
}

struct Twin {
    logic: Logic<RunnerEngine, MemoryFlash>,
    said: Vec<u8>,
}

impl Twin {
    fn new(options: &InProcessOptions) -> Self {
        let boot = Boot { cause: ResetCause::PowerOn, carried: FaultSet::EMPTY };
        let identity = Identity::new(BoardKind::F350, options.serial);
        let logic = Logic::new(identity, RunnerEngine::default(), MemoryFlash::default(), boot);
        let mut twin = Self { logic, said: Vec::new() };
        twin.logic.on_temperature(0, 250);
        twin.tell_events();
        twin
    }

    fn tell_events(&mut self) {
        let mut out = [0; MAX_FRAME_LEN];
        while let Some(len) = self.logic.next_event(&mut out) {
            self.said.extend_from_slice(&out[..len]);
        }
    }

    fn run_until(&mut self, until_us: u64) {
        loop {
            let engine_us = self.logic.engine().next_us();
            let next_us = engine_us.into_iter().chain(self.logic.next_deadline_us()).min();
            let Some(now_us) = next_us.filter(|&next_us| next_us <= until_us) else { break };
            while self.logic.engine().next_us().is_some_and(|next_us| next_us <= now_us) {
                if let Some(done) = self.logic.engine_mut().step() {
                    self.logic.on_slot_done(now_us, &done);
                }
            }
            self.logic.engine_mut().queue.now_us = now_us;
            self.logic.poll(now_us);
            self.tell_events();
        }
        self.logic.engine_mut().queue.now_us = until_us;
    }

    /// A rising edge at trigger-in.
    fn edge(&mut self, now_us: u64) {
        self.run_until(now_us);
        let RunnerEngine { runner, queue, .. } = self.logic.engine_mut();
        runner.on_trigger_edge(now_us, 0, queue);
    }

    fn hear(&mut self, now_us: u64, mut bytes: &[u8]) {
        self.run_until(now_us);
        let mut out = [0; MAX_FRAME_LEN];
        while let Some(len) = self.logic.receive(now_us, &mut bytes, &mut out) {
            self.tell_events();
            self.said.extend_from_slice(&out[..len]);
        }
        self.tell_events();
    }
}

fn request() -> impl Strategy<Value = Request> {
    prop_oneof![
        1 => Just(Request::Hello(Hello { host: PROTOCOL_VERSION })),
        4 => Just(Request::Arm(Arm)),
        1 => Just(Request::Disarm(Disarm)),
        4 => Just(Request::StartStream(StartStream)),
        3 => Just(Request::StopStream(StopStream)),
        4 => (1u16..30).prop_map(|frames| Request::StartBurst(StartBurst { frames })),
        6 => timing().prop_map(|timing| Request::SetTiming(SetTiming { timing })),
        1 => Just(Request::FloodlightOn(FloodlightOn { duration_us: 3_000 })),
        1 => Just(Request::FloodlightOff(FloodlightOff)),
        1 => Just(Request::GetTiming(GetTiming)),
        1 => Just(Request::ClearFaults(ClearFaults)),
        3 => Just(Request::Heartbeat(Heartbeat)),
    ]
}

/// What comes from outside.
#[derive(Debug, Clone)]
enum Input {
    Request(Request),
    /// A pulse at trigger-in.
    Pulse,
}

/// Compares the two over a script of requests, each so many microseconds after the one before.
fn compare(script: &[(u64, Request)]) -> Result<usize, TestCaseError> {
    let script: Vec<_> = script
        .iter()
        .map(|(wait_us, request)| (*wait_us, Input::Request(request.clone())))
        .collect();
    compare_inputs(&script)
}

fn compare_inputs(script: &[(u64, Input)]) -> Result<usize, TestCaseError> {
    let options = InProcessOptions::default();
    let mut twin = Twin::new(&options);
    let mut device = InProcess::new(options);
    let (mut edges, mut said) = (Vec::new(), Vec::new());
    let mut now_us = 0;
    let mut out = [0; MAX_FRAME_LEN];
    for (seq, (wait_us, input)) in script.iter().enumerate() {
        now_us += wait_us;
        let Input::Request(request) = input else {
            device.run_until(now_us * 1_000, &mut edges);
            device.host_read(&mut said);
            device.set_trigger_in(true);
            device.set_trigger_in(false);
            twin.edge(now_us);
            continue;
        };
        let bytes = request.encode(seq as u16, &mut out).unwrap();
        device.run_until(now_us * 1_000 - LINK_LATENCY_NS, &mut edges);
        device.host_write(bytes);
        device.run_until(now_us * 1_000, &mut edges);
        device.host_read(&mut said);
        twin.hear(now_us, bytes);
    }
    now_us += 500_000;
    device.run_until(now_us * 1_000, &mut edges);
    device.run_until(now_us * 1_000 + LINK_LATENCY_NS, &mut Vec::new());
    device.host_read(&mut said);
    twin.run_until(now_us);

    let mut edges: Vec<_> =
        edges.iter().map(|edge| (edge.time_ns / 1_000, edge.line, edge.high)).collect();
    edges.sort_unstable();
    let mut trace = std::mem::take(&mut twin.logic.engine_mut().trace);
    trace.sort_unstable();
    prop_assert_eq!(&edges, &trace);
    // The last event may fall into the latency after the end.
    let common = said.len().min(twin.said.len());
    prop_assert!(common + 100 > said.len());
    prop_assert!(said[..common] == twin.said[..common], "they say different things");
    Ok(edges.len())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn both_engines_say_and_do_the_same(
        script in prop::collection::vec((100u64..60_000, request()), 1..40),
    ) {
        let mut whole = vec![
            (100, Request::Hello(Hello { host: PROTOCOL_VERSION })),
            (100, Request::Arm(Arm)),
        ];
        whole.extend(script);
        compare(&whole)?;
    }
}

fn external(delay_us: u32) -> Request {
    let external = ExternalTrigger { edge: TriggerEdge::Rising, delay_us };
    Request::SetTriggerSource(SetTriggerSource { source: TriggerSource::External(external) })
}

fn input() -> impl Strategy<Value = Input> {
    let source = prop_oneof![
        2 => (60u32..900).prop_map(external),
        1 => Just(Request::SetTriggerSource(SetTriggerSource { source: TriggerSource::FreeRunning })),
        1 => Just(Request::GetTriggerSource(GetTriggerSource)),
    ];
    prop_oneof![
        8 => Just(Input::Pulse),
        3 => request().prop_map(Input::Request),
        1 => source.prop_map(Input::Request),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn both_engines_follow_trigger_in_alike(
        delay_us in 60u32..900,
        script in prop::collection::vec((prop_oneof![100u64..3_000, 100u64..30_000], input()), 1..80),
    ) {
        let mut whole = vec![
            (100, Input::Request(Request::Hello(Hello { host: PROTOCOL_VERSION }))),
            (100, Input::Request(external(delay_us))),
            (100, Input::Request(Request::Arm(Arm))),
            (100, Input::Request(Request::StartStream(StartStream))),
        ];
        whole.extend(script);
        compare_inputs(&whole)?;
    }
}

/// Requests at every microsecond around a boundary of slots and of cycles.
#[test]
fn they_agree_around_boundaries() {
    let slow = ProjectionTiming {
        slots: (0..3).map(stspp_protocol::timing::Slot::projector).collect(),
        frame_period_us: 1_000,
        exposure_us: 980,
        trigger_delay_us: 3,
        gate_lead_us: 2,
        gate_lag_us: 5,
    };
    let other = ProjectionTiming { frame_period_us: 1_700, exposure_us: 20, ..slow.clone() };
    let set = |timing: &ProjectionTiming| Request::SetTiming(SetTiming { timing: timing.clone() });
    for wait_us in (1_980..2_100).chain(2_980..3_100).chain(5_980..6_100) {
        for request in [set(&other), Request::StopStream(StopStream), Request::Disarm(Disarm)] {
            let script = [
                (100, Request::Hello(Hello { host: PROTOCOL_VERSION })),
                (100, set(&slow)),
                (100, Request::Arm(Arm)),
                (100, Request::StartStream(StartStream)),
                (wait_us, request),
                (20_000, Request::StopStream(StopStream)),
            ];
            assert!(compare(&script).unwrap() > 10);
        }
    }
}
