//! Opening real sensors: control link, cameras and calibration put together.
//!
//! What may follow `usb:SERIAL` and `serial:PORT` as `?OPTION=VALUE&...`:
//!
//! | option | what it is | when it is not given |
//! |---|---|---|
//! | `calibration` | Kalibr's camchain.yaml | the first of [`calibration_files`] that exists |
//! | `left`, `right` | nodes of the cameras, such as `/dev/video0` | by USB topology |
//! | `both` | node of one camera that delivers both pictures side by side | by USB topology |
//! | `exposure_us` | longest exposure of the cameras, microseconds | as the cameras have it |
//! | `gain` | gain in the cameras' own units | as the cameras have it |

use std::path::{Path, PathBuf};
use std::sync::Arc;

use stspp_protocol::request::GetInfo;
use stspp_protocol::version::DeviceInfo;

use super::Parts;
use crate::calibration::kalibr;
use crate::camera::live::{CameraChoice, CameraPlan, LiveCameras};
use crate::clock::{Clock, MonotonicClock};
use crate::error::CalibrationMissing;
use crate::transport::serial::SerialTransport;
use crate::transport::{Link, Transport};
use crate::{Error, SourceUri, StereoCalibration, UriError};

const KNOWN: &str = "calibration, left, right, both, exposure_us, gain";

/// Options of a real sensor.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LiveOptions {
    /// Calibration file.
    pub calibration: Option<PathBuf>,
    /// Node of the left camera.
    pub left: Option<PathBuf>,
    /// Node of the right camera.
    pub right: Option<PathBuf>,
    /// Node of a camera that delivers both pictures.
    pub both: Option<PathBuf>,
    /// Longest exposure of the cameras, microseconds.
    pub exposure_us: Option<u32>,
    /// Gain in the cameras' own units.
    pub gain: Option<i32>,
}

impl LiveOptions {
    /// Reads (name, value) pairs; `scheme` is for messages.
    ///
    /// # Errors
    /// An option that is not known, given without its other half, or whose value is none.
    pub fn parse(scheme: &'static str, options: &[(String, String)]) -> Result<Self, UriError> {
        let mut parsed = Self::default();
        for (name, value) in options {
            let wrong = |expected: &str| UriError::OptionValue {
                name: name.clone(),
                value: value.clone(),
                expected: expected.to_owned(),
            };
            let file = (!value.is_empty()).then(|| PathBuf::from(value));
            let path = || file.clone().ok_or_else(|| wrong("a file"));
            match name.as_str() {
                "calibration" => parsed.calibration = Some(path()?),
                "left" => parsed.left = Some(path()?),
                "right" => parsed.right = Some(path()?),
                "both" => parsed.both = Some(path()?),
                "exposure_us" => {
                    let expected = "a whole number of microseconds";
                    parsed.exposure_us = Some(value.parse().map_err(|_| wrong(expected))?);
                }
                "gain" => {
                    parsed.gain = Some(value.parse().map_err(|_| wrong("a whole number"))?);
                }
                _ => {
                    let name = name.clone();
                    return Err(UriError::OptionUnknown { scheme, name, known: KNOWN });
                }
            }
        }
        let half = |name: &str, other: &str| UriError::OptionValue {
            name: name.to_owned(),
            value: String::new(),
            expected: format!("a node of its own, as {other} is given"),
        };
        match (&parsed.left, &parsed.right, &parsed.both) {
            (Some(_), None, _) => Err(half("right", "left")),
            (None, Some(_), _) => Err(half("left", "right")),
            (Some(_), Some(_), Some(_)) => Err(half("both", "left and right")),
            _ => Ok(parsed),
        }
    }

    /// Which cameras are meant.
    pub fn choice(&self) -> CameraChoice {
        match (&self.left, &self.right, &self.both) {
            (Some(left), Some(right), _) => {
                CameraChoice::Nodes { left: left.clone(), right: right.clone() }
            }
            (_, _, Some(both)) => CameraChoice::SideBySide(both.clone()),
            _ => CameraChoice::ByTopology,
        }
    }
}

/// Files that hold the calibration of a sensor, in the order in which they are looked for:
/// `$STSPP_CALIBRATION`, then `SERIAL.yaml` in the user's (`$XDG_CONFIG_HOME` or `~/.config`)
/// `stspp` folder, then in `/etc/stspp`.
pub fn calibration_files(serial: &str) -> Vec<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let home = variable("XDG_CONFIG_HOME")
        .or_else(|| Some(variable("HOME")?.join(".config")))
        .map(|config| config.join("stspp"));
    let name = format!("{serial}.yaml");
    let folders = home.into_iter().chain([PathBuf::from("/etc/stspp")]);
    variable("STSPP_CALIBRATION").into_iter().chain(folders.map(|f| f.join(&name))).collect()
}

