//! Whatever is asked, in whatever order: the light keeps its rules.
//!
//! The witness knows only the replies, what was done to the device, and the edges. It never looks
//! into the device.

use proptest::prelude::*;
use stspp_hil_sim::device::in_process::{
    BOOT_NS, InProcessOptions, Injection, LINK_LATENCY_NS, SUSPEND_NS, WATCHDOG_NS,
};
use stspp_hil_sim::device::{Controller, Line, PinEdge};
use stspp_protocol::request::*;
use stspp_protocol::timing::{Limits, ProjectionTiming, Slot};
use stspp_protocol::version::{PROTOCOL_VERSION, ProtocolVersion};

use crate::edges::timing;
use crate::host::{Host, MS};

const LIMITS: Limits = Limits::F350;

#[derive(Debug, Clone)]
enum Step {
    Hello,
    WrongHello,
    Arm,
    Disarm,
    Stream,
    Stop,
    Burst(u16),
    FloodlightOn(u32),
    FloodlightOff,
    Timing(ProjectionTiming),
    Clear,
    Save,
    Load,
    Defaults,
    Reset,
    Interlock(bool),
    Hot(bool),
    Link(bool),
    Hang,
    Panic,
    Stall,
    Noise(Vec<u8>),
    Wait(u64),
}

/// Timings that light as much as the limits allow, and more.
fn greedy() -> impl Strategy<Value = ProjectionTiming> {
    (prop::collection::vec((0u16..1 << 4, any::<bool>()), 1..6), 1_000u32..45_000).prop_map(
        |(slots, period)| ProjectionTiming {
            slots: slots
                .into_iter()
                .map(|(projector_mask, floodlight)| Slot { projector_mask, floodlight })
                .collect(),
            frame_period_us: period,
            exposure_us: period - 2,
            trigger_delay_us: 1,
            gate_lead_us: 0,
            gate_lag_us: 0,
        },
    )
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        3 => Just(Step::Hello),
        1 => Just(Step::WrongHello),
        10 => Just(Step::Arm),
        2 => Just(Step::Disarm),
        8 => Just(Step::Stream),
        3 => Just(Step::Stop),
        8 => (1u16..20).prop_map(Step::Burst),
        8 => (1u32..600_000).prop_map(Step::FloodlightOn),
        2 => Just(Step::FloodlightOff),
        4 => timing().prop_map(Step::Timing),
        4 => greedy().prop_map(Step::Timing),
        5 => Just(Step::Clear),
        1 => Just(Step::Save),
        1 => Just(Step::Load),
        1 => Just(Step::Defaults),
        1 => Just(Step::Reset),
        3 => any::<bool>().prop_map(Step::Interlock),
        2 => any::<bool>().prop_map(Step::Hot),
        2 => any::<bool>().prop_map(Step::Link),
        1 => Just(Step::Hang),
        1 => Just(Step::Panic),
        1 => Just(Step::Stall),
        2 => prop::collection::vec(any::<u8>(), 0..60).prop_map(Step::Noise),
        10 => (1u64..400).prop_map(Step::Wait),
        4 => Just(Step::Wait(3)),
    ]
}

/// When light was allowed, as the outside can tell: from a granted `Arm` to the first thing after it
/// that must end the light.
#[derive(Default)]
struct Witness {
    allowed: Vec<(u64, u64)>,
    since: Option<u64>,
    last_heard_ns: u64,
}

impl Witness {
    fn arm(&mut self, at_ns: u64) {
        self.since.get_or_insert(at_ns);
    }

    /// Light must be off from `at_ns` on.
    fn end(&mut self, at_ns: u64) {
        if let Some(since) = self.since.take() {
            self.allowed.push((since, at_ns));
        }
    }

    /// A request was handled; silence before it may have ended the light.
    fn heard(&mut self, at_ns: u64) {
        self.silence(at_ns);
        self.last_heard_ns = at_ns;
    }

    fn silence(&mut self, now_ns: u64) {
        let off_ns = self.last_heard_ns + u64::from(LIMITS.heartbeat_timeout_us) * 1_000;
        if now_ns > off_ns + 1_000 {
            self.end(off_ns + 1_000);
        }
    }
}

