//! Every fault that a link, a camera or a device can have, each at least twenty times at random moments
//! of simulated time, seeded: after each, no pair is under a wrong label (checked by what the pictures
//! show), the stream goes on or ends with a typed error and can be started again in the same process,
//! and every frame is accounted for. Prints a table.
#![cfg(feature = "sim")]

mod live;

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use live::{Dice, Witness};
use stspp::camera::{CameraError, CameraFrame, CameraSource};
use stspp::clock::Clock;
use stspp::sim::{SimOptions, SimSensor};
use stspp::sync::Side;
use stspp::transport::{Transport, TransportError};
use stspp::{Error, PairStream, Sensor, SourceUri, StreamOptions, StreamStats};
use stspp_hil_sim::device::in_process::{InProcess, InProcessOptions, Injection};
use stspp_hil_sim::device::{Controller, PinEdge};

const SCENE: &str = "sim:plane?scale=16";

/// Times that each fault is injected.
const TIMES: u64 = 20;

/// A controller that the test can reach while the rig has it.
#[derive(Clone)]
struct Shared(Arc<Mutex<InProcess>>);

impl Shared {
    fn lock(&self) -> MutexGuard<'_, InProcess> {
        self.0.lock().unwrap()
    }
}

impl Controller for Shared {
    fn now_ns(&self) -> u64 {
        self.lock().now_ns()
    }
    fn host_write(&mut self, bytes: &[u8]) {
        self.lock().host_write(bytes);
    }
    fn host_read(&mut self, out: &mut Vec<u8>) {
        self.lock().host_read(out);
    }
    fn run_until(&mut self, time_ns: u64, edges: &mut Vec<PinEdge>) {
        self.lock().run_until(time_ns, edges);
    }
    fn set_interlock_closed(&mut self, closed: bool) {
        self.lock().set_interlock_closed(closed);
    }
    fn set_temperature_c(&mut self, temperature_c: f32) {
        self.lock().set_temperature_c(temperature_c);
    }
    fn set_trigger_in(&mut self, high: bool) {
        self.lock().set_trigger_in(high);
    }
    fn set_link_connected(&mut self, connected: bool) {
        self.lock().set_link_connected(connected);
    }
}

