//! The sensor: open it, set what it projects, stream depth.

#[cfg(target_os = "linux")]
pub mod open;
mod session;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde::Serialize;
use stspp_protocol::fault::{FaultReason, FaultReport};
use stspp_protocol::reply::{RequestError, Status};
use stspp_protocol::request::{
    ClearFaults, FloodlightOff, FloodlightOn, GetFaults, GetStatus, GetTiming, GetTriggerSource,
    LoadDefaults, LoadSettings, SaveSettings, SetTiming, SetTriggerSource,
};
use stspp_protocol::timing::Limits;
use stspp_protocol::trigger::{TriggerInput, TriggerSource};
use stspp_protocol::version::{Capabilities, DeviceInfo, PROTOCOL_VERSION};

use crate::camera::CameraSource;
use crate::clock::{Clock, MonotonicClock};
use crate::error::CalibrationMissing;
use crate::pipeline::stream::{self, PairSource};
use crate::pipeline::{DepthStream, PairStream, StreamOptions};
use crate::transport::{Link, LinkStats, Transport, TransportError};
use crate::{Error, ProjectionTiming, Recording, SourceUri, StereoCalibration, timing};

pub(crate) use session::Session;

/// What a sensor is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SensorInfo {
    /// The source it was opened by.
    pub source: String,
    /// Serial number; `None` for a recording.
    pub serial: Option<String>,
    /// Board, such as "F350"; `None` for a recording.
    pub board: Option<String>,
    /// Version of the firmware.
    pub firmware: Option<String>,
    /// Version of the protocol that the device speaks.
    pub protocol: Option<String>,
    /// Version of the protocol that this library speaks.
    pub host_protocol: String,
    /// Width of the cameras' images in pixels; `None` without a calibration.
    pub width_px: Option<usize>,
    /// Height of the cameras' images in pixels; `None` without a calibration.
    pub height_px: Option<usize>,
    /// Distance of the cameras in metres; `None` without a calibration.
    pub baseline_m: Option<f64>,
    /// Constants that every timing is held against; `None` for a recording.
    pub limits: Option<Limits>,
}

/// The parts that a sensor is made of: what a new kind of transport or camera plugs into.
pub struct Parts {
    /// Name of the source, for messages.
    pub source: SourceUri,
    /// The control link.
    pub transport: Box<dyn Transport>,
    /// The cameras.
    pub cameras: Box<dyn CameraSource>,
    /// The clock that waits run on.
    pub clock: Arc<dyn Clock>,
    /// Calibration of the cameras, or where one was looked for.
    pub calibration: Result<StereoCalibration, CalibrationMissing>,
    /// Opens the control link anew after it was lost; `None` where the transport goes on by itself.
    pub reopen: Option<Reopen>,
}

/// Waits for a sensor to be there again, at most so long, and opens its control link.
pub type Reopen = Box<dyn FnMut(Duration) -> Result<Box<dyn Transport>, TransportError> + Send>;

enum Backend {
    Live {
        session: Arc<Session>,
        device: DeviceInfo,
        keep_alive: Option<KeepAlive>,
        reopen: Option<Reopen>,
    },
    Replay {
        recording: Arc<Recording>,
    },
}

/// A 3D sensor, or what stands in for one.
///
/// Dropping it, or its stream, stops the device and switches its light off.
pub struct Sensor {
    source: SourceUri,
    backend: Backend,
    streaming: Arc<AtomicBool>,
}

impl std::fmt::Debug for Sensor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Sensor").field("source", &self.source).finish_non_exhaustive()
    }
}

impl Sensor {
    /// Opens the sensor that `source` names: `usb:`, `usb:SERIAL`, `serial:PORT`, `sim:`,
    /// `sim:SCENE?OPTION=VALUE` or `replay:FOLDER`.
    ///
    /// # Errors
    /// When the source is not understood or not there, or speaks another protocol version.
    pub fn open(source: &str) -> Result<Self, Error> {
        Self::open_uri(&source.parse()?)
    }

