//! Which video nodes belong to which camera, and which cameras to which sensor, by where they hang on
//! the USB tree. All of it is read from sysfs.

use crate::camera::CameraError;
use crate::sync::Side;
use std::fs;
use std::path::{Path, PathBuf};

/// A camera at a USB port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbCamera {
    /// Kernel name of its USB device: bus, then the ports on the way, such as `1-2.3`.
    pub usb_path: String,
    /// Product string, empty when it has none.
    pub product: String,
    /// Serial number, empty when it has none.
    pub serial: String,
    /// Vendor and product id.
    pub ids: [u16; 2],
    /// Speed in Mbit/s as the kernel states it.
    pub speed_mbit_s: u32,
    /// Its device nodes, lowest number first: pictures and, with a recent kernel, metadata.
    pub nodes: Vec<PathBuf>,
    /// Rate of the camera's clock, if its descriptors state one.
    pub clock_hz: Option<u32>,
}

/// All USB cameras of this machine, in the order of their ports.
pub fn usb_cameras() -> Vec<UsbCamera> {
    usb_cameras_in(Path::new("/sys/class/video4linux"))
}

fn usb_cameras_in(class: &Path) -> Vec<UsbCamera> {
    let mut nodes: Vec<(u32, PathBuf)> = fs::read_dir(class)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| {
            let number = entry.file_name().to_str()?.strip_prefix("video")?.parse().ok()?;
            // The node's device is a USB interface; its parent is the USB device.
            let interface = fs::canonicalize(entry.path().join("device")).ok()?;
            Some((number, interface.parent()?.to_path_buf()))
        })
        .collect();
    nodes.sort();
    let mut cameras: Vec<UsbCamera> = Vec::new();
    for (number, device) in nodes {
        let Some(usb_path) = device.file_name().map(|n| n.to_string_lossy().into_owned()) else {
            continue;
        };
        if !device.join("idVendor").exists() {
            continue;
        }
        let node = PathBuf::from(format!("/dev/video{number}"));
        if let Some(known) = cameras.iter_mut().find(|c| c.usb_path == usb_path) {
            known.nodes.push(node);
            continue;
        }
        let text = |name: &str| {
            fs::read_to_string(device.join(name)).unwrap_or_default().trim().to_owned()
        };
        let id = |name: &str| u16::from_str_radix(&text(name), 16).unwrap_or(0);
        let descriptors = fs::read(device.join("descriptors")).unwrap_or_default();
        cameras.push(UsbCamera {
            product: text("product"),
            serial: text("serial"),
            ids: [id("idVendor"), id("idProduct")],
            speed_mbit_s: text("speed").parse().unwrap_or(0),
            nodes: vec![node],
            clock_hz: super::metadata::clock_hz(&descriptors),
            usb_path,
        });
    }
    cameras.sort_by_key(|c| port_numbers(&c.usb_path));
    cameras
}

/// The cameras of a sensor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SensorCameras {
    /// One camera for each side.
    Two {
        /// Left.
        left: UsbCamera,
        /// Right.
        right: UsbCamera,
    },
    /// One camera that delivers both pictures beside each other.
    SideBySide(UsbCamera),
}

/// The cameras that hang nearest to the control interface at `control_usb_path`.
///
/// A sensor has a hub inside, so that its parts share all ports but the last. A USB 3 hub is two hubs to
/// the kernel, one on each bus: the control interface is at the one for slow devices, fast cameras at
/// its twin. One camera that says "left" in its product string and one that says "right" are that,
/// whatever else is there; otherwise, of two cameras, the lower port is left. A single camera is taken
/// for one that delivers both pictures, unless it says that it is the left or the right one.
///
/// # Errors
/// [`CameraError::NotFound`] when there are neither one nor two, [`CameraError::Gone`] when one of two
/// is missing.
pub fn cameras_of(
    control_usb_path: Option<&str>,
    cameras: &[UsbCamera],
) -> Result<SensorCameras, CameraError> {
    cameras_at(control_usb_path, cameras, |hub| twin_in(Path::new("/sys/bus/usb/devices"), hub))
}

