//! Virtual time, and what joins controller and cameras: the pins.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use stspp_hil_sim::device::{Controller, Line, PinEdge};
use stspp_hil_sim::world::{LightInterval, LightSource};

use super::options::Pace;
use crate::clock::{Clock, MonotonicClock, VirtualClock, duration_ns};
use crate::sync::Side;

/// Longest stretch of time that passes at once: events and frames are stamped to this.
const STEP_NS: u64 = 500_000;

/// Frames that a camera keeps for a host that does not fetch them, as a driver's buffers do.
const FRAMES_KEPT: usize = 8;

/// With simulated time nobody is late, unless the host asks other things and never fetches frames.
const FRAMES_KEPT_FAST: usize = 256;

/// Read-out of a 1280x1024 sensor; the next exposure may end no sooner.
const READOUT_FULL_NS: u64 = 9_000_000;

/// An exposure that a camera made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exposure {
    /// Which camera.
    pub side: Side,
    /// The camera's count since it was started.
    pub sequence: u32,
    /// Trigger rose.
    pub open_ns: u64,
    /// Trigger fell.
    pub close_ns: u64,
    /// The frame is complete on the host.
    pub ready_ns: u64,
    /// Lights that were on in between.
    pub lights: Vec<LightInterval>,
}

#[derive(Debug, Default)]
struct CameraState {
    started: bool,
    sequence: u32,
    open_ns: Option<u64>,
    last_close_ns: Option<u64>,
    frames: VecDeque<Exposure>,
}

/// A controller, its pins, and the time that passes for all.
pub struct Rig {
    controller: Box<dyn Controller>,
    clock: Arc<VirtualClock>,
    wall: Option<(Arc<MonotonicClock>, Instant)>,
    readout_ns: u64,
    edges: Vec<PinEdge>,
    on: Vec<(LightSource, u64)>,
    past: VecDeque<LightInterval>,
    cameras: [CameraState; 2],
    inbox: Vec<u8>,
    watch: Option<Vec<PinEdge>>,
}

/// Read-out time of a camera of so many pixels.
pub fn readout_ns(pixels: usize) -> u64 {
    (READOUT_FULL_NS * pixels as u64 / (1280 * 1024)).max(50_000)
}

impl Rig {
    /// Joins `controller` to two cameras with the given read-out time.
    pub fn new(controller: Box<dyn Controller>, pace: Pace, readout_ns: u64) -> Self {
        let wall = (pace == Pace::Real).then(|| (Arc::new(MonotonicClock::new()), Instant::now()));
        Self {
            controller,
            clock: Arc::new(VirtualClock::new()),
            wall,
            readout_ns,
            edges: Vec::new(),
            on: Vec::new(),
            past: VecDeque::new(),
            cameras: Default::default(),
            inbox: Vec::new(),
            watch: None,
        }
    }

    /// The clock of this rig's time.
    pub fn clock(&self) -> Arc<dyn Clock> {
        match &self.wall {
            Some((clock, _)) => Arc::clone(clock) as Arc<dyn Clock>,
            None => Arc::clone(&self.clock) as Arc<dyn Clock>,
        }
    }

    /// The controller, for inputs such as the interlock.
    pub fn controller(&mut self) -> &mut dyn Controller {
        self.controller.as_mut()
    }

    /// Keeps all pin edges from now on, for [`Rig::watched`].
    pub fn watch(&mut self) {
        self.watch = Some(Vec::new());
    }

