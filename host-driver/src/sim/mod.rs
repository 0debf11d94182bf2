//! The simulated sensor: the firmware's logic, the light and the cameras of `hil-sim`, joined.
//!
//! [`rig`] lets virtual time pass, in which the controller's pin edges become exposures and the times
//! that lights were on ([`stspp_hil_sim::rig`]); [`link`] is its control link as a [`Transport`](crate::transport::Transport);
//! [`cameras`] are its cameras as a [`CameraSource`](crate::camera::CameraSource); [`options`] is what
//! may follow `sim:`.
//!
//! Nothing here labels a frame: a camera exposes while its trigger pin is high, whatever was lit, and
//! counts and stamps its frames by a clock of its own.

pub mod boards;
pub mod cameras;
pub mod link;
pub mod options;
pub mod rig;

use std::sync::{Arc, Mutex};

use stspp_hil_sim::device::Controller;
use stspp_hil_sim::device::in_process::{InProcess, InProcessOptions};
use stspp_hil_sim::rig::readout_ns;
use stspp_hil_sim::world::{CameraModel, SensorModel, World};

use crate::clock::Clock;
use crate::{CameraIntrinsics, Error, StereoCalibration};

pub use cameras::SimCameras;
pub use link::SimLink;
pub use options::{Pace, SimMcu, SimOptions};
pub use rig::Rig;

/// The parts of a simulated sensor.
pub struct SimSensor {
    /// The control link.
    pub link: SimLink,
    /// The cameras.
    pub cameras: SimCameras,
    /// The clock that waits run on.
    pub clock: Arc<dyn Clock>,
    /// Calibration of the cameras, exact.
    pub calibration: StereoCalibration,
    /// Scene, light and cameras, for truth.
    pub world: Arc<World>,
    /// What joins them; faults are injected here.
    pub rig: Arc<Mutex<Rig>>,
}

impl SimSensor {
    /// Makes a sensor in its scene.
    ///
    /// # Errors
    /// [`Error::Simulation`] for a scene or model that cannot be.
    pub fn new(options: &SimOptions) -> Result<Self, Error> {
        let controller: Box<dyn Controller> = match options.mcu {
            SimMcu::InProcess => Box::new(InProcess::new(InProcessOptions::seeded(options.seed))),
            emulated => emulated_chip(emulated)?,
        };
        Self::with_controller(options, controller)
    }

    /// A sensor with another controller, such as an emulated chip.
    ///
    /// # Errors
    /// As [`SimSensor::new`].
    pub fn with_controller(
        options: &SimOptions,
        controller: Box<dyn Controller>,
    ) -> Result<Self, Error> {
        let model = options.model();
        let calibration = calibration_of(&model);
        let world = World::new(&options.scene, model)
            .map_err(|error| Error::Simulation(error.to_string()))?;
        let world = Arc::new(world);
        let pixels = calibration.left.resolution_px[0] * calibration.left.resolution_px[1];
        let mut rig = Rig::new(controller, options.pace, readout_ns(pixels));
        if options.trigger_hz > 0.0 {
            rig.generate_trigger(options.trigger_hz);
        }
        let clock = rig.clock();
        let rig = Arc::new(Mutex::new(rig));
        Ok(Self {
            link: SimLink::new(Arc::clone(&rig)),
            cameras: SimCameras::new(Arc::clone(&rig), Arc::clone(&world), options.pace),
            clock,
            calibration,
            world,
            rig,
        })
    }
}

impl SimSensor {
    /// The parts as [`Sensor::from_parts`](crate::Sensor::from_parts) takes them.
    pub fn into_parts(self, source: crate::SourceUri) -> crate::sensor::Parts {
        crate::sensor::Parts {
            source,
            transport: Box::new(self.link),
            cameras: Box::new(self.cameras),
            clock: self.clock,
            calibration: Ok(self.calibration),
            reopen: None,
        }
    }
}

/// The firmware's binary on an emulated chip.
#[cfg(feature = "mcu")]
fn emulated_chip(mcu: SimMcu) -> Result<Box<dyn Controller>, Error> {
    use stspp_hil_mcu::controller::{McuController, firmware_elf};
    use stspp_hil_mcu::soc::Variant;
    let variant = if mcu == SimMcu::F330 { Variant::F330 } else { Variant::F350 };
    match McuController::load(variant, &firmware_elf(variant)) {
        Ok(controller) => Ok(Box::new(controller)),
        Err(error) => Err(Error::Simulation(error.to_string())),
    }
}

#[cfg(not(feature = "mcu"))]
fn emulated_chip(_mcu: SimMcu) -> Result<Box<dyn Controller>, Error> {
    Err(Error::Simulation(
        "the option mcu needs the feature `mcu`: cargo run --features mcu".to_owned(),
    ))
}

/// The calibration of a sensor model.
pub fn calibration_of(model: &SensorModel) -> StereoCalibration {
    let camera = |camera: &CameraModel| CameraIntrinsics {
        focal_px: camera.focal_px,
        principal_px: camera.principal_px,
        radtan: camera.radtan,
        resolution_px: [camera.width, camera.height],
    };
    StereoCalibration {
        left: camera(&model.left),
        right: camera(&model.right),
        right_from_left: model.right_from_left,
        temperature_c: None,
        date: None,
    }
}
