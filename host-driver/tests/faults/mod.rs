//! A simulated sensor whose link, cameras, clock and controller can be disturbed, and the faults that
//! they can have.
#![allow(dead_code, reason = "each test file uses its part")]

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use stspp::camera::{CameraError, CameraFrame, CameraSource};
use stspp::clock::Clock;
use stspp::sim::{SimOptions, SimSensor};
use stspp::sync::Side;
use stspp::transport::{Transport, TransportError};
use stspp::{Error, RawImage, Sensor, SourceUri, StreamStats};
use stspp_hil_sim::device::in_process::{InProcess, InProcessOptions, Injection};
use stspp_hil_sim::device::{Controller, PinEdge};
use stspp_hil_sim::world::World;

use crate::live::Dice;

/// What is disturbed.
pub const SCENE: &str = "sim:plane?scale=16";

/// Times that each fault is injected.
pub const TIMES: u64 = 20;

/// A controller that the test can reach while the rig has it.
#[derive(Clone)]
pub struct Shared(Arc<Mutex<InProcess>>);

impl Shared {
    pub fn lock(&self) -> MutexGuard<'_, InProcess> {
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
pub struct Wrong {
    /// What happens to the next frame of the left or right camera.
    pub frames: Mutex<[VecDeque<FrameFault>; 2]>,
    /// The next read from the link is damaged so.
    pub link: Mutex<VecDeque<LinkFault>>,
    /// Reads from the link that give nothing; what is said meanwhile comes afterwards.
    pub silent_reads: AtomicU64,
    /// The left or right camera is unplugged.
    pub unplugged: [AtomicBool; 2],
    /// The control link's device is gone.
    pub link_gone: AtomicBool,
    /// What the host's clock is ahead of simulated time.
    pub ahead_ns: AtomicU64,
    damaged: [AtomicU64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FrameFault {
    Lost,
    Damaged,
    Duplicated,
    /// So many frames are each delivered one late.
    Lagging(u32),
    /// So many frames have the picture before theirs, which nothing on their way could tell: what a
    /// wrong label would do.
    Foreign(u32),
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LinkFault {
    /// A bit is flipped.
    Corrupt,
    /// The read ends early; the rest is lost.
    Short,
}

struct FaultyCameras {
    inner: Box<dyn CameraSource>,
    wrong: Arc<Wrong>,
    lag: [(u32, Option<CameraFrame>); 2],
    foreign: [(u32, Option<RawImage>); 2],
    ready: VecDeque<CameraFrame>,
}

impl FaultyCameras {
    fn pass(&mut self, mut frame: CameraFrame) {
        frame.stamp.arrival_host_ns += self.wrong.ahead_ns.load(Ordering::Acquire);
        let at = frame.stamp.side.index();
        let (left, before) = &mut self.foreign[at];
        let before = before.replace(frame.image.clone());
        if let (1.., Some(before)) = (*left, before) {
            *left -= 1;
            frame.image = before;
        }
        let fault = self.wrong.frames.lock().unwrap()[at].pop_front();
        match fault {
            Some(FrameFault::Lost) => return,
            Some(FrameFault::Damaged) => {
                self.wrong.damaged[at].fetch_add(1, Ordering::Relaxed);
                return;
            }
            Some(FrameFault::Duplicated) => self.ready.push_back(frame.clone()),
            Some(FrameFault::Lagging(frames)) => self.lag[at].0 = frames,
            Some(FrameFault::Foreign(frames)) => self.foreign[at].0 = frames,
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

pub struct Bench {
    pub sensor: Sensor,
    pub device: Shared,
    pub wrong: Arc<Wrong>,
    pub world: Arc<World>,
}

impl Bench {
    pub fn new() -> Self {
        let source: SourceUri = SCENE.parse().unwrap();
        let SourceUri::Sim { scene, options } = &source else { unreachable!() };
        let options = SimOptions::parse(scene.as_deref(), options).unwrap();
        let device = Shared(Arc::new(Mutex::new(InProcess::new(InProcessOptions::seeded(1)))));
        let sim = SimSensor::with_controller(&options, Box::new(device.clone())).unwrap();
        let wrong = Arc::new(Wrong::default());
        let world = Arc::clone(&sim.world);
        let mut parts = sim.into_parts(source);
        parts.cameras = Box::new(FaultyCameras {
            inner: parts.cameras,
            wrong: Arc::clone(&wrong),
            lag: Default::default(),
            foreign: Default::default(),
            ready: VecDeque::new(),
        });
        let held = Vec::new();
        parts.transport =
            Box::new(FaultyLink { inner: parts.transport, wrong: Arc::clone(&wrong), held });
        parts.clock = Arc::new(SteppedClock { inner: parts.clock, wrong: Arc::clone(&wrong) });
        Self { sensor: Sensor::from_parts(parts).unwrap(), device, wrong, world }
    }
}

/// Every frame is in a pair, rejected by a cause, or dropped.
pub fn accounted(stats: &StreamStats) -> bool {
    stats.frames_left + stats.frames_right
        == 2 * stats.pairs + stats.rejected.total() + stats.dropped_capture
}

/// A fault, by its name and by what it does; `left` is a random side.
pub struct Fault {
    pub name: &'static str,
    pub inject: fn(&Bench, &mut Dice),
    /// What is mended before the stream is started again.
    pub mend: fn(&mut Bench),
    /// Whether the stream ends with an error, and whether that is the right one.
    pub error: Option<fn(&Error) -> bool>,
}

/// A stream that is disturbed, and what looks at what it delivers.
pub trait Watch {
    type Item;
    type Stream: Iterator<Item = Result<Self::Item, Error>>;
    /// Items that are looked at after a stream was started again.
    const RESUMED: u64;

    fn start(&self, sensor: &mut Sensor) -> Result<Self::Stream, Error>;
    fn stats(stream: &Self::Stream) -> StreamStats;
    fn finish(stream: Self::Stream) -> StreamStats;

    /// Looks at an item; whether it is right.
    fn look(&mut self, item: &Self::Item) -> bool;

    /// Items before a fault, and after one that the stream survives.
    fn before(dice: &mut Dice) -> u64;
    fn after(dice: &mut Dice) -> u64;
}

/// Items looked at, and how many of them were wrong.
#[derive(Default)]
struct Seen {
    items: u64,
    wrong: u64,
}

impl Seen {
    /// Takes `count` items; the error that ended the stream before that, if one did.
    fn take<W: Watch>(
        &mut self,
        watch: &mut W,
        stream: &mut W::Stream,
        count: u64,
    ) -> Option<Error> {
        for _ in 0..count {
            match stream.next()? {
                Ok(item) => {
                    self.items += 1;
                    self.wrong += u64::from(!watch.look(&item));
                }
                Err(error) => return Some(error),
            }
        }
        None
    }
}

/// Injects one fault [`TIMES`] times; how often the stream went on, or ended rightly and came back.
fn run<W: Watch>(fault: &Fault, watch: &mut W, seen: &mut Seen, seed: u64) -> (u64, u64) {
    let mut bench = Bench::new();
    let mut dice = Dice(seed);
    let (mut injected, mut survived) = (0, 0);
    let mut stream = watch.start(&mut bench.sensor).unwrap();
    while injected < TIMES {
        let early = seen.take(watch, &mut stream, W::before(&mut dice));
        assert!(early.is_none(), "{}: {}", fault.name, early.unwrap());
        (fault.inject)(&bench, &mut dice);
        injected += 1;
        // What is on its way still comes.
        match fault.error {
            None => {
                let error = seen.take(watch, &mut stream, W::after(&mut dice));
                let stats = W::stats(&stream);
                assert!(error.is_none(), "{}: {}, {stats:?}", fault.name, error.unwrap());
            }
            Some(is_right) => {
                let error = seen.take(watch, &mut stream, 200);
                let error = error.unwrap_or_else(|| panic!("{}: nothing noticed", fault.name));
                assert!(is_right(&error), "{}: {error}", fault.name);
                let stats = W::finish(stream);
                assert!(accounted(&stats), "{}: {stats:?}", fault.name);
                (fault.mend)(&mut bench);
                stream = watch
                    .start(&mut bench.sensor)
                    .unwrap_or_else(|error| panic!("{}, started again: {error}", fault.name));
                let error = seen.take(watch, &mut stream, W::RESUMED);
                assert!(error.is_none(), "{}, resumed: {}", fault.name, error.unwrap());
            }
        }
        survived += 1;
    }
    let stats = W::finish(stream);
    assert!(accounted(&stats), "{}: {stats:?}", fault.name);
    (injected, survived)
}

/// Injects all faults, prints a table, and holds that each was survived and no item wrong. Seeds begin
/// at `seed`.
pub fn run_all<W: Watch>(watch: &mut W, items: &str, seed: u64) {
    println!("{:<26} {:>8} {:>8} {items:>8} {:>6}", "fault", "injected", "survived", "wrong");
    for (number, fault) in faults().iter().enumerate() {
        let mut seen = Seen::default();
        let (injected, survived) = run(fault, watch, &mut seen, seed + number as u64);
        let Seen { items, wrong } = seen;
        println!("{:<26} {injected:>8} {survived:>8} {items:>8} {wrong:>6}", fault.name);
        assert_eq!((survived, wrong), (injected, 0), "{}", fault.name);
        assert!(items >= TIMES, "{}: {items} looked at", fault.name);
    }
}

/// Disturbs the next frame of one of the cameras.
pub fn frame_fault(bench: &Bench, dice: &mut Dice, fault: FrameFault) {
    let side = dice.roll(2) as usize;
    bench.wrong.frames.lock().unwrap()[side].push_back(fault);
}

/// All faults.
pub fn faults() -> Vec<Fault> {
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