/// What is wrong right now; shared by link, cameras, clock and test.
#[derive(Default)]
struct Wrong {
    /// What happens to the next frame of the left or right camera.
    frames: Mutex<[VecDeque<FrameFault>; 2]>,
    /// The next read from the link is damaged so.
    link: Mutex<VecDeque<LinkFault>>,
    /// Reads from the link that give nothing; what is said meanwhile comes afterwards.
    silent_reads: AtomicU64,
    /// The left or right camera is unplugged.
    unplugged: [AtomicBool; 2],
    /// The control link's device is gone.
    link_gone: AtomicBool,
    /// What the host's clock is ahead of simulated time.
    ahead_ns: AtomicU64,
    damaged: [AtomicU64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum FrameFault {
    Lost,
    Damaged,
    Duplicated,
    /// So many frames are each delivered one late.
    Lagging(u32),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum LinkFault {
    /// A bit is flipped.
    Corrupt,
    /// The read ends early; the rest is lost.
    Short,
}

struct FaultyCameras {
    inner: Box<dyn CameraSource>,
    wrong: Arc<Wrong>,
    lag: [(u32, Option<CameraFrame>); 2],
    ready: VecDeque<CameraFrame>,
}

impl FaultyCameras {
    fn pass(&mut self, mut frame: CameraFrame) {
        frame.stamp.arrival_host_ns += self.wrong.ahead_ns.load(Ordering::Acquire);
        let at = frame.stamp.side.index();
        let fault = self.wrong.frames.lock().unwrap()[at].pop_front();
        match fault {
            Some(FrameFault::Lost) => return,
            Some(FrameFault::Damaged) => {
                self.wrong.damaged[at].fetch_add(1, Ordering::Relaxed);
                return;
            }
            Some(FrameFault::Duplicated) => self.ready.push_back(frame.clone()),
            Some(FrameFault::Lagging(frames)) => self.lag[at].0 = frames,
            None => {}
        }
        let (left, held) = &mut self.lag[at];
        if *left > 0 {
            *left -= 1;
            // The picture before this one comes now, at this one's time.
            let now_ns = frame.stamp.arrival_host_ns;
            if let Some(mut late) = held.replace(frame) {
                late.stamp.arrival_host_ns = now_ns;
                self.ready.push_back(late);
            }
            return;
        }
        if let Some(mut late) = held.take() {
            late.stamp.arrival_host_ns = frame.stamp.arrival_host_ns;
            self.ready.push_back(late);
        }
        self.ready.push_back(frame);
    }
}

impl CameraSource for FaultyCameras {
    fn start(&mut self) -> Result<(), CameraError> {
        self.ready.clear();
        self.lag = Default::default();
        for side in Side::BOTH {
            if self.wrong.unplugged[side.index()].load(Ordering::Acquire) {
                return Err(CameraError::Gone { side });
            }
        }
        self.inner.start()
    }

    fn stop(&mut self) {
        self.inner.stop();
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Option<CameraFrame>, CameraError> {
        for side in Side::BOTH {
            if self.wrong.unplugged[side.index()].load(Ordering::Acquire) {
                return Err(CameraError::Gone { side });
            }
        }
        if self.ready.is_empty()
            && let Some(frame) = self.inner.next_frame(timeout)?
        {
            self.pass(frame);
        }
        Ok(self.ready.pop_front())
    }

    fn damaged(&self) -> [u64; 2] {
        [0, 1].map(|at| self.wrong.damaged[at].load(Ordering::Relaxed))
    }

    fn is_lossless(&self) -> bool {
        self.inner.is_lossless()
    }
}

struct FaultyLink {
    inner: Box<dyn Transport>,
    wrong: Arc<Wrong>,
    held: Vec<u8>,
}

impl FaultyLink {
    fn check(&self) -> Result<(), TransportError> {
        if self.wrong.link_gone.load(Ordering::Acquire) {
            return Err(TransportError::Gone { link: "sim:".into() });
        }
        Ok(())
    }
}

impl Transport for FaultyLink {
    fn write(&mut self, bytes: &[u8], timeout: Duration) -> Result<(), TransportError> {
        self.check()?;
        self.inner.write(bytes, timeout)
    }

    fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> Result<usize, TransportError> {
        self.check()?;
        let mut bytes = Vec::new();
        self.inner.read(&mut bytes, timeout)?;
        self.held.append(&mut bytes);
        let silent = &self.wrong.silent_reads;
        if silent.load(Ordering::Acquire) > 0 {
            silent.fetch_sub(1, Ordering::AcqRel);
            return Ok(0);
        }
        let mut said = std::mem::take(&mut self.held);
        if said.len() > 4 {
            match self.wrong.link.lock().unwrap().pop_front() {
                Some(LinkFault::Corrupt) => {
                    let middle = said.len() / 2;
                    said[middle] ^= 0x24;
                }
                Some(LinkFault::Short) => said.truncate(said.len() / 2),
                None => {}
            }
        }
        let read = said.len();
        into.append(&mut said);
        Ok(read)
    }
}

/// Simulated time, ahead by what the host's clock was stepped.
#[derive(Debug)]
struct SteppedClock {
    inner: Arc<dyn Clock>,
    wrong: Arc<Wrong>,
}

impl std::fmt::Debug for Wrong {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Wrong")
    }
}

impl Clock for SteppedClock {
    fn now_ns(&self) -> u64 {
        self.inner.now_ns() + self.wrong.ahead_ns.load(Ordering::Acquire)
    }

    fn is_virtual(&self) -> bool {
        true
    }
}

struct Bench {
    sensor: Sensor,
    device: Shared,
    wrong: Arc<Wrong>,
}

impl Bench {
    fn new() -> Self {
        let source: SourceUri = SCENE.parse().unwrap();
        let SourceUri::Sim { scene, options } = &source else { unreachable!() };
        let options = SimOptions::parse(scene.as_deref(), options).unwrap();
        let device = Shared(Arc::new(Mutex::new(InProcess::new(InProcessOptions::seeded(1)))));
        let sim = SimSensor::with_controller(&options, Box::new(device.clone())).unwrap();
        let wrong = Arc::new(Wrong::default());
        let mut parts = sim.into_parts(source);
        parts.cameras = Box::new(FaultyCameras {
            inner: parts.cameras,
            wrong: Arc::clone(&wrong),
            lag: Default::default(),
            ready: VecDeque::new(),
        });
        let held = Vec::new();
        parts.transport =
            Box::new(FaultyLink { inner: parts.transport, wrong: Arc::clone(&wrong), held });
        parts.clock = Arc::new(SteppedClock { inner: parts.clock, wrong: Arc::clone(&wrong) });
        Self { sensor: Sensor::from_parts(parts).unwrap(), device, wrong }
    }
}

/// Pairs that were looked at, and how many of them were under a wrong label.
struct Judge {
    witness: Witness,
    pairs: u64,
    wrong: u64,
}

impl Judge {
    fn look(&mut self, pair: &stspp::LabelledPair) {
        let slot = usize::from(pair.label.slot);
        let shown = [(Side::Left, &pair.left), (Side::Right, &pair.right)];
        let right = shown.iter().all(|(side, image)| self.witness.projector(*side, image) == slot);
        self.pairs += 1;
        self.wrong += u64::from(!right);
    }

    /// Takes `count` pairs; the error that ended the stream before that, if one did.
    fn take(&mut self, stream: &mut PairStream, count: u64) -> Option<Error> {
        for _ in 0..count {
            match stream.next()? {
                Ok(pair) => self.look(&pair),
                Err(error) => return Some(error),
            }
        }
        None
    }
}

fn accounted(stats: &StreamStats) -> bool {
    stats.frames_left + stats.frames_right
        == 2 * stats.pairs + stats.rejected.total() + stats.dropped_capture
}

/// A fault, by its name and by what it does; `left` is a random side.
struct Fault {
    name: &'static str,
    inject: fn(&Bench, &mut Dice),
    /// What is mended before the stream is started again.
    mend: fn(&mut Bench),
    /// Whether the stream ends with an error, and whether that is the right one.
    error: Option<fn(&Error) -> bool>,
}

fn frame_fault(bench: &Bench, dice: &mut Dice, fault: FrameFault) {
    let side = dice.roll(2) as usize;
    bench.wrong.frames.lock().unwrap()[side].push_back(fault);
}

fn faults() -> Vec<Fault> {
    let goes_on = |name, inject| Fault { name, inject, mend: |_| {}, error: None };
    let gone: fn(&Error) -> bool =
        |error| matches!(error, Error::Transport(TransportError::Gone { .. }) | Error::Timeout(_));
    let faulted: fn(&Error) -> bool = |error| {
        matches!(error, Error::Faulted(_) | Error::DeviceReset(_) | Error::Timeout(_))
            || matches!(error, Error::Refused { .. })
    };
    let clear: fn(&mut Bench) = |bench| {
        bench.sensor.reconnect(Duration::from_secs(1)).unwrap();
        bench.sensor.clear_faults().unwrap();
    };
    vec![
        goes_on("lost camera frame", |b, d| frame_fault(b, d, FrameFault::Lost)),
        goes_on("corrupt camera payload", |b, d| frame_fault(b, d, FrameFault::Damaged)),
        goes_on("duplicated camera frame", |b, d| frame_fault(b, d, FrameFault::Duplicated)),
        goes_on("camera lags by a frame", |b, d| {
            let frames = 2 + d.roll(6) as u32;
            frame_fault(b, d, FrameFault::Lagging(frames));
        }),
        goes_on("lost trigger event", |b, _| b.device.lock().inject(Injection::LoseNextEvent)),
        goes_on("duplicated trigger event", |b, _| {
            b.device.lock().inject(Injection::DuplicateNextEvent);
        }),
        goes_on("corrupt payload", |b, _| {
            b.wrong.link.lock().unwrap().push_back(LinkFault::Corrupt);
        }),
        goes_on("short packet", |b, _| b.wrong.link.lock().unwrap().push_back(LinkFault::Short)),
        goes_on("link stalls", |b, d| {
            b.wrong.silent_reads.store(5 + d.roll(40), Ordering::Release);
        }),
        goes_on("host clock steps", |b, d| {
            b.wrong.ahead_ns.fetch_add(1_000_000 * (1 + d.roll(900)), Ordering::AcqRel);
        }),
        Fault {
            name: "control unplugged",
            inject: |b, _| {
                b.wrong.link_gone.store(true, Ordering::Release);
                b.device.lock().set_link_connected(false);
            },
            mend: |b| {
                b.wrong.link_gone.store(false, Ordering::Release);
                b.device.lock().set_link_connected(true);
                b.sensor.reconnect(Duration::from_secs(1)).unwrap();
            },
            error: Some(gone),
        },
        Fault {
            name: "camera unplugged",
            inject: |b, d| b.wrong.unplugged[d.roll(2) as usize].store(true, Ordering::Release),
            mend: |b| {
                assert!(matches!(b.sensor.try_start(), Err(Error::Camera(_))));
                b.wrong.unplugged.iter().for_each(|u| u.store(false, Ordering::Release));
            },
            error: Some(|error| matches!(error, Error::Camera(CameraError::Gone { .. }))),
        },
        Fault {
            name: "device reset",
            inject: |b, d| {
                let reset = [Injection::PinReset, Injection::PowerCycle][d.roll(2) as usize];
                b.device.lock().inject(reset);
            },
            mend: clear,
            error: Some(faulted),
        },
        Fault {
            name: "firmware fault",
            inject: |b, d| {
                let all = [Injection::Panic, Injection::HardFault, Injection::Hang];
                b.device.lock().inject(all[d.roll(3) as usize]);
            },
            mend: clear,
            error: Some(faulted),
        },
    ]
}

/// Injects one fault twenty times; how often the stream went on, or ended rightly and came back.
fn run(fault: &Fault, judge: &mut Judge, seed: u64) -> (u64, u64) {
    let mut bench = Bench::new();
    let mut dice = Dice(seed);
    let (mut injected, mut survived) = (0, 0);
    let options = StreamOptions::default();
    let mut stream = bench.sensor.pairs(&options).unwrap();
    while injected < TIMES {
        let before = 4 + dice.roll(9);
        let early = judge.take(&mut stream, before);
        assert!(early.is_none(), "{}: {}", fault.name, early.unwrap());
        (fault.inject)(&bench, &mut dice);
        injected += 1;
        match fault.error {
            None => {
                let error = judge.take(&mut stream, 6 + dice.roll(6));
                assert!(error.is_none(), "{}: {}", fault.name, error.unwrap());
                survived += 1;
            }
            Some(is_right) => {
                let error = judge.take(&mut stream, 200);
                let error = error.unwrap_or_else(|| panic!("{}: nothing noticed", fault.name));
                assert!(is_right(&error), "{}: {error}", fault.name);
                let stats = stream.finish();
                assert!(accounted(&stats), "{}: {stats:?}", fault.name);
                (fault.mend)(&mut bench);
                stream = bench
                    .sensor
                    .pairs(&options)
                    .unwrap_or_else(|error| panic!("{}, started again: {error}", fault.name));
                let error = judge.take(&mut stream, 5);
                assert!(error.is_none(), "{}, resumed: {}", fault.name, error.unwrap());
                survived += 1;
            }
        }
    }
    let stats = stream.finish();
    assert!(accounted(&stats), "{}: {stats:?}", fault.name);
    (injected, survived)
}

#[test]
fn every_fault_is_survived_without_a_wrong_label() {
    let mut judge = Judge { witness: Witness::learn(SCENE), pairs: 0, wrong: 0 };
    println!("{:<26} {:>8} {:>8} {:>8} {:>6}", "fault", "injected", "survived", "pairs", "wrong");
    for (number, fault) in faults().iter().enumerate() {
        let (pairs, wrong) = (judge.pairs, judge.wrong);
        let (injected, survived) = run(fault, &mut judge, 1 + number as u64);
        let (pairs, wrong) = (judge.pairs - pairs, judge.wrong - wrong);
        println!("{:<26} {injected:>8} {survived:>8} {pairs:>8} {wrong:>6}", fault.name);
        assert_eq!((survived, wrong), (injected, 0), "{}", fault.name);
    }
}

/// Resident memory in MiB.
fn resident_mib() -> f64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages: f64 = statm.split_whitespace().nth(1).and_then(|n| n.parse().ok()).unwrap_or(0.0);
    pages * 4096.0 / f64::from(1 << 20)
}

#[test]
fn ten_simulated_minutes_lose_nothing_and_keep_memory_flat() {
    const PAIRS: u64 = 10 * 60 * 30;
    let mut sensor = Sensor::open(SCENE).unwrap();
    let mut stream = sensor.pairs(&StreamOptions::default()).unwrap();
    let mut next = None;
    let mut early_mib = 0.0;
    for k in 0..PAIRS {
        let label = stream.next().unwrap().unwrap().label;
        assert!(next.is_none_or(|next| next == label.sequence), "{label:?}");
        assert_eq!(label.slot, (label.sequence % 10) as u16);
        next = Some(label.sequence + 1);
        if k == PAIRS / 10 {
            early_mib = resident_mib();
        }
    }
    let grown_mib = resident_mib() - early_mib;
    let stats = stream.finish();
    println!(
        "{PAIRS} pairs, memory grew by {grown_mib:.1} MiB, {} rejected",
        stats.rejected.total()
    );
    assert!(accounted(&stats), "{stats:?}");
    assert_eq!(stats.events_lost + stats.missing_left + stats.missing_right, 0, "{stats:?}");
    assert!(stats.rejected.total() == stats.rejected.discarded, "{stats:?}");
    assert!(grown_mib < 16.0, "memory grew by {grown_mib:.1} MiB");
}
