//! The simulated sensor's cameras: exposures rendered, counted and stamped.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use stspp_hil_sim::rig::Exposure;
use stspp_hil_sim::world::{Camera, World};

use super::Rig;
use super::options::Pace;
use crate::accuracy::capture::raw_of;
use crate::camera::{CameraError, CameraFrame, CameraSource, fingerprint};
use crate::sync::{FrameStamp, Side};

/// Offset and drift of the cameras' clocks against the rig's: nothing may rely on equal clocks.
const CLOCKS: [(u64, i64); 2] = [(41_234_567_891, 37), (7_345_678_912, -52)];

/// Both cameras of the simulated sensor.
pub struct SimCameras {
    rig: Arc<Mutex<Rig>>,
    world: Arc<World>,
    pace: Pace,
}

impl SimCameras {
    /// The cameras of `rig` in `world`.
    pub fn new(rig: Arc<Mutex<Rig>>, world: Arc<World>, pace: Pace) -> Self {
        Self { rig, world, pace }
    }

    fn rig(&self) -> MutexGuard<'_, Rig> {
        self.rig.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn render(&self, exposure: &Exposure) -> CameraFrame {
        let camera = exposure.camera;
        let side = match camera {
            Camera::Left => Side::Left,
            Camera::Right => Side::Right,
        };
        let Exposure { open_ns, close_ns, lights, .. } = exposure;
        // The time of the exposure makes its noise its own.
        let rendered = self.world.expose(camera, *open_ns, *close_ns, lights, *open_ns);
        let image = raw_of(rendered);
        let (offset_ns, drift_ppm) = CLOCKS[side.index()];
        let drift_ns = i128::from(*open_ns) * i128::from(drift_ppm) / 1_000_000;
        let stamp = FrameStamp {
            side,
            sequence: exposure.sequence,
            timestamp_camera_ns: (offset_ns + open_ns).wrapping_add_signed(drift_ns as i64),
            arrival_host_ns: exposure.ready_ns,
            fingerprint: fingerprint(&image),
            // Pairing is to do without: real cameras rarely tell it.
            usb_sof: None,
        };
        CameraFrame { stamp, image }
    }
}

impl CameraSource for SimCameras {
    fn start(&mut self) -> Result<(), CameraError> {
        self.rig().start_cameras();
        Ok(())
    }

    fn stop(&mut self) {
        self.rig().stop_cameras();
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Option<CameraFrame>, CameraError> {
        // Rendered without the lock: meanwhile others may talk to the controller.
        let exposure = self.rig().next_exposure(timeout);
        Ok(exposure.map(|exposure| self.render(&exposure)))
    }

    fn is_lossless(&self) -> bool {
        self.pace == Pace::Fast
    }
}
