//! The simulated sensor's time: as fast as frames are consumed, or as the wall clock says.

use std::sync::Arc;
use std::time::Duration;

use stspp_hil_sim::device::{Controller, PinEdge};
use stspp_hil_sim::rig::{self, Exposure, STEP_NS};
use stspp_hil_sim::world::LightSource;

use super::options::Pace;
use crate::clock::{Clock, MonotonicClock, VirtualClock, duration_ns};

/// Frames that a camera keeps for a host that does not fetch them, as a driver's buffers do.
const FRAMES_KEPT: usize = 8;

/// With simulated time nobody is late, unless the host asks other things and never fetches frames.
const FRAMES_KEPT_FAST: usize = 256;

/// A controller, its pins and cameras, and the pace of their time.
pub struct Rig {
    inner: rig::Rig,
    clock: Arc<VirtualClock>,
    wall: Option<Arc<MonotonicClock>>,
    generator: Option<Generator>,
}

/// What another machine does at trigger-in: a square wave.
struct Generator {
    half_period_ns: u64,
    /// Time of its next edge.
    next_ns: u64,
    high: bool,
}

impl Rig {
    /// Joins `controller` to two cameras with the given read-out time.
    pub fn new(controller: Box<dyn Controller>, pace: Pace, readout_ns: u64) -> Self {
        let wall = (pace == Pace::Real).then(|| Arc::new(MonotonicClock::new()));
        let kept = if wall.is_some() { FRAMES_KEPT } else { FRAMES_KEPT_FAST };
        let inner = rig::Rig::new(controller, readout_ns, kept);
        Self { inner, clock: Arc::new(VirtualClock::new()), wall, generator: None }
    }

    /// Connects a square wave with `hz` rising edges a second to trigger-in; 0 disconnects it.
    pub fn generate_trigger(&mut self, hz: f64) {
        self.inner.controller().set_trigger_in(false);
        let half_period_ns = (0.5e9 / hz) as u64;
        let next_ns = self.inner.now_ns().saturating_add(half_period_ns);
        self.generator = (hz > 0.0).then_some(Generator { half_period_ns, next_ns, high: false });
    }

    /// The clock of this rig's time.
    pub fn clock(&self) -> Arc<dyn Clock> {
        match &self.wall {
            Some(clock) => Arc::clone(clock) as Arc<dyn Clock>,
            None => Arc::clone(&self.clock) as Arc<dyn Clock>,
        }
    }

    /// The controller, for inputs such as the interlock.
    pub fn controller(&mut self) -> &mut dyn Controller {
        self.inner.controller()
    }

    /// Keeps all pin edges from now on, for [`Rig::watched`].
    pub fn watch(&mut self) {
        self.inner.watch();
    }

    /// Takes the pin edges since the last call.
    pub fn watched(&mut self) -> Vec<PinEdge> {
        self.inner.watched()
    }

    /// Lights that are on now.
    pub fn lit(&self) -> Vec<LightSource> {
        self.inner.lit()
    }

    /// Gives bytes to the controller, now.
    pub fn write(&mut self, bytes: &[u8]) {
        self.inner.write(bytes);
    }

    /// Moves the bytes that the controller has sent to `into`, waiting for some up to `timeout`.
    pub fn read(&mut self, into: &mut Vec<u8>, timeout: Duration) -> usize {
        self.wait(timeout, rig::Rig::has_replied);
        self.inner.take_replies(into)
    }

    /// Starts both cameras, counting from 0.
    pub fn start_cameras(&mut self) {
        rig::CAMERAS.into_iter().for_each(|camera| self.inner.start_camera(camera));
    }

    /// Stops both cameras.
    pub fn stop_cameras(&mut self) {
        rig::CAMERAS.into_iter().for_each(|camera| self.inner.stop_camera(camera));
    }

    /// The oldest complete exposure of either camera, waiting for one up to `timeout`.
    pub fn next_exposure(&mut self, timeout: Duration) -> Option<Exposure> {
        self.wait(timeout, |rig| rig.ready_camera().is_some());
        let camera = self.inner.ready_camera()?;
        self.inner.take_ready(camera)
    }

    /// Lets time pass until `done`, at most `timeout`.
    fn wait(&mut self, timeout: Duration, done: impl Fn(&rig::Rig) -> bool) {
        let start_ns = self.wall.as_ref().map_or_else(|| self.inner.now_ns(), |c| c.now_ns());
        let deadline_ns = start_ns.saturating_add(duration_ns(timeout));
        loop {
            self.catch_up();
            if done(&self.inner) {
                return;
            }
            let now_ns = self.inner.now_ns();
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
        let Some(clock) = &self.wall else {
            let now_ns = self.inner.now_ns();
            return self.step(now_ns);
        };
        let wall_ns = clock.now_ns();
        while self.inner.now_ns() < wall_ns {
            let next_ns = wall_ns.min(self.inner.now_ns() + STEP_NS);
            self.step(next_ns);
        }
    }

    fn step(&mut self, to_ns: u64) {
        while let Some(generator) = self.generator.as_mut().filter(|g| g.next_ns < to_ns) {
            self.inner.advance(generator.next_ns);
            generator.high = !generator.high;
            generator.next_ns += generator.half_period_ns;
            self.inner.controller().set_trigger_in(generator.high);
        }
        self.inner.advance(to_ns);
        self.clock.advance_to_ns(self.inner.now_ns());
    }
}