/// The calibration of a sensor: `named`, or the first of [`calibration_files`].
///
/// # Errors
/// A file that is there and wrong; the inner error says that there is none.
pub fn find_calibration(
    named: Option<&Path>,
    serial: &str,
) -> Result<Result<StereoCalibration, CalibrationMissing>, Error> {
    if let Some(path) = named {
        return Ok(Ok(kalibr::read(path)?));
    }
    let looked_for = calibration_files(serial);
    match looked_for.iter().find(|path| path.exists()) {
        Some(path) => Ok(Ok(kalibr::read(path)?)),
        None => Ok(Err(CalibrationMissing { serial: serial.to_owned(), looked_for })),
    }
}

/// A sensor on USB.
#[cfg(feature = "usb")]
pub(crate) fn usb(
    source: &SourceUri,
    serial: Option<&str>,
    options: &[(String, String)],
) -> Result<Parts, Error> {
    use crate::transport::usb::{device, hotplug};
    let options = LiveOptions::parse("usb", options)?;
    let (transport, sensor) = device::open(serial)?;
    let wanted = (!sensor.serial.is_empty()).then(|| sensor.serial.clone());
    let reopen = move |timeout| {
        hotplug::wait_for(wanted.as_deref(), timeout)?;
        let (transport, _) = device::open(wanted.as_deref())?;
        Ok(Box::new(transport) as Box<dyn Transport>)
    };
    let usb_path = Some(sensor.usb_path);
    parts(source, Box::new(transport), usb_path, &options, Box::new(reopen))
}

/// A sensor behind a serial port.
pub(crate) fn serial(
    source: &SourceUri,
    path: Option<&Path>,
    options: &[(String, String)],
) -> Result<Parts, Error> {
    let options = LiveOptions::parse("serial", options)?;
    let path = match path {
        Some(path) => path.to_owned(),
        None => crate::transport::serial::discover()?,
    };
    let transport = SerialTransport::open(&path)?;
    let usb_path = crate::transport::serial::usb_path(&path);
    let reopen = move |timeout| {
        let deadline = std::time::Instant::now() + timeout;
        loop {
            match SerialTransport::open(&path) {
                Ok(transport) => return Ok(Box::new(transport) as Box<dyn Transport>),
                Err(error) if std::time::Instant::now() >= deadline => return Err(error),
                Err(_) => std::thread::sleep(std::time::Duration::from_millis(100)),
            }
        }
    };
    parts(source, Box::new(transport), usb_path, &options, Box::new(reopen))
}

fn parts(
    source: &SourceUri,
    transport: Box<dyn Transport>,
    control_usb_path: Option<String>,
    options: &LiveOptions,
    reopen: super::Reopen,
) -> Result<Parts, Error> {
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::new());
    // The calibration is found by the serial number that the device itself says.
    let (device, transport) = who_is_there(transport, &clock)?;
    let serial = device.serial.to_string();
    let calibration = find_calibration(options.calibration.as_deref(), &serial)?;
    let plan = CameraPlan {
        choice: options.choice(),
        control_usb_path,
        resolution_px: calibration.as_ref().ok().map(|c| c.left.resolution_px),
        exposure_us: options.exposure_us,
        gain: options.gain,
    };
    let cameras = Box::new(LiveCameras::new(plan, Arc::clone(&clock)));
    let source = source.clone();
    Ok(Parts { source, transport, cameras, clock, calibration, reopen: Some(reopen) })
}

fn who_is_there(
    transport: Box<dyn Transport>,
    clock: &Arc<dyn Clock>,
) -> Result<(DeviceInfo, Box<dyn Transport>), Error> {
    let mut link = Link::new(transport, Arc::clone(clock));
    let device = link.identify(&GetInfo)?;
    Ok((device, link.into_transport()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(options: &[(&str, &str)]) -> Result<LiveOptions, String> {
        let options: Vec<_> =
            options.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect();
        LiveOptions::parse("usb", &options).map_err(|error| error.to_string())
    }

    #[test]
    fn options_name_cameras_and_calibration() {
        let options = parse(&[("left", "/dev/video0"), ("right", "/dev/video2"), ("gain", "200")]);
        let options = options.unwrap();
        assert_eq!(options.gain, Some(200));
        assert!(matches!(options.choice(), CameraChoice::Nodes { .. }));
        assert_eq!(parse(&[]).unwrap().choice(), CameraChoice::ByTopology);
    }

    #[test]
    fn what_is_wrong_is_named() {
        assert!(parse(&[("colour", "red")]).unwrap_err().contains("colour"));
        assert!(parse(&[("left", "/dev/video0")]).unwrap_err().contains("right"));
        assert!(parse(&[("exposure_us", "long")]).unwrap_err().contains("microseconds"));
        assert!(parse(&[("calibration", "")]).unwrap_err().contains("a file"));
    }

    #[test]
    fn a_calibration_is_looked_for_by_the_serial_number() {
        let files = calibration_files("00AB");
        assert!(files.iter().all(|f| !f.as_os_str().is_empty()));
        assert_eq!(files.last().unwrap(), Path::new("/etc/stspp/00AB.yaml"));
    }
}
