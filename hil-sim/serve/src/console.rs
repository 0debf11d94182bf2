//! What the user of the simulated sensor can do to it, a line each.

use std::sync::{Arc, Mutex, PoisonError};

use stspp_hil_mcu::front::SharedController;
use stspp_hil_mcu::soc::peripheral::ResetCause;
use stspp_hil_sim::device::Controller;
use stspp_hil_sim::front::bench::Bench;
use stspp_hil_sim::front::eyes::FrameFault;
use stspp_hil_sim::front::plug::{Cable, Tampering};
use stspp_hil_sim::rig::CAMERAS;
use stspp_protocol::usb;

const HELP: &str = "unplug control|left|right, plug control|left|right, \
                    halt requests|replies|events, fault left|right lost|duplicated|lagging|short|corrupt, fault events|replies lost|corrupt, \
                    interlock open|closed, \
                    hang, reset, status";

/// Faults to come of one camera.
type Faults = Arc<Mutex<Vec<FrameFault>>>;

/// Cables, cameras and controller of the sensor.
pub struct Console {
    cables: [Cable; 3],
    faults: Vec<Faults>,
    bench: Arc<Bench>,
    chip: Option<SharedController>,
}

impl Console {
    /// Of the cables of control, left and right, both cameras' faults, the sensor, and its emulated chip
    /// unless the firmware's logic runs without one.
    pub fn new(
        cables: [Cable; 3],
        faults: Vec<Faults>,
        bench: Arc<Bench>,
        chip: Option<SharedController>,
    ) -> Self {
        Self { cables, faults, bench, chip }
    }

    /// Carries out a command; says what came of it, `ok` first when it was one.
    pub fn command(&self, line: &str) -> String {
        let words: Vec<&str> = line.split_whitespace().collect();
        let done = match words.as_slice() {
            ["unplug", device] => self.plug(device, false),
            ["plug", device] => self.plug(device, true),
            ["halt", endpoint] => self.halt(endpoint),
            ["fault", endpoint @ ("events" | "replies"), fault] => self.tamper(endpoint, fault),
            ["fault", camera, fault] => self.fault(camera, fault),
            ["interlock", "open"] => self.with_controller(|c| c.set_interlock_closed(false)),
            ["interlock", "closed"] => self.with_controller(|c| c.set_interlock_closed(true)),
            ["hang"] => self.with_chip(|chip| chip.hang()),
            ["reset"] => self.with_chip(|chip| chip.reset(ResetCause::Pin)),
            ["status"] => return format!("ok {}", self.status()),
            _ => None,
        };
        match done {
            Some(()) => "ok".into(),
            None => format!("not understood; commands: {HELP}"),
        }
    }

    fn plug(&self, device: &str, plugged: bool) -> Option<()> {
        let at = ["control", "left", "right"].iter().position(|known| *known == device)?;
        self.cables[at].set_plugged(plugged);
        Some(())
    }

    fn halt(&self, endpoint: &str) -> Option<()> {
        let endpoint = match endpoint {
            "requests" => usb::ENDPOINT_REQUESTS,
            "replies" => usb::ENDPOINT_REPLIES,
            "events" => usb::ENDPOINT_EVENTS,
            _ => return None,
        };
        self.cables[0].halt(endpoint);
        Some(())
    }

    fn fault(&self, camera: &str, fault: &str) -> Option<()> {
        let at = ["left", "right"].iter().position(|known| *known == camera)?;
        let fault = match fault {
            "lost" => FrameFault::Lost,
            "duplicated" => FrameFault::Duplicated,
            "lagging" => FrameFault::Lagging,
            "short" => FrameFault::Short,
            "corrupt" => FrameFault::Corrupt,
            _ => return None,
        };
        // Cameras side by side are one: the left one.
        self.faults.get(at)?.lock().unwrap_or_else(PoisonError::into_inner).push(fault);
        Some(())
    }

    fn tamper(&self, endpoint: &str, fault: &str) -> Option<()> {
        let tampering = match fault {
            "lost" => Tampering::Lost,
            "corrupt" => Tampering::Corrupt,
            _ => return None,
        };
        let endpoint =
            if endpoint == "events" { usb::ENDPOINT_EVENTS } else { usb::ENDPOINT_REPLIES };
        self.cables[0].tamper(endpoint, tampering);
        Some(())
    }

    fn with_controller(&self, act: impl FnOnce(&mut dyn Controller)) -> Option<()> {
        match &self.chip {
            Some(shared) => act(&mut shared.clone()),
            None => act(self.bench.rig().controller()),
        }
        Some(())
    }

    /// Only a chip can hang or be reset by its pin.
    fn with_chip(&self, act: impl FnOnce(&mut stspp_hil_mcu::chip::Chip)) -> Option<()> {
        act(self.chip.as_ref()?.lock().chip());
        Some(())
    }

    /// Light, cables, the sensor's time, and for each camera its exposures since it was started and how
    /// many of them the host did not fetch in time.
    fn status(&self) -> String {
        let lit = match &self.chip {
            Some(shared) => shared.lock().light_is_on(),
            None => !self.bench.rig().lit().is_empty(),
        };
        let plugged: Vec<bool> = self.cables.iter().map(Cable::is_plugged).collect();
        let rig = self.bench.rig();
        let time_ms = rig.now_ns() / 1_000_000;
        let [left, right] = CAMERAS
            .map(|camera| format!("{}-{}", rig.frames_made(camera), rig.frames_lost(camera)));
        format!("lit={lit} plugged={plugged:?} time_ms={time_ms} left={left} right={right}")
    }
}