fn play(steps: &[Step]) -> Result<(Host, Witness), TestCaseError> {
    let mut host = Host::new(InProcessOptions::default());
    let mut witness = Witness::default();
    let mut linked = true;
    host.hello().unwrap();
    witness.heard(host.now() - LINK_LATENCY_NS);
    for step in steps {
        let at_ns = host.now();
        let handled_ns = at_ns + LINK_LATENCY_NS;
        // Requests: none is answered without a link or while the firmware is down.
        macro_rules! ask {
            ($request:expr) => {{
                let reply = host.try_call(&$request);
                if reply.is_some() {
                    witness.heard(handled_ns);
                }
                reply
            }};
        }
        match step {
            Step::Hello => {
                ask!(Hello { host: PROTOCOL_VERSION }).map(|_| witness.end(handled_ns));
            }
            Step::WrongHello => {
                let host_version = ProtocolVersion { major: 9, minor: 0 };
                ask!(Hello { host: host_version }).map(|_| witness.end(handled_ns));
            }
            Step::Arm => {
                if let Some(Ok(_)) = ask!(Arm) {
                    witness.arm(handled_ns);
                }
            }
            Step::Disarm => {
                ask!(Disarm).map(|_| witness.end(handled_ns));
            }
            Step::Stream => {
                let _ = ask!(StartStream);
            }
            Step::Stop => {
                let _ = ask!(StopStream);
            }
            Step::Burst(frames) => {
                let _ = ask!(StartBurst { frames: *frames });
            }
            Step::FloodlightOn(duration_us) => {
                let _ = ask!(FloodlightOn { duration_us: *duration_us });
            }
            Step::FloodlightOff => {
                let _ = ask!(FloodlightOff);
            }
            Step::Timing(timing) => {
                if let Some(Ok(_)) = ask!(SetTiming { timing: timing.clone() }) {
                    prop_assert!(timing.validate(&LIMITS).is_ok());
                }
            }
            Step::Clear => {
                let _ = ask!(ClearFaults);
            }
            Step::Save => {
                let _ = ask!(SaveSettings);
            }
            Step::Load => {
                let _ = ask!(LoadSettings);
            }
            Step::Defaults => {
                let _ = ask!(LoadDefaults);
            }
            Step::Reset => {
                if let Some(Ok(_)) = ask!(Reset) {
                    witness.end(handled_ns);
                    host.run(BOOT_NS);
                }
            }
            Step::Interlock(closed) => {
                host.device.set_interlock_closed(*closed);
                if !closed {
                    witness.silence(at_ns);
                    witness.end(at_ns);
                }
            }
            Step::Hot(hot) => {
                host.device.set_temperature_c(if *hot { 95.0 } else { 30.0 });
                if *hot {
                    witness.silence(at_ns);
                    witness.end(at_ns);
                }
            }
            Step::Link(connected) => {
                host.device.set_link_connected(*connected);
                if linked && !connected {
                    host.run(SUSPEND_NS);
                    witness.silence(host.now());
                    witness.end(at_ns + SUSPEND_NS);
                }
                linked = *connected;
            }
            Step::Hang => {
                host.device.inject(Injection::Hang);
                host.run(WATCHDOG_NS + BOOT_NS);
                witness.end(at_ns + WATCHDOG_NS);
            }
            Step::Panic => {
                host.device.inject(Injection::Panic);
                host.run(BOOT_NS);
                witness.silence(at_ns);
                witness.end(at_ns);
            }
            Step::Stall => host.device.inject(Injection::EngineStall),
            Step::Noise(bytes) => host.send_raw(bytes),
            Step::Wait(ms) => host.run(ms * MS),
        }
    }
    host.run(3_000 * MS);
    witness.silence(host.now());
    witness.end(host.now());
    Ok((host, witness))
}

/// On-times per emitter, 16 projectors and the floodlight.
fn on_times(edges: &[PinEdge]) -> [Vec<(u64, u64)>; 17] {
    let mut on_since = [None; 17];
    let mut on_times: [Vec<(u64, u64)>; 17] = Default::default();
    for edge in edges {
        let emitter = match edge.line {
            Line::Projector(p) => usize::from(p),
            Line::Floodlight => 16,
            Line::CameraTrigger(_) => continue,
        };
        if edge.high {
            assert!(on_since[emitter].replace(edge.time_ns).is_none(), "rose twice");
        } else {
            let since = on_since[emitter].take().expect("it was high");
            on_times[emitter].push((since, edge.time_ns));
        }
    }
    assert!(on_since.iter().all(Option::is_none), "all is low in the end");
    on_times
}

