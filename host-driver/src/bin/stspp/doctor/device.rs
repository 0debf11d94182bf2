//! The sensor that is plugged in: control interface, cameras, calibration.

use std::path::Path;

use stspp::camera::CameraError;
use stspp::camera::live::CameraPlan;
use stspp::camera::v4l2::node::{Node, NodeKind};
use stspp::camera::v4l2::pixels::PixelFormat;
use stspp::camera::v4l2::topology::{SensorCameras, UsbCamera};
use stspp::sensor::open::{LiveOptions, calibration_files};
use stspp::transport::serial;
use stspp::{Error, Sensor, SourceUri};
use stspp_protocol::version::PROTOCOL_VERSION;

use super::{Check, Verdict};

/// Part of a high-speed or faster bus that pictures can take (USB 2.0, 5.8.4: 13 of 15 microframe
/// packets is the theory, hubs and hosts take more).
const USABLE: f64 = 0.7;

/// The sensor's frame rate.
const FRAMES_PER_S: f64 = 30.0;

/// All checks of the sensor that `uri` names.
pub fn checks(uri: &SourceUri) -> Vec<Check> {
    let mut checks = Vec::new();
    let (usb_path, options) = match uri {
        SourceUri::Usb { serial, options } => (plugged(serial.as_deref(), &mut checks), options),
        SourceUri::Serial { path, options } => (port(path.as_deref(), &mut checks), options),
        _ => return checks,
    };
    let options = match LiveOptions::parse("usb", options) {
        Ok(options) => options,
        Err(error) => {
            checks.push(Check::bad("options", error.to_string(), "see docs/cli.md"));
            return checks;
        }
    };
    let (sensor, resolution_px) = control(uri, &mut checks);
    let plan = CameraPlan {
        choice: options.choice(),
        control_usb_path: usb_path,
        resolution_px,
        exposure_us: options.exposure_us,
        gain: options.gain,
    };
    cameras(&plan, &mut checks);
    if let Some(sensor) = sensor.filter(|_| checks.iter().all(|c| c.verdict != Verdict::Bad)) {
        checks.push(cameras_start(&sensor));
    }
    checks
}

/// The serial ports that may have a sensor, and whether they can be opened; the USB device of the one
/// that is meant.
fn port(path: Option<&Path>, checks: &mut Vec<Check>) -> Option<String> {
    const NAME: &str = "serial port";
    let ports = match path {
        Some(path) => vec![path.to_owned()],
        None => serial::ports(),
    };
    if ports.is_empty() {
        let remedy =
            "plug the USB-UART bridge in; its driver (cp210x, ch341, ftdi_sio) comes with it";
        checks.push(Check::bad(NAME, "no port of a USB bridge", remedy));
    }
    for port in &ports {
        let shown = port.display();
        let opened = std::fs::OpenOptions::new().read(true).write(true).open(port);
        checks.push(match opened {
            Ok(_) => Check::good(NAME, format!("{shown} can be opened")),
            Err(error) => {
                let remedy = match error.kind() {
                    std::io::ErrorKind::PermissionDenied => {
                        "join its group and log in again: sudo usermod -aG dialout $USER"
                    }
                    std::io::ErrorKind::ResourceBusy => "close the program that uses it",
                    _ => "plug the USB-UART bridge in; `stspp list --probe-serial` shows the ports",
                };
                Check::bad(NAME, format!("{shown}: {error}"), remedy)
            }
        });
    }
    match ports.as_slice() {
        [port] => serial::usb_path(port),
        _ => None,
    }
}

/// Starts the cameras for a moment, without light: shows one that another program has, and one that
/// delivers another size than the calibration's.
fn cameras_start(sensor: &Sensor) -> Check {
    const NAME: &str = "cameras start";
    match sensor.try_start() {
        Ok(()) => Check::good(NAME, "both, at the calibration's size"),
        Err(error) => {
            let remedy = match &error {
                Error::Camera(CameraError::Busy { .. }) => "close the program that uses it",
                Error::Camera(CameraError::Size { .. }) => {
                    "use the calibration of this sensor, or cameras of its model"
                }
                _ => "unplug the cameras and plug them in again",
            };
            Check::bad(NAME, error.to_string(), remedy)
        }
    }
}

