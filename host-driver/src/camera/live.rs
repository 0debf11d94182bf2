//! The cameras of a real sensor: found and opened when a stream starts, let go when it stops, so that
//! one that was unplugged is found again at the next start.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use super::v4l2::topology::{self, SensorCameras, UsbCamera};
use super::v4l2::{CameraSettings, V4l2Cameras};
use super::{CameraError, CameraFrame, CameraSource};
use crate::clock::Clock;

/// Which cameras belong to the sensor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CameraChoice {
    /// Those nearest to the control interface on the USB tree.
    ByTopology,
    /// These two nodes.
    Nodes {
        /// Left camera.
        left: PathBuf,
        /// Right camera.
        right: PathBuf,
    },
    /// This node, with both pictures side by side.
    SideBySide(PathBuf),
}

/// What is known of the cameras before they are opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraPlan {
    /// Which they are.
    pub choice: CameraChoice,
    /// Kernel name of the control interface's USB device, where it has one.
    pub control_usb_path: Option<String>,
    /// Size of one camera's pictures; the sensor's default when `None`.
    pub resolution_px: Option<[usize; 2]>,
    /// Longest exposure in microseconds.
    pub exposure_us: Option<u32>,
    /// Gain in the cameras' own units.
    pub gain: Option<i32>,
}

impl CameraPlan {
    /// Finds the cameras' nodes.
    ///
    /// # Errors
    /// [`CameraError::NotFound`] when their number is neither one nor two, [`CameraError::Gone`] when one
    /// of two is missing.
    pub fn find(&self) -> Result<SensorCameras, CameraError> {
        let all = topology::usb_cameras();
        match &self.choice {
            CameraChoice::ByTopology => {
                topology::cameras_of(self.control_usb_path.as_deref(), &all)
            }
            CameraChoice::Nodes { left, right } => Ok(SensorCameras::Two {
                left: camera_of(left, &all),
                right: camera_of(right, &all),
            }),
            CameraChoice::SideBySide(both) => Ok(SensorCameras::SideBySide(camera_of(both, &all))),
        }
    }

    /// What to set on them.
    pub fn settings(&self) -> CameraSettings {
        let defaults = CameraSettings::default();
        CameraSettings {
            resolution_px: self.resolution_px.unwrap_or(defaults.resolution_px),
            exposure_us: self.exposure_us,
            gain: self.gain,
            ..defaults
        }
    }

    /// Whether a camera hangs on the control interface's bus, so that both see the same USB frame
    /// numbers.
    fn shares_bus(&self, camera: &UsbCamera) -> bool {
        let bus = |path: &str| path.split('-').next().unwrap_or_default().to_owned();
        self.control_usb_path
            .as_deref()
            .is_some_and(|control| bus(control) == bus(&camera.usb_path))
    }
}

/// The camera that a node belongs to; a node that is not on USB is a camera by itself.
fn camera_of(node: &Path, all: &[UsbCamera]) -> UsbCamera {
    let real = std::fs::canonicalize(node).unwrap_or_else(|_| node.to_owned());
    let known = all.iter().find(|camera| camera.nodes.contains(&real)).cloned();
    known.unwrap_or_else(|| UsbCamera {
        usb_path: String::new(),
        product: String::new(),
        serial: String::new(),
        ids: [0; 2],
        speed_mbit_s: 0,
        nodes: vec![real],
        clock_hz: None,
    })
}

/// A real sensor's cameras.
pub struct LiveCameras {
    plan: CameraPlan,
    clock: Arc<dyn Clock>,
    open: Option<V4l2Cameras>,
    damaged: [u64; 2],
}

impl LiveCameras {
    /// Cameras that are looked for at the first start.
    pub fn new(plan: CameraPlan, clock: Arc<dyn Clock>) -> Self {
        Self { plan, clock, open: None, damaged: [0; 2] }
    }
}

impl CameraSource for LiveCameras {
    fn start(&mut self) -> Result<(), CameraError> {
        self.stop();
        let found = self.plan.find()?;
        let shares_bus = match &found {
            SensorCameras::Two { left, right } => {
                self.plan.shares_bus(left) && self.plan.shares_bus(right)
            }
            SensorCameras::SideBySide(both) => self.plan.shares_bus(both),
        };
        let clock = Arc::clone(&self.clock);
        let mut cameras = V4l2Cameras::open(&found, &self.plan.settings(), shares_bus, clock)?;
        cameras.start()?;
        self.open = Some(cameras);
        Ok(())
    }

    fn stop(&mut self) {
        if let Some(mut cameras) = self.open.take() {
            cameras.stop();
            let damaged = cameras.damaged();
            self.damaged = [0, 1].map(|side| self.damaged[side] + damaged[side]);
        }
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Option<CameraFrame>, CameraError> {
        match &mut self.open {
            Some(cameras) => cameras.next_frame(timeout),
            None => Ok(None),
        }
    }

    fn damaged(&self) -> [u64; 2] {
        let now = self.open.as_ref().map_or([0; 2], CameraSource::damaged);
        [0, 1].map(|side| self.damaged[side] + now[side])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(control: Option<&str>) -> CameraPlan {
        CameraPlan {
            choice: CameraChoice::ByTopology,
            control_usb_path: control.map(str::to_owned),
            resolution_px: None,
            exposure_us: None,
            gain: None,
        }
    }

    #[test]
    fn frame_numbers_are_shared_on_one_bus_only() {
        let camera =
            |path: &str| UsbCamera { usb_path: path.into(), ..camera_of(path.as_ref(), &[]) };
        assert!(plan(Some("1-2.1")).shares_bus(&camera("1-2.3")));
        assert!(!plan(Some("11-2")).shares_bus(&camera("1-2")));
        assert!(!plan(None).shares_bus(&camera("1-2")));
        assert!(!plan(Some("1-1")).shares_bus(&camera("")));
    }

    #[test]
    fn a_node_outside_usb_is_a_camera_of_its_own() {
        let mut plan = plan(None);
        plan.choice = CameraChoice::SideBySide("/dev/null".into());
        let Ok(SensorCameras::SideBySide(camera)) = plan.find() else { panic!("one camera") };
        assert_eq!(camera.nodes, [PathBuf::from("/dev/null")]);
        assert_eq!(plan.settings().resolution_px, [1280, 1024]);
    }
}