fn cameras_at(
    control_usb_path: Option<&str>,
    cameras: &[UsbCamera],
    twin: impl Fn(&str) -> Option<String>,
) -> Result<SensorCameras, CameraError> {
    let near = match control_usb_path {
        Some(control) => {
            let hub = hub_of(control);
            let twin = twin(hub);
            let is_near = |camera: &&UsbCamera| {
                let other = hub_of(&camera.usb_path);
                other == hub || Some(other) == twin.as_deref()
            };
            cameras.iter().filter(is_near).collect::<Vec<_>>()
        }
        None => cameras.iter().collect(),
    };
    let says = |camera: &UsbCamera, side: &str| camera.product.to_ascii_lowercase().contains(side);
    let named = |side| -> Vec<_> { near.iter().filter(|camera| says(camera, side)).collect() };
    if let ([left], [right]) = (named("left").as_slice(), named("right").as_slice()) {
        return Ok(SensorCameras::Two { left: (**left).clone(), right: (**right).clone() });
    }
    match near.as_slice() {
        [one] if says(one, "left") => Err(CameraError::Gone { side: Side::Right }),
        [one] if says(one, "right") => Err(CameraError::Gone { side: Side::Left }),
        [one] => Ok(SensorCameras::SideBySide((*one).clone())),
        [a, b] => {
            let swapped = says(a, "right") || says(b, "left");
            let (left, right) = if swapped { (b, a) } else { (a, b) };
            Ok(SensorCameras::Two { left: (*left).clone(), right: (*right).clone() })
        }
        other => Err(CameraError::NotFound { found: other.len() }),
    }
}

/// A USB path without its last port: `1-2.3` is at hub `1-2`, `1-2` at hub `1`.
fn hub_of(usb_path: &str) -> &str {
    usb_path.rsplit_once(['.', '-']).map_or("", |(hub, _)| hub)
}

/// The hub that shares its housing with `hub`, on the bus of the other speed: where the kernel says that
/// the ports that both hang at are one socket.
fn twin_in(devices: &Path, hub: &str) -> Option<String> {
    let port = fs::canonicalize(devices.join(hub).join("port/peer")).ok()?;
    // `usb2-port3` is port 3 of the root hub of bus 2, `2-3-port1` is port 1 of the hub at `2-3`.
    let (parent, number) = port.file_name()?.to_str()?.rsplit_once("-port")?;
    Some(match parent.strip_prefix("usb") {
        Some(bus) => format!("{bus}-{number}"),
        None => format!("{parent}.{number}"),
    })
}

