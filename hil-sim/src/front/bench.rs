//! The simulated sensor shared by the USB devices that it is made of.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::rig::{Rig, STEP_NS};

/// Nanoseconds of the time that a sensor follows.
pub type Clock = Arc<dyn Fn() -> u64 + Send + Sync>;

/// USB frame number at a time of the sensor.
pub type FrameNumber = Arc<dyn Fn(u64) -> u16 + Send + Sync>;

/// One sensor behind several USB devices.
pub struct Bench {
    rig: Mutex<Rig>,
    clock: Option<Clock>,
    frame_number: FrameNumber,
}

impl Bench {
    /// A sensor whose time follows `clock`.
    #[must_use]
    pub fn following(rig: Rig, clock: Clock) -> Self {
        Self { clock: Some(clock), ..Self::virtual_time(rig) }
    }

    /// A sensor whose time passes when whoever holds the rig lets it.
    #[must_use]
    pub fn virtual_time(rig: Rig) -> Self {
        // The in-process controller's bus counts milliseconds from the beginning.
        let frame_number = Arc::new(|time_ns: u64| {
            (time_ns / 1_000_000 % u64::from(stspp_protocol::usb::SOF_MODULUS)) as u16
        });
        Self { rig: Mutex::new(rig), clock: None, frame_number }
    }

    /// Has the cameras see the frame numbers of another bus.
    #[must_use]
    pub fn with_frame_number(self, frame_number: FrameNumber) -> Self {
        Self { frame_number, ..self }
    }

    /// The rig, its time up to date.
    pub fn rig(&self) -> MutexGuard<'_, Rig> {
        // A panic of another device's thread must not end this one's too.
        let mut rig = self.rig.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(clock) = &self.clock {
            let wall_ns = clock();
            while rig.now_ns() < wall_ns {
                let next_ns = wall_ns.min(rig.now_ns() + STEP_NS);
                rig.advance(next_ns);
            }
        }
        rig
    }

    /// USB frame number at a time of the sensor, not long ago.
    #[must_use]
    pub fn frame_number(&self, time_ns: u64) -> u16 {
        (self.frame_number)(time_ns)
    }
}
