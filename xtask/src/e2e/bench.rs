//! The simulated sensor, the machine that it is plugged into, and what scenarios do with them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::Value;

use super::machine::{Machine, Reply};
use super::score::Score;
use super::server::Server;
use crate::workspace;

/// In most scenarios the cameras have 1/SCENE_SCALE of the pixels in each direction: the guest's processor
/// is emulated. What depends on size is tried at full size too.
pub const SCENE_SCALE: u32 = 4;

/// What the guest's programs wait for a result: its processor is emulated.
pub const TIMEOUT_S: &str = "20";

/// It is dark when no light was seen for so long: between two exposures there is none either.
const DARK: Duration = Duration::from_millis(400);

/// Where the guest finds the cameras' calibration.
pub const CALIBRATION: &str = "/etc/stspp/camchain.yaml";

/// What stands before the sensor.
pub const SCENE: &str = "sphere";

/// The simulated sensor's option for one camera that sends both pictures.
pub const SIDE_BY_SIDE: &str = "--side-by-side";

/// A device's name, virtio port and bus id.
pub type Device = (&'static str, &'static str, &'static str);

/// All devices.
pub const DEVICES: [Device; 3] =
    [("control", "usb-control", "1-1"), ("left", "usb-left", "1-2"), ("right", "usb-right", "1-3")];

/// Sensor and machine.
pub struct Bench {
    /// The machine.
    pub machine: Machine,
    /// The simulated sensor.
    pub server: Server,
    /// For files that come out of the guest.
    pub folder: PathBuf,
    /// The cameras have 1/scale of the pixels in each direction.
    pub scale: u32,
    /// How many times slower than an idle machine this one is: programs in the guest get so much more time.
    pub slowness: f64,
    /// The same scenes captured without USB, by their scale, once computed.
    pub in_process: BTreeMap<u32, Score>,
}

impl Bench {
    /// A bench whose devices are not plugged in yet.
    pub fn new(machine: Machine, server: Server, folder: &Path, slowness: f64) -> Self {
        let (folder, in_process) = (folder.to_owned(), BTreeMap::new());
        Self { machine, server, folder, scale: SCENE_SCALE, slowness, in_process }
    }

    /// Plugs all of `devices` in, and gives the guest their calibration.
    ///
    /// # Errors
    /// What the guest said.
    pub fn plug_all_in(&mut self, devices: &[Device]) -> Result<(), String> {
        let file = self.folder.join("camchain.yaml");
        let text =
            std::fs::read_to_string(&file).map_err(|e| format!("{}: {e}", file.display()))?;
        let reply = self.machine.request(&["write", CALIBRATION, &text.replace('\n', "\x1e")])?;
        if reply.code != 0 {
            return Err(format!("{CALIBRATION}: {}", reply.text()));
        }
        devices.iter().try_for_each(|(device, ..)| self.plug_in(device))
    }

    /// Unplugs the sensor and plugs in one whose cameras differ: in size, or as `options` say.
    ///
    /// # Errors
    /// When it does not start; what the guest said.
    pub fn exchange(&mut self, scale: u32, options: &[&str]) -> Result<(), String> {
        for (device, ..) in DEVICES {
            self.server.command(&format!("unplug {device}"))?;
        }
        // The guest's kernel takes a moment to let the old nodes go.
        std::thread::sleep(Duration::from_millis(1500));
        self.server.end();
        self.server = serve(&self.folder, scale, self.server.port, options)?;
        self.scale = scale;
        let cameras = if options.contains(&SIDE_BY_SIDE) { 1 } else { 2 };
        self.plug_all_in(&DEVICES[..1 + cameras])?;
        super::scenario::wait_for_nodes(self, 2 * cameras)?;
        let deadline = Instant::now() + Duration::from_secs(30);
        while !self.finds_sensor()? {
            if Instant::now() > deadline {
                return Err("the other sensor is not found".into());
            }
        }
        Ok(())
    }

    /// The source of the simulated sensor in the guest.
    pub fn source(&self) -> String {
        format!("usb:?calibration={CALIBRATION}")
    }

    /// Plugs a device into the guest.
    ///
    /// # Errors
    /// What the guest said.
    pub fn plug_in(&mut self, device: &str) -> Result<(), String> {
        let (_, port, bus_id) =
            DEVICES.into_iter().find(|(name, ..)| *name == device).ok_or("no such device")?;
        // After an unplugging the connection to the server comes back within a second.
        let deadline = Instant::now() + Duration::from_secs(15);
        loop {
            let reply = self.side(&["attach", port, bus_id])?;
            if reply.code == 0 {
                return Ok(());
            }
            if Instant::now() > deadline {
                return Err(format!("attach {bus_id}: {}", reply.text().trim()));
            }
            std::thread::sleep(Duration::from_millis(300));
        }
    }

    /// After the device restarted, and so left the bus: plugs it in again and waits until it is found.
    ///
    /// # Errors
    /// When it is not found within thirty seconds; what the guest said.
    pub fn plug_in_again(&mut self) -> Result<(), String> {
        // The kernel takes a moment to notice that it left.
        std::thread::sleep(Duration::from_millis(1500));
        let deadline = Instant::now() + Duration::from_secs(30);
        let mut plug_in_at = Instant::now();
        while !self.finds_sensor()? {
            let now = Instant::now();
            if now > deadline {
                return Err("the device did not come back".into());
            }
            if now >= plug_in_at {
                self.plug_in("control")?;
                plug_in_at = Instant::now() + Duration::from_secs(8);
            }
            std::thread::sleep(Duration::from_millis(300));
        }
        Ok(())
    }

    fn finds_sensor(&mut self) -> Result<bool, String> {
        let json = self.stspp_json(20, &["list", "--json"])?;
        let sensors = json["sensors"].as_array();
        Ok(sensors
            .is_some_and(|all| all.iter().any(|s| s["kind"] == "usb" && !s["serial"].is_null())))
    }

    /// What an idle machine would do in `seconds`, in words.
    fn patience_s(&self, seconds: u32) -> String {
        ((f64::from(seconds) * self.slowness) as u32).to_string()
    }

    /// A program in the guest that must succeed; its output.
    ///
    /// # Errors
    /// Its exit code and output.
    pub fn run(&mut self, seconds: u32, program: &str, words: &[&str]) -> Result<String, String> {
        let seconds = self.patience_s(seconds);
        let mut request = vec!["run", &seconds, program];
        request.extend(words);
        let reply = self.machine.request(&request)?;
        let text = reply.text();
        if reply.code == 0 {
            Ok(text)
        } else {
            Err(format!("{program} {}: code {}: {}", words.join(" "), reply.code, text.trim()))
        }
    }

    /// `stspp` in the guest.
    ///
    /// # Errors
    /// When the machine does not answer.
    pub fn stspp(&mut self, seconds: u32, words: &[&str]) -> Result<Reply, String> {
        let seconds = self.patience_s(seconds);
        let mut request = vec!["run", &seconds, "/bin/stspp"];
        request.extend(words);
        self.machine.request(&request)
    }

    /// `stspp` in the guest, which must succeed; its output.
    ///
    /// # Errors
    /// Its exit code and output.
    pub fn stspp_ok(&mut self, seconds: u32, words: &[&str]) -> Result<String, String> {
        self.run(seconds, "/bin/stspp", words)
    }

    /// `stspp` in the guest, which must print one JSON object.
    ///
    /// # Errors
    /// Its exit code and output.
    pub fn stspp_json(&mut self, seconds: u32, words: &[&str]) -> Result<Value, String> {
        let text = self.stspp_ok(seconds, words)?;
        let from = text.find('{').unwrap_or(0);
        serde_json::from_str(&text[from..]).map_err(|e| format!("{e}: {text}"))
    }

    /// Begins a stream of raw pairs in the guest.
    ///
    /// # Errors
    /// When the machine does not answer.
    pub fn start_stream(&mut self, count: &str, more: &[&str]) -> Result<(), String> {
        let (source, seconds) = (self.source(), self.patience_s(60));
        let mut words = vec!["run", &seconds, "/bin/stspp", "stream", "--pairs", "--json"];
        words.extend(["--timeout", TIMEOUT_S, "--source", &source, "-n", count]);
        words.extend(more);
        self.machine.send(&words)
    }

    /// Waits for the stream's end; its last counters.
    ///
    /// # Errors
    /// When it failed.
    pub fn finish_stream(&mut self) -> Result<Value, String> {
        let reply = self.machine.receive()?;
        let text = reply.text();
        if reply.code != 0 {
            return Err(format!("code {}: {}", reply.code, last_lines(&text)));
        }
        let line = text.lines().rfind(|line| line.contains("\"stats\"")).unwrap_or_default();
        let json: Value = serde_json::from_str(line).map_err(|e| format!("{e}: {text}"))?;
        Ok(json["stats"].clone())
    }

    /// Waits until the simulated sensor is lit.
    ///
    /// # Errors
    /// When it stays dark for twenty seconds; what the guest's program said then.
    pub fn wait_lit(&mut self) -> Result<(), String> {
        let deadline = Instant::now() + Duration::from_secs(20);
        while !self.server.is_lit()? {
            if Instant::now() > deadline {
                let said = self.machine.receive().map(|r| r.text()).unwrap_or_default();
                return Err(format!("no light: {}", last_lines(&said)));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(())
    }

    /// After a scenario that failed: what it left behind must not fail the next one too.
    pub fn tidy(&mut self) {
        let source = self.source();
        let words = ["doctor", "--clear-faults", "--quiet", "--source", &source];
        let _ = self.server.command("interlock closed");
        let _ = self.plug_in_again();
        let _ = self.stspp(20, &words);
        let _ = super::scenario::set_timing(self);
    }

    /// Waits until nothing is lit any more; how long it took.
    ///
    /// # Errors
    /// When there is light for five seconds.
    pub fn wait_dark(&self) -> Result<Duration, String> {
        let begun = Instant::now();
        let mut lit_at = begun;
        while lit_at.elapsed() < DARK {
            if self.server.is_lit()? {
                lit_at = Instant::now();
            }
            if lit_at - begun > Duration::from_secs(5) {
                return Err("the light stays on".into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(lit_at - begun)
    }

    /// Checks that nothing is lit.
    ///
    /// # Errors
    /// When something is.
    pub fn dark(&self) -> Result<(), String> {
        if self.wait_dark()?.is_zero() { Ok(()) } else { Err("light after the end".into()) }
    }

    /// A request while a program runs.
    ///
    /// # Errors
    /// When the machine does not answer.
    pub fn side(&mut self, words: &[&str]) -> Result<Reply, String> {
        self.machine.side(words)
    }

    /// A file of the guest.
    ///
    /// # Errors
    /// What the guest said.
    pub fn file(&mut self, path: &str) -> Result<Vec<u8>, String> {
        let reply = self.machine.request(&["read", path])?;
        if reply.code == 0 { Ok(reply.bytes) } else { Err(format!("{path}: {}", reply.text())) }
    }
}

/// Starts the simulated sensor; its calibration is written into `folder`.
///
/// # Errors
/// When it does not start.
pub fn serve(folder: &Path, scale: u32, port: u16, options: &[&str]) -> Result<Server, String> {
    let calibration = folder.join("camchain.yaml").display().to_string();
    let scale = scale.to_string();
    let arguments =
        ["--patient", "--scene", SCENE, "--scale", &scale, "--calibration", &calibration];
    let arguments = [&arguments, options].concat();
    Server::start(&built("hil-sim"), &arguments, port, &folder.join("hil-sim.log"))
}

/// Where cargo puts a program.
pub fn built(name: &str) -> PathBuf {
    workspace::root().join("target/debug").join(name)
}

fn last_lines(text: &str) -> String {
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(4)..].join(" | ")
}