fn port_numbers(usb_path: &str) -> Vec<u32> {
    usb_path.split(['-', '.']).map(|number| number.parse().unwrap_or(u32::MAX)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(usb_path: &str, product: &str) -> UsbCamera {
        UsbCamera {
            usb_path: usb_path.into(),
            product: product.into(),
            serial: String::new(),
            ids: [0; 2],
            speed_mbit_s: 480,
            nodes: vec![],
            clock_hz: None,
        }
    }

    #[test]
    fn only_cameras_at_the_sensors_hub_count() {
        let all = [
            camera("1-2.2", "IR"),
            camera("1-2.3", "IR"),
            camera("1-3", "webcam"),
            camera("2-2.2", ""),
        ];
        let found = cameras_of(Some("1-2.1"), &all).unwrap();
        assert_eq!(found, SensorCameras::Two { left: all[0].clone(), right: all[1].clone() });
        let alone = cameras_of(Some("2-2.1"), &all).unwrap();
        assert_eq!(alone, SensorCameras::SideBySide(all[3].clone()));
        let none = cameras_of(Some("4-1"), &all);
        assert!(matches!(none, Err(CameraError::NotFound { found: 0 })));
        assert!(matches!(cameras_of(None, &all), Err(CameraError::NotFound { found: 4 })));
    }

    #[test]
    fn fast_cameras_are_at_the_twin_of_the_sensors_hub() {
        let all = [camera("2-4.1", "IR"), camera("2-4.2", "IR"), camera("2-1.1", "webcam")];
        let twin = |hub: &str| (hub == "1-2").then(|| "2-4".to_owned());
        let found = cameras_at(Some("1-2.3"), &all, twin).unwrap();
        assert_eq!(found, SensorCameras::Two { left: all[0].clone(), right: all[1].clone() });
        let apart = cameras_at(Some("1-2.3"), &all, |_| None);
        assert!(matches!(apart, Err(CameraError::NotFound { found: 0 })));
    }

    #[test]
    fn twins_are_read_as_the_kernel_lays_them_out() {
        let folder = std::env::temp_dir().join(format!("stspp-peers-{}", std::process::id()));
        for (hub, port, peer) in
            [("1-2", "usb1-port2", "usb2-port4"), ("1-2.3", "1-2-port3", "2-4-port3")]
        {
            let at = folder.join("ports").join(port);
            let other = folder.join("ports").join(peer);
            fs::create_dir_all(folder.join(hub)).unwrap();
            fs::create_dir_all(&at).unwrap();
            fs::create_dir_all(&other).unwrap();
            std::os::unix::fs::symlink(&other, at.join("peer")).unwrap();
            std::os::unix::fs::symlink(&at, folder.join(hub).join("port")).unwrap();
        }
        let twins = ["1-2", "1-2.3", "1-7"].map(|hub| twin_in(&folder, hub));
        fs::remove_dir_all(&folder).unwrap();
        assert_eq!(twins, [Some("2-4".to_owned()), Some("2-4.3".to_owned()), None]);
    }

    #[test]
    fn names_decide_the_sides_before_ports_do() {
        let all = [camera("1-1", "Right IR"), camera("1-2", "Left IR")];
        let found = cameras_of(Some("1-3"), &all).unwrap();
        assert_eq!(found, SensorCameras::Two { left: all[1].clone(), right: all[0].clone() });
    }

    #[test]
    fn one_of_two_is_not_both_side_by_side() {
        for (product, missing) in [("IR left", Side::Right), ("IR right", Side::Left)] {
            let found = cameras_of(Some("1-3"), &[camera("1-1", product)]);
            assert!(matches!(found, Err(CameraError::Gone { side }) if side == missing));
        }
    }

    #[test]
    fn a_webcam_beside_named_cameras_is_left_out() {
        let all = [camera("1-1", "Webcam"), camera("1-2", "IR left"), camera("1-4", "IR right")];
        let found = cameras_of(Some("1-3"), &all).unwrap();
        assert_eq!(found, SensorCameras::Two { left: all[1].clone(), right: all[2].clone() });
    }

    #[test]
    fn ports_are_ordered_as_numbers() {
        assert!(port_numbers("1-2.10") > port_numbers("1-2.9"));
        assert_eq!(hub_of("1-2.3"), "1-2");
        assert_eq!(hub_of("1-2"), "1");
    }

    #[test]
    fn sysfs_is_read_as_the_kernel_lays_it_out() {
        let folder = std::env::temp_dir().join(format!("stspp-sysfs-{}", std::process::id()));
        let device = folder.join("devices/usb1/1-2");
        let class = folder.join("class");
        for number in [0, 1] {
            let node = class.join(format!("video{number}"));
            fs::create_dir_all(&node).unwrap();
            let interface = device.join("1-2:1.0");
            fs::create_dir_all(&interface).unwrap();
            std::os::unix::fs::symlink(&interface, node.join("device")).unwrap();
        }
        for (name, text) in [
            ("idVendor", "1209\n"),
            ("idProduct", "5753\n"),
            ("product", "left\n"),
            ("speed", "480\n"),
        ] {
            fs::write(device.join(name), text).unwrap();
        }
        let cameras = usb_cameras_in(&class);
        fs::remove_dir_all(&folder).unwrap();
        assert_eq!(cameras.len(), 1);
        assert_eq!(cameras[0].ids, [0x1209, 0x5753]);
        assert_eq!(cameras[0].nodes, [PathBuf::from("/dev/video0"), "/dev/video1".into()]);
        assert_eq!((cameras[0].usb_path.as_str(), cameras[0].speed_mbit_s), ("1-2", 480));
    }
}