    /// Takes the pin edges since the last call.
    pub fn watched(&mut self) -> Vec<PinEdge> {
        self.watch.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// Lights that are on now.
    pub fn lit(&self) -> Vec<LightSource> {
        self.on.iter().map(|(source, _)| *source).collect()
    }

    /// Gives bytes to the controller, now.
    pub fn write(&mut self, bytes: &[u8]) {
        self.controller.host_write(bytes);
    }

    /// Moves the bytes that the controller has sent to `into`, waiting for some up to `timeout`.
    pub fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> usize {
        self.wait(timeout, |rig| !rig.inbox.is_empty());
        let read = self.inbox.len();
        into.append(&mut self.inbox);
        read
    }

    /// Starts both cameras, counting from 0.
    pub fn start_cameras(&mut self) {
        for camera in &mut self.cameras {
            *camera = CameraState { started: true, ..CameraState::default() };
        }
    }

    /// Stops both cameras.
    pub fn stop_cameras(&mut self) {
        self.cameras = Default::default();
    }

    /// The oldest complete exposure of either camera, waiting for one up to `timeout`.
    pub fn next_exposure(&mut self, timeout: Duration) -> Option<Exposure> {
        self.wait(timeout, |rig| rig.ready_side().is_some());
        let side = self.ready_side()?;
        self.cameras[side.index()].frames.pop_front()
    }

    fn ready_side(&self) -> Option<Side> {
        let now_ns = self.controller.now_ns();
        Side::BOTH
            .into_iter()
            .filter_map(|side| Some((self.cameras[side.index()].frames.front()?.ready_ns, side)))
            .filter(|(ready_ns, _)| *ready_ns <= now_ns)
            .min_by_key(|(ready_ns, _)| *ready_ns)
            .map(|(_, side)| side)
    }

    /// Lets time pass until `done`, at most `timeout`.
    fn wait(&mut self, timeout: Duration, done: impl Fn(&Self) -> bool) {
        let deadline_ns = match &self.wall {
            Some((clock, _)) => clock.now_ns().saturating_add(duration_ns(timeout)),
            None => self.controller.now_ns().saturating_add(duration_ns(timeout)),
        };
        loop {
            self.catch_up();
            if done(self) {
                return;
            }
            let now_ns = self.controller.now_ns();
            if now_ns >= deadline_ns {
                return;
            }
            if self.wall.is_some() {
                std::thread::sleep(Duration::from_nanos(STEP_NS.min(deadline_ns - now_ns)));
            } else {
                self.step(deadline_ns.min(now_ns + STEP_NS));
            }
        }
    }

    /// Lets the controller catch up with the wall clock, where that sets the pace.
    fn catch_up(&mut self) {
        let Some((clock, _)) = &self.wall else {
            let now_ns = self.controller.now_ns();
            return self.step(now_ns);
        };
        let wall_ns = clock.now_ns();
        while self.controller.now_ns() < wall_ns {
            let next_ns = wall_ns.min(self.controller.now_ns() + STEP_NS);
            self.step(next_ns);
        }
    }

    fn step(&mut self, to_ns: u64) {
        let mut edges = std::mem::take(&mut self.edges);
        self.controller.run_until(to_ns, &mut edges);
        for edge in edges.drain(..) {
            self.apply(edge);
            if let Some(watch) = &mut self.watch {
                watch.push(edge);
            }
        }
        self.edges = edges;
        self.controller.host_read(&mut self.inbox);
        self.clock.advance_to_ns(self.controller.now_ns());
    }

    fn apply(&mut self, edge: PinEdge) {
        let source = match edge.line {
            Line::Projector(index) => LightSource::Projector(index),
            Line::Floodlight => LightSource::Floodlight,
            Line::CameraTrigger(camera) => {
                let side = if camera == 0 { Side::Left } else { Side::Right };
                return self.trigger(side, edge);
            }
        };
        if edge.high {
            if !self.on.iter().any(|(lit, _)| *lit == source) {
                self.on.push((source, edge.time_ns));
            }
        } else if let Some(at) = self.on.iter().position(|(lit, _)| *lit == source) {
            let (_, on_ns) = self.on.swap_remove(at);
            self.past.push_back(LightInterval { source, on_ns, off_ns: edge.time_ns });
        }
    }

    fn trigger(&mut self, side: Side, edge: PinEdge) {
        let camera = &mut self.cameras[side.index()];
        if edge.high {
            camera.open_ns = camera.started.then_some(edge.time_ns);
            return;
        }
        let Some(open_ns) = camera.open_ns.take() else { return };
        let close_ns = edge.time_ns;
        // The sensor is still being read out: this exposure is lost, and not counted.
        if camera.last_close_ns.is_some_and(|last_ns| close_ns < last_ns + self.readout_ns) {
            return;
        }
        camera.last_close_ns = Some(close_ns);
        let still_on = self.on.iter().map(|&(source, on_ns)| LightInterval {
            source,
            on_ns,
            off_ns: close_ns,
        });
        let lights = self
            .past
            .iter()
            .copied()
            .chain(still_on)
            .filter(|light| light.off_ns > open_ns && light.on_ns < close_ns)
            .collect();
        // The right camera's cable is longer.
        let ready_ns = close_ns + self.readout_ns + 20_000 * side.index() as u64;
        let sequence = camera.sequence;
        camera.sequence += 1;
        camera.frames.push_back(Exposure { side, sequence, open_ns, close_ns, ready_ns, lights });
        let kept = if self.wall.is_some() { FRAMES_KEPT } else { FRAMES_KEPT_FAST };
        if camera.frames.len() > kept {
            camera.frames.pop_front();
        }
        // What ended before the oldest exposure that can still be open is never looked at again.
        let oldest_ns = self.cameras.iter().filter_map(|c| c.open_ns).fold(open_ns, u64::min);
        while self.past.front().is_some_and(|light| light.off_ns <= oldest_ns) {
            self.past.pop_front();
        }
    }
}
