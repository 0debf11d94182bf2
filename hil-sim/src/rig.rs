//! What joins a controller and two cameras: the pins, and the virtual time that passes for all.
//!
//! The cameras expose while their trigger pins are high, whatever is lit, count their exposures and
//! keep them until somebody fetches them. Nothing here labels an exposure. Who lets time pass decides
//! how fast: as a consumer takes frames, or as a wall clock says.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::device::{Controller, Line, PinEdge};
use crate::world::{Camera, LightInterval, LightSource};

/// Longest stretch of time that should pass at once: events and frames are stamped to this.
pub const STEP_NS: u64 = 500_000;

/// Read-out of a 1280x1024 sensor; the next exposure may end no sooner.
const READOUT_FULL_NS: u64 = 9_000_000;

/// The right camera's cable is longer.
const RIGHT_DELAY_NS: u64 = 20_000;

/// Both cameras, left first.
pub const CAMERAS: [Camera; 2] = [Camera::Left, Camera::Right];

/// An exposure that a camera made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exposure {
    /// Which camera.
    pub camera: Camera,
    /// The camera's count since it was started.
    pub sequence: u32,
    /// Trigger rose.
    pub open_ns: u64,
    /// Trigger fell, or the camera's longest exposure was over.
    pub close_ns: u64,
    /// The frame is read out.
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
    longest_ns: Option<u64>,
    frames: VecDeque<Exposure>,
    lost: u64,
}

/// A controller, its pins, and two cameras.
pub struct Rig {
    controller: Box<dyn Controller>,
    readout_ns: u64,
    frames_kept: usize,
    edges: Vec<PinEdge>,
    on: Vec<(LightSource, u64)>,
    past: VecDeque<LightInterval>,
    cameras: [CameraState; 2],
    inbox: Vec<u8>,
    watch: Option<Vec<PinEdge>>,
    backlog: Arc<AtomicUsize>,
}

/// Read-out time of a camera of so many pixels.
#[must_use]
pub fn readout_ns(pixels: usize) -> u64 {
    (READOUT_FULL_NS * pixels as u64 / (1280 * 1024)).max(50_000)
}

fn index(camera: Camera) -> usize {
    match camera {
        Camera::Left => 0,
        Camera::Right => 1,
    }
}

impl Rig {
    /// Joins `controller` to two cameras with the given read-out time, each of which keeps
    /// `frames_kept` exposures for a host that does not fetch them.
    #[must_use]
    pub fn new(controller: Box<dyn Controller>, readout_ns: u64, frames_kept: usize) -> Self {
        Self {
            controller,
            readout_ns,
            frames_kept,
            edges: Vec::new(),
            on: Vec::new(),
            past: VecDeque::new(),
            cameras: Default::default(),
            inbox: Vec::new(),
            watch: None,
            backlog: Arc::default(),
        }
    }

    /// Virtual time.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        self.controller.now_ns()
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
    #[must_use]
    pub fn lit(&self) -> Vec<LightSource> {
        self.on.iter().map(|(source, _)| *source).collect()
    }

    /// Gives bytes of the control link to the controller, now.
    pub fn write(&mut self, bytes: &[u8]) {
        self.controller.host_write(bytes);
    }

    /// Whether the controller has sent something.
    #[must_use]
    pub fn has_replied(&self) -> bool {
        !self.inbox.is_empty()
    }

    /// Moves the bytes that the controller has sent to `into`; says how many.
    pub fn take_replies(&mut self, into: &mut Vec<u8>) -> usize {
        let taken = self.inbox.len();
        into.append(&mut self.inbox);
        taken
    }

    /// Starts a camera, counting from 0. Its longest exposure stays as set.
    pub fn start_camera(&mut self, camera: Camera) {
        let state = &mut self.cameras[index(camera)];
        let longest_ns = state.longest_ns;
        *state = CameraState { started: true, longest_ns, ..CameraState::default() };
    }

    /// Stops a camera and forgets what it kept.
    pub fn stop_camera(&mut self, camera: Camera) {
        let state = &mut self.cameras[index(camera)];
        let longest_ns = state.longest_ns;
        *state = CameraState { longest_ns, ..CameraState::default() };
        self.count_backlog();
    }

