use super::*;
use crate::clock::Clocks;

/// A timer driven by hand: runs its events up to a cycle and keeps the signals.
struct Bench {
    timer: Timer,
    clocks: Clocks,
    signals: Vec<(u64, Signal)>,
}

impl Bench {
    fn new(id: TimerId) -> Self {
        Self { timer: Timer::new(id), clocks: Clocks::after_reset(), signals: Vec::new() }
    }

    fn with<T>(&mut self, now: u64, act: impl FnOnce(&mut Timer, &mut Cx<'_>) -> T) -> T {
        let mut out = Vec::new();
        let result = act(&mut self.timer, &mut Cx { now, clocks: &self.clocks, out: &mut out });
        self.signals.extend(out.into_iter().map(|s| (now, s)));
        result
    }

    fn write(&mut self, now: u64, offset: u32, value: u32) {
        self.with(now, |t, cx| t.write(offset, value, cx));
    }

    fn run(&mut self, until: u64) {
        while self.timer.next_event() <= until {
            let due = self.timer.next_event();
            self.with(due, |t, cx| t.event(cx));
        }
    }

    fn edges(&self, output: u8) -> Vec<(u64, bool)> {
        self.signals
            .iter()
            .filter_map(|(at, s)| match s {
                Signal::TimerOutput(_, o, Some(level)) if *o == output => Some((*at, *level)),
                _ => None,
            })
            .collect()
    }
}

#[test]
fn pwm_edges_fall_on_exact_cycles() {
    let mut bench = Bench::new(TimerId::T2);
    bench.write(0, 0x28, 9);
    bench.write(0, 0x2c, 99);
    bench.write(0, 0x34, 30);
    bench.write(0, 0x18, 0x60);
    bench.write(0, 0x14, 1);
    bench.write(0, 0x20, 1);
    bench.write(5, 0x00, 1);
    bench.run(2500);
    assert_eq!(
        bench.edges(0),
        [(0, true), (305, false), (1005, true), (1305, false), (2005, true), (2305, false)]
    );
    let count = bench.with(2314, |t, cx| t.read(0x24, cx));
    assert_eq!(count, 30);
    let count = bench.with(2315, |t, cx| t.read(0x24, cx));
    assert_eq!(count, 31);
}

#[test]
fn a_single_pulse_stops_and_requests_dma_once() {
    let mut bench = Bench::new(TimerId::T0);
    bench.write(0, 0x2c, 49);
    bench.write(0, 0x0c, 1 << 8);
    bench.write(0, 0x00, 1 | 1 << 3);
    bench.run(10_000);
    let requests: Vec<u64> = bench
        .signals
        .iter()
        .filter(|(_, s)| matches!(s, Signal::DmaPulse(_)))
        .map(|(at, _)| *at)
        .collect();
    assert_eq!(requests, [50]);
    assert_eq!(bench.with(10_000, |t, cx| t.read(0x00, cx)) & 1, 0);
}

#[test]
fn the_32_bit_timer_wraps_and_reports_it() {
    let mut bench = Bench::new(TimerId::T1);
    bench.write(0, 0x24, u32::MAX - 10);
    bench.write(0, 0x34, 5);
    bench.write(0, 0x00, 1);
    bench.run(40);
    assert_eq!(bench.with(40, |t, cx| t.read(0x24, cx)), 29);
    assert_eq!(bench.with(40, |t, cx| t.read(0x10, cx)) & 3, 3);
}

#[test]
fn break_takes_the_outputs_to_their_idle_level() {
    let mut bench = Bench::new(TimerId::T0);
    bench.write(0, 0x18, 0x50);
    bench.write(0, 0x20, 1);
    bench.write(0, 0x44, 1 << 15 | 1 << 13 | 1 << 12 | 1 << 10);
    bench.with(100, |t, cx| t.set_break_input(true, cx));
    assert_eq!(bench.edges(0), [(0, true), (100, false)]);
    assert_eq!(bench.with(100, |t, cx| t.read(0x44, cx)) & 1 << 15, 0);
}

#[test]
fn a_slave_counts_its_masters_updates() {
    let mut bench = Bench::new(TimerId::T2);
    bench.write(0, 0x08, 0x07 | 1 << 4);
    bench.write(0, 0x2c, 2);
    bench.write(0, 0x00, 1);
    for at in [10, 20, 30, 40] {
        bench.with(at, |t, cx| t.on_trgo(TimerId::T1, cx));
    }
    bench.with(45, |t, cx| t.on_trgo(TimerId::T0, cx));
    assert_eq!(bench.with(50, |t, cx| t.read(0x24, cx)), 1);
    assert_eq!(bench.with(50, |t, cx| t.read(0x10, cx)) & 1, 1);
}