#[cfg(feature = "usb")]
fn plugged(serial: Option<&str>, checks: &mut Vec<Check>) -> Option<String> {
    const NAME: &str = "on the bus";
    let sensors = match stspp::transport::usb::device::sensors() {
        Ok(sensors) => sensors,
        Err(error) => {
            checks.push(Check::bad(NAME, error.to_string(), "is this a container without USB?"));
            return None;
        }
    };
    let mut fitting = sensors.iter().filter(|s| serial.is_none_or(|wanted| s.serial == wanted));
    let Some(sensor) = fitting.next() else {
        let there: Vec<&str> = sensors.iter().map(|s| s.serial.as_str()).collect();
        let found = match there.as_slice() {
            [] => "no sensor".to_owned(),
            others => format!("not that one, but {}", others.join(", ")),
        };
        let remedy = "check cable and power; `lsusb -d 1209:000a` should show it";
        checks.push(Check::bad(NAME, found, remedy));
        return None;
    };
    if fitting.next().is_some() {
        let remedy = "name one: `--source usb:SERIAL`";
        checks.push(Check::bad(NAME, format!("{} sensors", sensors.len()), remedy));
        return None;
    }
    let found =
        format!("{} at port {}, {} Mbit/s", sensor.serial, sensor.usb_path, sensor.speed_mbit_s);
    checks.push(Check::good(NAME, found));
    let writable = std::fs::OpenOptions::new().read(true).write(true).open(&sensor.node);
    let node = sensor.node.display();
    checks.push(match writable {
        Ok(_) => Check::good("permission", format!("{node} can be opened")),
        Err(error) => Check::bad(
            "permission",
            format!("{node}: {error}"),
            "install the udev rule (above) and plug the sensor in again, or run as root once",
        ),
    });
    Some(sensor.usb_path.clone())
}

#[cfg(not(feature = "usb"))]
fn plugged(_serial: Option<&str>, checks: &mut Vec<Check>) -> Option<String> {
    checks.push(Check::bad("on the bus", "no USB in this build", "build with the feature `usb`"));
    None
}

/// Handshake, versions, faults, calibration; the sensor and the calibration's image size.
fn control(uri: &SourceUri, checks: &mut Vec<Check>) -> (Option<Sensor>, Option<[usize; 2]>) {
    let sensor = match Sensor::open_uri(uri) {
        Ok(sensor) => sensor,
        Err(error) => {
            let remedy = match &error {
                Error::Refused { .. } => "update the older of firmware and stspp",
                Error::Timeout(_) => "unplug the sensor and plug it in again; is its power on?",
                Error::Calibration(_) => "mend or replace that file",
                _ => "see the message",
            };
            checks.push(Check::bad("handshake", error.to_string(), remedy));
            return (None, None);
        }
    };
    let info = sensor.info();
    let or_unknown = |value: Option<String>| value.unwrap_or_else(|| "unknown".into());
    let serial = or_unknown(info.serial.clone());
    checks.push(Check::good(
        "handshake",
        format!(
            "board {}, firmware {}, protocol {} (this program {PROTOCOL_VERSION})",
            or_unknown(info.board),
            or_unknown(info.firmware),
            or_unknown(info.protocol),
        ),
    ));
    checks.push(state(&sensor));
    let resolution_px = match sensor.calibration() {
        Ok(calibration) => {
            let [width, height] = calibration.left.resolution_px;
            let found =
                format!("{width}x{height} px, {:.1} mm apart", calibration.baseline_m() * 1e3);
            checks.push(Check::good("calibration", found));
            Some(calibration.left.resolution_px)
        }
        Err(_) => {
            let files = calibration_files(&serial);
            let place = files.first().map_or(String::new(), |f| f.display().to_string());
            let remedy = format!("put the sensor's camchain.yaml at {place}");
            checks.push(Check::bad("calibration", format!("none for {serial}"), remedy));
            None
        }
    };
    (Some(sensor), resolution_px)
}

fn state(sensor: &Sensor) -> Check {
    const NAME: &str = "state";
    match sensor.status() {
        Ok(status) if !status.latched.is_empty() => Check::bad(
            NAME,
            format!("latched faults: {}", status.latched),
            "remove the cause, then `stspp doctor --clear-faults`",
        ),
        Ok(status) if !status.interlock_closed => {
            Check::bad(NAME, "the interlock is open", "close the housing or its plug")
        }
        Ok(status) => Check::good(
            NAME,
            format!("{}, {:.1} degrees C", status.state, f32::from(status.temperature_dc) / 10.0),
        ),
        Err(error) => Check::bad(NAME, error.to_string(), "unplug the sensor and plug it in again"),
    }
}