    /// Opens a parsed source.
    ///
    /// # Errors
    /// As [`Sensor::open`].
    pub fn open_uri(source: &SourceUri) -> Result<Self, Error> {
        match source {
            #[cfg(feature = "usb")]
            SourceUri::Usb { serial, options } => {
                Self::from_parts(open::usb(source, serial.as_deref(), options)?)
            }
            #[cfg(not(feature = "usb"))]
            SourceUri::Usb { .. } => {
                Err(Error::NotBuiltIn { scheme: "usb", remedy: "build with the feature `usb`" })
            }
            SourceUri::Serial { path, options } => {
                Self::from_parts(open::serial(source, path.as_deref(), options)?)
            }
            #[cfg(feature = "sim")]
            SourceUri::Sim { scene, options } => {
                let options = crate::sim::SimOptions::parse(scene.as_deref(), options)?;
                let sim = crate::sim::SimSensor::new(&options)?;
                Self::from_parts(sim.into_parts(source.clone()))
            }
            #[cfg(not(feature = "sim"))]
            SourceUri::Sim { .. } => {
                Err(Error::NotBuiltIn { scheme: "sim", remedy: "build with the feature `sim`" })
            }
            SourceUri::Replay { folder, options } => {
                if let Some((name, _)) = options.first() {
                    let name = name.clone();
                    let known = "no options";
                    return Err(
                        crate::UriError::OptionUnknown { scheme: "replay", name, known }.into()
                    );
                }
                Self::replay(folder, source.clone())
            }
        }
    }

    /// Opens a sensor made of the given parts.
    ///
    /// # Errors
    /// When the device does not answer or speaks another protocol version.
    pub fn from_parts(parts: Parts) -> Result<Self, Error> {
        let mut link = Link::new(parts.transport, Arc::clone(&parts.clock));
        let device = link.hello()?;
        let is_virtual = parts.clock.is_virtual();
        let session = Arc::new(Session::new(parts.clock, link, parts.cameras, parts.calibration));
        // Simulated time stands still between calls, so that no heartbeat can be missed.
        let keep_alive = (!is_virtual).then(|| KeepAlive::start(&session)).flatten();
        let backend = Backend::Live { session, device, keep_alive, reopen: parts.reopen };
        Ok(Self { source: parts.source, backend, streaming: Arc::default() })
    }

    fn replay(folder: &Path, source: SourceUri) -> Result<Self, Error> {
        let recording = Arc::new(Recording::open(folder)?);
        Ok(Self { source, backend: Backend::Replay { recording }, streaming: Arc::default() })
    }

    /// What this sensor is.
    pub fn info(&self) -> SensorInfo {
        let calibration = self.calibration().ok();
        let device = match &self.backend {
            Backend::Live { device, .. } => Some(device),
            Backend::Replay { .. } => None,
        };
        SensorInfo {
            source: self.source.to_string(),
            serial: device.map(|d| d.serial.to_string()),
            board: device.map(|d| format!("{:?}", d.board)),
            firmware: device.map(|d| d.firmware.to_string()),
            protocol: device.map(|d| d.protocol.to_string()),
            host_protocol: PROTOCOL_VERSION.to_string(),
            width_px: calibration.map(|c| c.left.resolution_px[0]),
            height_px: calibration.map(|c| c.left.resolution_px[1]),
            baseline_m: calibration.map(StereoCalibration::baseline_m),
            limits: device.map(|d| d.limits),
        }
    }

    /// The calibration in use.
    ///
    /// # Errors
    /// [`Error::NoCalibration`] for a real sensor that has none yet: it can be asked and set, and gives
    /// raw pairs, but no depth.
    pub fn calibration(&self) -> Result<&StereoCalibration, Error> {
        match &self.backend {
            Backend::Live { session, .. } => session.calibration(),
            Backend::Replay { recording } => Ok(&recording.calibration),
        }
    }

    /// Whether a stream could start now: starts the cameras, without light, and stops them again.
    ///
    /// # Errors
    /// Which camera is missing, busy or not what the calibration says; while a stream is running.
    pub fn try_start(&self) -> Result<(), Error> {
        let session = self.session("start cameras")?;
        let _lease = Lease::take(&self.streaming).ok_or(Error::Streaming)?;
        let started = session.cameras().start();
        session.cameras().stop();
        Ok(started?)
    }

    /// Opens the control link again after the sensor was unplugged, restarted or given up: waits up to
    /// `timeout` for it to be there. Streams can be started again then; cameras are opened at their
    /// start anyway.
    ///
    /// # Errors
    /// When it does not come back in time, or another one comes; while a stream is running.
    pub fn reconnect(&mut self, timeout: Duration) -> Result<(), Error> {
        let Backend::Live { session, device, reopen, .. } = &mut self.backend else {
            return Err(Error::Unsupported { scheme: "replay", what: "be plugged in again" });
        };
        let _lease = Lease::take(&self.streaming).ok_or(Error::Streaming)?;
        let mut link = session.link();
        if let Some(reopen) = reopen {
            // The old link is closed first: nobody else may hold the device.
            link.close(&self.source.to_string());
            link.replace(reopen(timeout)?);
        }
        let found = link.hello()?;
        // What latched because this host was away is told by the error that the caller has had.
        let latched = link.call(&GetStatus)?.latched;
        let by_absence = [FaultReason::HeartbeatLost, FaultReason::LinkLost];
        if !latched.is_empty() && latched.iter().all(|reason| by_absence.contains(&reason)) {
            link.call(&ClearFaults)?;
        }
        if found.serial != device.serial {
            let (expected, got) = (device.serial.to_string(), found.serial.to_string());
            return Err(Error::OtherSensor { expected, got });
        }
        *device = found;
        Ok(())
    }

