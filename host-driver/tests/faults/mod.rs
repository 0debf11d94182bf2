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
