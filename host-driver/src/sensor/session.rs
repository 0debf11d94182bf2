//! The open device, shared by the sensor and the threads of its stream.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use stspp_protocol::reply::{DeviceState, RequestError, Started};
use stspp_protocol::request::{
    Arm, Disarm, GetFaults, GetStatus, GetTiming, SetTiming, StartStream, StopStream,
};

use crate::camera::{CameraError, CameraSource};
use crate::clock::Clock;
use crate::error::{CalibrationMissing, Error, Faulted};
use crate::sync::Side;
use crate::transport::Link;
use crate::{ProjectionTiming, RawImage, StereoCalibration};

/// Timings of which frames may still be on their way.
const TIMINGS_KEPT: usize = 8;

/// Longest wait for the duty budget of the device's light to recover.
const DUTY_WAIT_MAX: Duration = Duration::from_secs(10);

pub(crate) struct Session {
    pub clock: Arc<dyn Clock>,
    calibration: Result<StereoCalibration, CalibrationMissing>,
    link: Mutex<Link>,
    cameras: Mutex<Box<dyn CameraSource>>,
    timings: Mutex<Vec<(u16, ProjectionTiming)>>,
}

fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // A panic elsewhere must not keep the light on: the link stays usable.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Session {
    pub fn new(
        clock: Arc<dyn Clock>,
        link: Link,
        cameras: Box<dyn CameraSource>,
        calibration: Result<StereoCalibration, CalibrationMissing>,
    ) -> Self {
        Self {
            clock,
            calibration,
            link: Mutex::new(link),
            cameras: Mutex::new(cameras),
            timings: Mutex::default(),
        }
    }

    /// Calibration of the cameras, where there is one.
    pub fn calibration(&self) -> Result<&StereoCalibration, Error> {
        self.calibration.as_ref().map_err(|missing| missing.clone().into())
    }

    pub fn link(&self) -> MutexGuard<'_, Link> {
        lock(&self.link)
    }

    pub fn cameras(&self) -> MutexGuard<'_, Box<dyn CameraSource>> {
        lock(&self.cameras)
    }

    /// The timing of a generation.
    pub fn timing(&self, generation: u16) -> Option<ProjectionTiming> {
        let timings = lock(&self.timings);
        timings.iter().find(|(known, _)| *known == generation).map(|(_, timing)| timing.clone())
    }

    fn register(&self, generation: u16, timing: ProjectionTiming) {
        let mut timings = lock(&self.timings);
        timings.retain(|(known, _)| *known != generation);
        if timings.len() == TIMINGS_KEPT {
            timings.remove(0);
        }
        timings.push((generation, timing));
    }

    /// Sends a timing that has been validated.
    pub fn set_timing(&self, request: &SetTiming) -> Result<(), Error> {
        // The link stays locked until the generation is known: its triggers wait behind it.
        let mut link = self.link();
        let accepted = link.call(request)?;
        self.register(accepted.timing_generation, request.timing.clone());
        Ok(())
    }

    /// Allows light.
    pub fn arm(&self) -> Result<(), Error> {
        self.check_faults()?;
        self.link().call(&Arm).map(drop)
    }

    /// Starts the cameras, then the light: the first exposure has its frame.
    pub fn start(&self) -> Result<Started, Error> {
        self.arm()?;
        let cameras = self.cameras().start();
        let started = cameras.map_err(Error::from).and_then(|()| self.start_light());
        if started.is_err() {
            self.stop();
        }
        started
    }

    fn start_light(&self) -> Result<Started, Error> {
        let mut link = self.link();
        let active = link.call(&GetTiming)?;
        self.register(active.timing_generation, active.timing);
        while link.next_event().is_some() {}
        let mut waited = Duration::ZERO;
        loop {
            match link.call(&StartStream) {
                Err(Error::Refused {
                    source: RequestError::DutyBudget { retry_after_us, .. },
                    ..
                }) if waited < DUTY_WAIT_MAX => {
                    // Light was on a moment ago; the device says when there may be more.
                    let pause = Duration::from_micros(u64::from(retry_after_us.max(1000)));
                    let pause = pause.min(DUTY_WAIT_MAX);
                    waited += pause;
                    self.pass(&mut link, pause)?;
                }
                other => return other,
            }
        }
    }

    /// Lets `time` pass, with heartbeats.
    fn pass(&self, link: &mut Link, time: Duration) -> Result<(), Error> {
        let until_ns = self.clock.now_ns() + crate::clock::duration_ns(time);
        while let left_ns @ 1.. = until_ns.saturating_sub(self.clock.now_ns()) {
            link.pump(Duration::from_nanos(left_ns).min(Duration::from_millis(50)))?;
        }
        Ok(())
    }

    /// Switches the light off and stops the cameras, as far as the device can be reached. A device that
    /// cannot be reached misses the heartbeat and goes dark by itself.
    pub fn stop(&self) {
        let mut link = self.link();
        let _ = link.call(&StopStream);
        let _ = link.call(&Disarm);
        drop(link);
        self.cameras().stop();
    }

    /// Whether a latched fault keeps the light off.
    pub fn check_faults(&self) -> Result<(), Error> {
        let mut link = self.link();
        let status = link.call(&GetStatus)?;
        if status.latched.is_empty() {
            return Ok(());
        }
        let report = link.call(&GetFaults)?;
        let state = status.state;
        debug_assert!(state == DeviceState::Faulted || !status.latched.is_empty());
        Err(Faulted { record: report.first, latched: report.latched, state }.into())
    }

    pub fn check_size(&self, side: Side, image: &RawImage) -> Result<(), CameraError> {
        // Raw pairs can be had without a calibration, for making one.
        let Ok(calibration) = &self.calibration else { return Ok(()) };
        let camera = match side {
            Side::Left => &calibration.left,
            Side::Right => &calibration.right,
        };
        let (expected, got) = (camera.resolution_px, [image.width(), image.height()]);
        if expected == got { Ok(()) } else { Err(CameraError::Size { side, expected, got }) }
    }
}