    /// The recording that is replayed, if this is one.
    pub fn recording(&self) -> Option<&Recording> {
        match &self.backend {
            Backend::Live { .. } => None,
            Backend::Replay { recording } => Some(recording),
        }
    }

    /// The projection timing in force, or accepted for the next slot cycle.
    ///
    /// # Errors
    /// When the device does not answer; for a recording.
    pub fn timing(&self) -> Result<ProjectionTiming, Error> {
        Ok(self.session("tell its timing")?.link().call(&GetTiming)?.timing)
    }

    /// Sets what is projected when. While streaming, it takes effect with the next slot cycle; windows
    /// never mix frames of two timings.
    ///
    /// # Errors
    /// [`Error::Timing`] with all rules that it breaks; nothing has changed then.
    pub fn set_timing(&mut self, timing: ProjectionTiming) -> Result<(), Error> {
        let session = self.session("change its timing")?;
        if let Backend::Live { device, .. } = &self.backend {
            let violations = timing::violations(&timing, &device.limits);
            if !violations.is_empty() {
                return Err(Error::Timing(violations));
            }
        }
        session.set_timing(&SetTiming { timing })
    }

    /// What starts slots, and the edges seen at trigger-in.
    ///
    /// # Errors
    /// When the device has no trigger-in or does not answer; for a recording.
    pub fn trigger_input(&self) -> Result<TriggerInput, Error> {
        self.has_trigger_in("GetTriggerSource")?;
        self.session("have a trigger input")?.link().call(&GetTriggerSource)
    }

    /// Chooses what starts the slots of the streams to come: the device's own timer, or edges at its
    /// trigger-in. Not while streaming. The device forgets it with the session.
    ///
    /// A stream by an external trigger waits for edges as long as its reader does.
    ///
    /// # Errors
    /// When the device has no trigger-in, or the delay is out of range; nothing has changed then.
    pub fn set_trigger_source(&mut self, source: TriggerSource) -> Result<(), Error> {
        let request = "SetTriggerSource";
        self.has_trigger_in(request)?;
        source.validate().map_err(|source| Error::Refused { request, source })?;
        let session = self.session("have a trigger input")?;
        session.link().call(&SetTriggerSource { source }).map(drop)
    }

    /// A request that was added to the protocol goes only to a device that says it has it.
    fn has_trigger_in(&self, request: &'static str) -> Result<(), Error> {
        match &self.backend {
            Backend::Live { device, .. }
                if !device.capabilities.contains(Capabilities::TRIGGER_IN) =>
            {
                Err(Error::Refused { request, source: RequestError::Unsupported })
            }
            _ => Ok(()),
        }
    }

    /// Stores the timing on the device for its next power-on. Not while streaming.
    ///
    /// # Errors
    /// When the device refuses; a failed write leaves what was stored before.
    pub fn save_settings(&mut self) -> Result<(), Error> {
        let session = self.session("store settings")?;
        session.link().call(&SaveSettings).map(drop)
    }

    /// Goes back to the stored settings. Not while streaming.
    ///
    /// # Errors
    /// When nothing is stored.
    pub fn load_settings(&mut self) -> Result<ProjectionTiming, Error> {
        Ok(self.session("load settings")?.link().call(&LoadSettings)?.timing)
    }

    /// Goes back to a new device's settings, without storing them. Not while streaming.
    ///
    /// # Errors
    /// When the device refuses.
    pub fn load_defaults(&mut self) -> Result<ProjectionTiming, Error> {
        Ok(self.session("load settings")?.link().call(&LoadDefaults)?.timing)
    }

    /// State, counters and sensors of the device.
    ///
    /// # Errors
    /// When the device does not answer; for a recording.
    pub fn status(&self) -> Result<Status, Error> {
        self.session("tell its status")?.link().call(&GetStatus)
    }

    /// Latched faults, those still active, the first and the last.
    ///
    /// # Errors
    /// When the device does not answer; for a recording.
    pub fn faults(&self) -> Result<FaultReport, Error> {
        self.session("have faults")?.link().call(&GetFaults)
    }

    /// Unlatches faults whose cause is gone; reports what is left.
    ///
    /// # Errors
    /// When the device does not answer; for a recording.
    pub fn clear_faults(&mut self) -> Result<FaultReport, Error> {
        self.session("have faults")?.link().call(&ClearFaults)
    }