    /// Ends a camera's exposures after this time even while its trigger stays high.
    pub fn set_longest_exposure_ns(&mut self, camera: Camera, longest_ns: Option<u64>) {
        self.cameras[index(camera)].longest_ns = longest_ns;
    }

    /// Exposures of a camera that nobody fetched in time, since it was started.
    #[must_use]
    pub fn frames_lost(&self, camera: Camera) -> u64 {
        self.cameras[index(camera)].lost
    }

    /// Exposures of a camera since it was started.
    #[must_use]
    pub fn frames_made(&self, camera: Camera) -> u32 {
        self.cameras[index(camera)].sequence
    }

    /// Whether an exposure of a camera is read out.
    #[must_use]
    pub fn is_ready(&self, camera: Camera) -> bool {
        let now_ns = self.now_ns();
        self.cameras[index(camera)].frames.front().is_some_and(|f| f.ready_ns <= now_ns)
    }

    /// Takes the oldest exposure of a camera that is read out.
    pub fn take_ready(&mut self, camera: Camera) -> Option<Exposure> {
        let now_ns = self.now_ns();
        let taken = self.cameras[index(camera)].frames.pop_front_if(|f| f.ready_ns <= now_ns);
        self.count_backlog();
        taken
    }

    /// Exposures that wait to be fetched, of the camera that has more of them. Kept up to date for who
    /// does not hold the rig.
    #[must_use]
    pub fn backlog(&self) -> Arc<AtomicUsize> {
        Arc::clone(&self.backlog)
    }

    fn count_backlog(&self) {
        let most = self.cameras.iter().map(|camera| camera.frames.len()).max().unwrap_or(0);
        self.backlog.store(most, Ordering::Relaxed);
    }

    /// The camera whose oldest exposure was read out first, if one is.
    #[must_use]
    pub fn ready_camera(&self) -> Option<Camera> {
        let now_ns = self.now_ns();
        CAMERAS
            .into_iter()
            .filter_map(|camera| {
                Some((self.cameras[index(camera)].frames.front()?.ready_ns, camera))
            })
            .filter(|(ready_ns, _)| *ready_ns <= now_ns)
            .min_by_key(|(ready_ns, _)| *ready_ns)
            .map(|(_, camera)| camera)
    }

    /// Lets time pass up to `to_ns`; at most [`STEP_NS`] at once stamps things finely.
    pub fn advance(&mut self, to_ns: u64) {
        let mut edges = std::mem::take(&mut self.edges);
        self.controller.run_until(to_ns, &mut edges);
        for edge in edges.drain(..) {
            self.apply(edge);
            if let Some(watch) = &mut self.watch {
                watch.push(edge);
            }
        }
        self.edges = edges;
        self.count_backlog();
        self.controller.host_read(&mut self.inbox);
    }

    fn apply(&mut self, edge: PinEdge) {
        let source = match edge.line {
            Line::Projector(index) => LightSource::Projector(index),
            Line::Floodlight => LightSource::Floodlight,
            Line::CameraTrigger(camera) => {
                let camera = if camera == 0 { Camera::Left } else { Camera::Right };
                return self.trigger(camera, edge);
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

    fn trigger(&mut self, which: Camera, edge: PinEdge) {
        let camera = &mut self.cameras[index(which)];
        if edge.high {
            camera.open_ns = camera.started.then_some(edge.time_ns);
            return;
        }
        let Some(open_ns) = camera.open_ns.take() else { return };
        let longest_ns = camera.longest_ns.unwrap_or(u64::MAX);
        let close_ns = edge.time_ns.min(open_ns.saturating_add(longest_ns));
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
        let ready_ns = close_ns + self.readout_ns + RIGHT_DELAY_NS * index(which) as u64;
        let sequence = camera.sequence;
        camera.sequence += 1;
        let exposure = Exposure { camera: which, sequence, open_ns, close_ns, ready_ns, lights };
        camera.frames.push_back(exposure);
        if camera.frames.len() > self.frames_kept {
            camera.frames.pop_front();
            camera.lost += 1;
        }
        // What ended before the oldest exposure that can still be open is never looked at again.
        let oldest_ns = self.cameras.iter().filter_map(|c| c.open_ns).fold(open_ns, u64::min);
        while self.past.front().is_some_and(|light| light.off_ns <= oldest_ns) {
            self.past.pop_front();
        }
    }
}
