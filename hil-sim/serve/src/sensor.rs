//! The simulated sensor as three USB devices: control interface, left camera, right camera.

use std::sync::{Arc, Mutex};

use stspp_hil_mcu::controller::{McuController, firmware_elf};
use stspp_hil_mcu::front::{SharedController, UsbPort, share};
use stspp_hil_mcu::soc::Variant;
use stspp_hil_sim::device::Controller;
use stspp_hil_sim::device::in_process::{InProcess, InProcessOptions};
use stspp_hil_sim::front::bench::{Bench, Clock};
use stspp_hil_sim::front::control::ControlFunction;
use stspp_hil_sim::front::eyes::{Eye, FrameBank};
use stspp_hil_sim::front::plug::{Cable, Plugged};
use stspp_hil_sim::front::usb::UsbFunction;
use stspp_hil_sim::front::usbip::server::{Export, Server};
use stspp_hil_sim::front::uvc::UvcCamera;
use stspp_hil_sim::front::uvc::descriptors::{Description, PixelFormat};
use stspp_hil_sim::rig::{CAMERAS, Exposure, Rig, readout_ns};
use stspp_hil_sim::world::{Camera, LightInterval, LightSource, SceneSpec, SensorModel, World};
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::usb as ids;

use crate::console::Console;
use crate::pace::{self, Backlog};
use crate::{Format, Mcu, Simulated};

/// Exposures that a camera keeps for a host that is slow: a few, as cameras do.
const FRAMES_KEPT: usize = 8;

const FRAMES_PER_SECOND: u32 = 30;

/// Gain of 1, which the cameras have at first.
const GAIN_PERCENT: u32 = 100;

/// What is behind the control interface.
enum Control {
    Emulated(UsbPort, SharedController),
    InProcess(Box<InProcess>, String),
}

/// The sensor before it is served.
pub struct Sensor {
    world: Arc<World>,
    bank: Arc<FrameBank>,
    format: PixelFormat,
    side_by_side: bool,
    control: Control,
    clock: Clock,
    backlog: Backlog,
}

impl Sensor {
    /// Builds the scene and powers the controller.
    ///
    /// # Errors
    /// A scene that cannot be, or a firmware that does not start.
    pub fn new(simulated: &Simulated) -> Result<Self, Box<dyn std::error::Error>> {
        let (name, options) = simulated.scene.split_once('?').unwrap_or((&simulated.scene, ""));
        let options: Vec<(&str, &str)> =
            options.split('&').filter_map(|option| option.split_once('=')).collect();
        if !matches!(simulated.scale, 1 | 2 | 4 | 8 | 16) {
            return Err("--scale is 1, 2, 4, 8 or 16".into());
        }
        let (format, bits) = match simulated.format {
            Format::Grey => (PixelFormat::Grey, 8),
            Format::Y10 => (PixelFormat::Y10, 10),
            Format::Y12 => (PixelFormat::Y12, 12),
            Format::Y16 => (PixelFormat::Y16, 12),
            Format::Yuyv => (PixelFormat::Yuyv, 8),
        };
        let model = SensorModel::with_seed(simulated.seed).with_bits(bits);
        let model = if simulated.scale > 1 { model.scaled_down(simulated.scale) } else { model };
        let world = Arc::new(World::new(&SceneSpec::parse(name, &options)?, model)?);
        let (control, booted_ns) = control(simulated)?;
        let backlog = Backlog::default();
        let clock = pace::clock(booted_ns, simulated.patient, Arc::clone(&backlog));
        let control = match control {
            Unclocked::Emulated(controller) => {
                let (shared, port) =
                    share(*controller, Arc::clone(&clock)).ok_or("the chip has no USB")?;
                Control::Emulated(port, shared)
            }
            Unclocked::InProcess(device, serial) => Control::InProcess(device, serial),
        };
        let bank = Arc::new(FrameBank::new(Arc::clone(&world), format));
        let side_by_side = simulated.side_by_side;
        Ok(Self { world, bank, format, side_by_side, control, clock, backlog })
    }

    /// Scene and cameras.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Renders what each slot of the default timing shows, so that the stream need not wait for it.
    pub fn prepare(&self) {
        let timing = ProjectionTiming::default();
        let close_ns = u64::from(timing.exposure_us) * 1000;
        for slot in &timing.slots {
            let projectors = (0..16u8).filter(|k| slot.projector_mask & 1 << k != 0);
            let lit = projectors
                .map(LightSource::Projector)
                .chain(slot.floodlight.then_some(LightSource::Floodlight));
            let lights: Vec<_> =
                lit.map(|source| LightInterval { source, on_ns: 0, off_ns: close_ns }).collect();
            for camera in CAMERAS {
                let lights = lights.clone();
                let (sequence, open_ns, ready_ns) = (0, 0, close_ns);
                let exposure = Exposure { camera, sequence, open_ns, close_ns, ready_ns, lights };
                self.bank.prepare(&exposure, GAIN_PERCENT);
            }
        }
    }