fn cameras(plan: &CameraPlan, checks: &mut Vec<Check>) {
    let found = match plan.find() {
        Ok(found) => found,
        Err(error) => {
            let remedy = match error {
                CameraError::NotFound { found: 0 } => {
                    "check the cameras' cables and power; `modprobe uvcvideo`"
                }
                CameraError::Gone { .. } => "check that camera's cable and power",
                _ => "name the nodes: `?left=/dev/video0&right=/dev/video2`",
            };
            checks.push(Check::bad("cameras", error.to_string(), remedy));
            return;
        }
    };
    let (all, pictures) = match &found {
        SensorCameras::Two { left, right } => {
            (vec![("left camera", left), ("right camera", right)], 1)
        }
        SensorCameras::SideBySide(both) => (vec![("camera", both)], 2),
    };
    let mut bits_per_s = 0.0;
    for (name, camera) in &all {
        bits_per_s += one_camera(name, camera, plan, pictures, checks);
    }
    let slowest = all.iter().map(|(_, c)| c.speed_mbit_s).filter(|s| *s > 0).min();
    let Some(mbit_s) = slowest.filter(|_| bits_per_s > 0.0) else { return };
    let usable = f64::from(mbit_s) * 1e6 * USABLE;
    // Two cameras on one high-speed bus share it.
    let found = format!(
        "{:.0} Mbit/s of pictures at {FRAMES_PER_S} Hz, about {:.0} of {mbit_s} Mbit/s can be used",
        bits_per_s / 1e6,
        usable / 1e6
    );
    checks.push(if bits_per_s <= usable {
        Check::good("bandwidth", found)
    } else {
        let period_us = 1e6 * bits_per_s / usable / FRAMES_PER_S;
        let remedy = format!(
            "use a USB 3 port (a blue one), or a frame period of {:.0} us or more: `stspp timing set \
             --period-us`",
            (period_us / 1000.0).ceil() * 1000.0
        );
        Check::poor("bandwidth", found, remedy)
    });
}

/// Checks one camera; gives the bits per second that it wants.
fn one_camera(
    name: &'static str,
    camera: &UsbCamera,
    plan: &CameraPlan,
    pictures: usize,
    checks: &mut Vec<Check>,
) -> f64 {
    let [width, height] = plan.settings().resolution_px;
    let mut metadata = false;
    let mut format = None;
    for path in &camera.nodes {
        let node = match Node::open(path) {
            Ok(node) => node,
            Err(error) => {
                let remedy = match error.kind() {
                    std::io::ErrorKind::PermissionDenied => "install the udev rule (above)",
                    std::io::ErrorKind::ResourceBusy => "close the program that uses it",
                    _ => "plug the camera in again",
                };
                checks.push(Check::bad(name, format!("{}: {error}", path.display()), remedy));
                return 0.0;
            }
        };
        match node.kind() {
            NodeKind::Metadata => metadata = true,
            NodeKind::Video => {
                let offered = node.pixel_formats();
                format = PixelFormat::ALL.into_iter().find(|f| offered.contains(&f.fourcc()));
            }
        }
    }
    let place =
        if camera.usb_path.is_empty() { "not on USB".into() } else { camera.usb_path.clone() };
    let Some(format) = format else {
        let found = format!("{:?} ({place}): no grey format", camera.product);
        checks.push(Check::bad(name, found, "only GREY, Y10, Y12, Y16 and YUYV can be used"));
        return 0.0;
    };
    let clock = if metadata && camera.clock_hz.is_some() { "own clock" } else { "driver's clock" };
    let found = format!(
        "{:?} at {place}, {} Mbit/s, {format:?}, {clock}",
        camera.product, camera.speed_mbit_s
    );
    checks.push(if clock == "own clock" {
        Check::good(name, found)
    } else {
        let remedy =
            "frames pair by arrival times then; a kernel with UVC metadata nodes tells more";
        Check::poor(name, found, remedy)
    });
    (width * height * pictures * format.bytes() * 8) as f64 * FRAMES_PER_S
}