fn check_light(edges: &[PinEdge], witness: &Witness) -> Result<(), TestCaseError> {
    prop_assert!(edges.is_sorted_by_key(|edge| edge.time_ns));
    let on_times = on_times(edges);
    for (emitter, times) in on_times.iter().enumerate() {
        let (longest_us, duty) = if emitter == 16 {
            (LIMITS.max_floodlight_on_us, LIMITS.max_floodlight_duty_permille)
        } else {
            (LIMITS.max_on_time_us, LIMITS.max_projector_duty_permille)
        };
        let duty = f64::from(duty) / 1_000.0;
        let capacity_ns = duty * f64::from(LIMITS.duty_window_us) * 1_000.0;
        let (mut level_ns, mut last_ns) = (0.0f64, 0);
        for &(on, off) in times {
            // Never without a granted Arm, nor after what ends it.
            let inside = witness.allowed.iter().any(|&(from, to)| from <= on && off <= to);
            prop_assert!(inside, "emitter {emitter} on {on}..{off}, allowed {:?}", witness.allowed);
            prop_assert!(off - on <= u64::from(longest_us) * 1_000, "on for {} ns", off - on);
            // The duty over every stretch of time, by a bucket that leaks all the time.
            level_ns = (level_ns - duty * (on - last_ns) as f64).max(0.0);
            level_ns += (1.0 - duty) * (off - on) as f64;
            last_ns = off;
            prop_assert!(level_ns <= capacity_ns, "emitter {emitter}: {level_ns} ns at {off}");
        }
    }
    let mut lit = 0i32;
    for edge in edges {
        if matches!(edge.line, Line::Projector(_)) {
            lit += if edge.high { 1 } else { -1 };
            prop_assert!(lit <= i32::from(LIMITS.max_simultaneous_projectors));
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2_000, max_shrink_iters: 2_000, ..ProptestConfig::default() })]

    #[test]
    fn the_light_keeps_its_rules(steps in prop::collection::vec(step(), 1..80)) {
        let (host, witness) = play(&steps)?;
        check_light(&host.edges, &witness)?;
    }
}

/// Sequences that go for the duty limit: light whenever it is granted, resets in between.
#[test]
fn a_host_that_wants_all_the_light_does_not_get_it() {
    let full = ProjectionTiming {
        slots: [Slot { projector_mask: 7, floodlight: false }, Slot::dark(), Slot::dark()]
            .into_iter()
            .collect(),
        frame_period_us: 39_000,
        exposure_us: 38_998,
        trigger_delay_us: 1,
        gate_lead_us: 0,
        gate_lag_us: 0,
    };
    let mut steps = vec![Step::Timing(full.clone()), Step::Arm];
    for round in 0..400 {
        steps.extend([Step::Burst(1), Step::Wait(39), Step::FloodlightOn(450_000), Step::Wait(3)]);
        if round % 150 == 149 {
            steps.extend([Step::Reset, Step::Hello, Step::Timing(full.clone()), Step::Arm]);
        }
    }
    let (host, witness) = play(&steps).unwrap();
    check_light(&host.edges, &witness).unwrap();
    let lit_ns: u64 = on_times(&host.edges)[0].iter().map(|&(on, off)| off - on).sum();
    let share = lit_ns as f64 / host.now() as f64;
    assert!((0.2..0.45).contains(&share), "projector 0 was on for {share} of the time");
}

/// The witness must be able to fail: an edge that should not be is found.
#[test]
fn the_witness_sees_a_stray_edge() {
    let steps = [Step::Arm, Step::Burst(3), Step::Wait(200), Step::Disarm];
    let (mut host, witness) = play(&steps).unwrap();
    check_light(&host.edges, &witness).unwrap();
    let time_ns = host.now();
    let stray = |time_ns, high| PinEdge { time_ns, line: Line::Projector(3), high };
    host.edges.extend([stray(time_ns, true), stray(time_ns + 1_000, false)]);
    assert!(check_light(&host.edges, &witness).is_err());
}