    /// The devices on offer, in the order 1-1, 1-2, 1-3, and what their user can do to them.
    pub fn into_server(self) -> (Server, Console) {
        let model = self.world.model();
        let pixels = model.left.width * model.left.height;
        let cables = [Cable::default(), Cable::default(), Cable::default()];
        let backlog = self.backlog;
        let rig = |controller: Box<dyn Controller>| {
            let rig = Rig::new(controller, readout_ns(pixels), FRAMES_KEPT);
            backlog.get_or_init(|| rig.backlog());
            rig
        };
        let (bench, chip, control): (_, _, Arc<Mutex<dyn UsbFunction>>) = match self.control {
            Control::Emulated(port, shared) => {
                let bench = Bench::following(rig(Box::new(shared.clone())), self.clock);
                let bus = shared.clone();
                let bench = bench.with_frame_number(Arc::new(move |time_ns| {
                    let mut controller = bus.lock();
                    let chip = controller.chip();
                    let ago_ms = chip.now_ns().saturating_sub(time_ns).div_ceil(1_000_000);
                    let frame = u64::from(chip.soc().usbfs.host().frame());
                    let modulus = u64::from(ids::SOF_MODULUS);
                    ((frame + modulus - ago_ms % modulus) % modulus) as u16
                }));
                let port = Plugged::new(port, cables[0].clone());
                (Arc::new(bench), Some(shared), Arc::new(Mutex::new(port)))
            }
            Control::InProcess(device, serial) => {
                let bench = Arc::new(Bench::following(rig(device), self.clock));
                let function = ControlFunction::new(Arc::clone(&bench), &serial);
                let port = Plugged::new(function, cables[0].clone());
                (bench, None, Arc::new(Mutex::new(port)))
            }
        };
        let mut exports = vec![Export::new(control)];
        let mut faults = Vec::new();
        let eye = |camera| Eye::new(Arc::clone(&bench), Arc::clone(&self.bank), camera);
        let (left, right) = (&model.left, &model.right);
        let cameras = if self.side_by_side {
            let both = Eye::both(Arc::clone(&bench), Arc::clone(&self.bank));
            vec![(both, "cameras", left.width + right.width, left.height)]
        } else {
            vec![
                (eye(Camera::Left), "left camera", left.width, left.height),
                (eye(Camera::Right), "right camera", right.width, right.height),
            ]
        };
        for ((eye, name, width, height), cable) in cameras.into_iter().zip(&cables[1..]) {
            faults.push(eye.faults());
            let device = UvcCamera::new(description(name, [width, height], self.format), eye);
            let port: Arc<Mutex<dyn UsbFunction>> =
                Arc::new(Mutex::new(Plugged::new(device, cable.clone())));
            exports.push(Export::new(port));
        }
        (Server::new(exports), Console::new(cables, faults, bench, chip))
    }
}

/// A controller before its clock is known: the chip has used up some time to enumerate.
enum Unclocked {
    Emulated(Box<McuController>),
    InProcess(Box<InProcess>, String),
}

fn control(simulated: &Simulated) -> Result<(Unclocked, u64), Box<dyn std::error::Error>> {
    if simulated.mcu == Mcu::None {
        let options = InProcessOptions::seeded(simulated.seed);
        let serial = options.serial.to_string();
        return Ok((Unclocked::InProcess(Box::new(InProcess::new(options)), serial), 0));
    }
    let elf = simulated.firmware.clone().unwrap_or_else(|| firmware_elf(Variant::F350));
    let controller = McuController::load(Variant::F350, &elf).map_err(|error| {
        format!("{error}; build the firmware by `cargo xtask firmware`, or take --mcu none")
    })?;
    let booted_ns = controller.now_ns();
    Ok((Unclocked::Emulated(Box::new(controller)), booted_ns))
}

fn description(name: &str, [width, height]: [usize; 2], format: PixelFormat) -> Description {
    Description {
        vendor_id: ids::VENDOR_ID,
        product_id: ids::PRODUCT_ID,
        product: format!("stspp {name}"),
        serial: "SIMULATED".into(),
        width: width as u16,
        height: height as u16,
        format,
        interval_100ns: 10_000_000 / FRAMES_PER_SECOND,
    }
}