    /// Switches the floodlight on for `duration`, at most half a second; a hardware timer ends it.
    /// Not while streaming: there the timing's slots say when it is on.
    ///
    /// # Errors
    /// When the device refuses.
    pub fn floodlight_on(&mut self, duration: Duration) -> Result<(), Error> {
        let session = self.session("light a floodlight")?;
        let duration_us = u32::try_from(duration.as_micros()).unwrap_or(u32::MAX);
        session.arm()?;
        session.link().call(&FloodlightOn { duration_us }).map(drop)
    }

    /// Switches the floodlight off.
    ///
    /// # Errors
    /// When the device does not answer.
    pub fn floodlight_off(&mut self) -> Result<(), Error> {
        self.session("light a floodlight")?.link().call(&FloodlightOff).map(drop)
    }

    /// What went wrong on the control link so far; zeros for a recording.
    pub fn link_stats(&self) -> LinkStats {
        match &self.backend {
            Backend::Live { session, .. } => session.link().stats(),
            Backend::Replay { .. } => LinkStats::default(),
        }
    }

    /// Starts projecting and streams depth frames.
    ///
    /// The stream owns its threads and its frames: the sensor can be asked and set meanwhile.
    ///
    /// # Errors
    /// When the sensor streams already, is at fault, or cannot match with this calibration.
    pub fn stream(&mut self) -> Result<DepthStream, Error> {
        self.stream_with(&StreamOptions::default())
    }

    /// [`Sensor::stream`] with other options.
    ///
    /// # Errors
    /// As [`Sensor::stream`].
    pub fn stream_with(&mut self, options: &StreamOptions) -> Result<DepthStream, Error> {
        if let Backend::Live { session, .. } = &self.backend {
            let timing = session.link().call(&GetTiming)?.timing;
            if !timing.slots.iter().any(|s| s.projector_mask != 0 && !s.floodlight) {
                return Err(Error::NoSpeckleSlot);
            }
        }
        stream::depth(self.source()?, options)
    }

    /// Starts projecting and streams raw labelled pairs, without matching.
    ///
    /// # Errors
    /// When the sensor streams already or is at fault.
    pub fn pairs(&mut self, options: &StreamOptions) -> Result<PairStream, Error> {
        stream::pairs(self.source()?, options)
    }

    fn source(&self) -> Result<PairSource, Error> {
        Ok(match &self.backend {
            Backend::Live { session, .. } => {
                let lease = Lease::take(&self.streaming).ok_or(Error::Streaming)?;
                PairSource::Live { session: Arc::clone(session), lease }
            }
            Backend::Replay { recording } => PairSource::Replay {
                recording: Arc::clone(recording),
                clock: Arc::new(MonotonicClock::new()),
            },
        })
    }

    fn session(&self, what: &'static str) -> Result<&Session, Error> {
        match &self.backend {
            Backend::Live { session, .. } => Ok(session),
            Backend::Replay { .. } => Err(Error::Unsupported { scheme: "replay", what }),
        }
    }
}

impl Drop for Sensor {
    fn drop(&mut self) {
        if let Backend::Live { session, keep_alive, .. } = &mut self.backend {
            drop(keep_alive.take());
            // A stream that outlives the sensor switches the light off itself.
            if !self.streaming.load(Ordering::Acquire) {
                session.stop();
            }
        }
    }
}

/// The right to stream, of which a sensor gives out one at a time.
pub(crate) struct Lease(Arc<AtomicBool>);

impl Lease {
    fn take(streaming: &Arc<AtomicBool>) -> Option<Self> {
        let free = !streaming.swap(true, Ordering::AcqRel);
        free.then(|| Self(Arc::clone(streaming)))
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.0.store(false, Ordering::Release);
    }
}

/// Sends heartbeats while nothing else is sent, so that a device that is armed stays so.
struct KeepAlive {
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl KeepAlive {
    fn start(session: &Arc<Session>) -> Option<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (session, stopped) = (Arc::downgrade(session), Arc::clone(&stop));
        let beat = move || {
            while !stopped.load(Ordering::Acquire) {
                let Some(session) = session.upgrade() else { return };
                // An error shows in the next request, which has somebody to report it to.
                let _ = session.link().pump(Duration::ZERO);
                drop(session);
                std::thread::park_timeout(Duration::from_millis(20));
            }
        };
        let thread = std::thread::Builder::new().name("stspp-heartbeat".into()).spawn(beat).ok()?;
        Some(Self { stop, thread: Some(thread) })
    }
}

impl Drop for KeepAlive {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}
