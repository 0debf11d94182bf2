//! The simulated sensor, the machine that it is plugged into, and what scenarios do with them.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::machine::{Machine, Reply};
use super::server::Server;
use crate::workspace;

/// The cameras have 1/SCENE_SCALE of the pixels in each direction: the guest's processor is emulated, and
/// its kernel moves about 10 MB/s from USB with all of it. Full-size pictures at the slowest rate would
/// be 40.
pub const SCENE_SCALE: u32 = 4;

/// What the guest's programs wait for a result: its processor is emulated.
pub const TIMEOUT_S: &str = "20";

/// How depth is matched, in the guest and in process: the fastest of the sub-pixel methods, because
/// per-point IC-GN takes minutes on an emulated processor.
pub const METHOD: &str = "dense";

/// Depth frames that are held against the truth: the RMS of one varies by two per cent.
pub const DEPTH_FRAMES: &str = "3";

/// It is dark when no light was seen for so long: between two exposures there is none either.
const DARK: Duration = Duration::from_millis(400);

/// Where the guest finds the cameras' calibration.
pub const CALIBRATION: &str = "etc/stspp/camchain.yaml";

/// Devices by name: virtio port and bus id.
pub const DEVICES: [(&str, &str, &str); 3] =
    [("control", "usb-control", "1-1"), ("left", "usb-left", "1-2"), ("right", "usb-right", "1-3")];

/// Sensor and machine.
pub struct Bench {
    /// The machine.
    pub machine: Machine,
    /// The simulated sensor.
    pub server: Server,
    /// For files that come out of the guest.
    pub folder: PathBuf,
    /// The in-process result, once computed.
    in_process: Option<Score>,
    /// The program that compares clouds with the truth.
    pub scorer: PathBuf,
    /// The program under test, on this machine.
    pub stspp: PathBuf,
}

/// How a cloud compares with the truth.
#[derive(Debug, Clone, Copy)]
pub struct Score {
    /// Points of a frame.
    pub points: u64,
    /// RMS of a frame's errors within 5 mm.
    pub rms_mm: f64,
}

impl Score {
    fn mean(scores: &[Self]) -> Self {
        let count = scores.len().max(1);
        Self {
            points: scores.iter().map(|s| s.points).sum::<u64>() / count as u64,
            rms_mm: scores.iter().map(|s| s.rms_mm).sum::<f64>() / count as f64,
        }
    }
}

impl Bench {
    /// A bench whose devices are not plugged in yet.
    pub fn new(
        machine: Machine,
        server: Server,
        folder: &Path,
        stspp: PathBuf,
        scorer: PathBuf,
    ) -> Self {
        Self { machine, server, folder: folder.to_owned(), in_process: None, scorer, stspp }
    }

    /// The source of the simulated sensor in the guest.
    pub fn source(&self) -> String {
        format!("usb:?calibration=/{CALIBRATION}")
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

    /// A program in the guest that must succeed; its output.
    ///
    /// # Errors
    /// Its exit code and output.
    pub fn run(&mut self, seconds: u32, program: &str, words: &[&str]) -> Result<String, String> {
        let seconds = seconds.to_string();
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
        let seconds = seconds.to_string();
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
        let source = self.source();
        let mut words = vec!["run", "60", "/bin/stspp", "stream", "--pairs", "--json"];
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

    /// Compares the clouds that the guest has captured into `folder` with the scene.
    ///
    /// # Errors
    /// When one is not there, or the comparison fails.
    pub fn score(&mut self, folder: &str) -> Result<Score, String> {
        let mut scores = Vec::new();
        for name in cloud_names() {
            let cloud = self.file(&format!("{folder}/{name}"))?;
            let path = self.folder.join("guest.ply");
            std::fs::write(&path, cloud).map_err(|e| format!("{}: {e}", path.display()))?;
            scores.push(self.score_file(&path)?);
        }
        Ok(Score::mean(&scores))
    }

    fn score_file(&self, path: &Path) -> Result<Score, String> {
        let output = Command::new(&self.scorer)
            .arg(path)
            .arg(scene_uri())
            .output()
            .map_err(|e| format!("{}: {e}", self.scorer.display()))?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let json: Value = serde_json::from_str(&text).map_err(|_| {
            format!("comparison with the truth: {}", String::from_utf8_lossy(&output.stderr))
        })?;
        let rms_mm = json["rms_mm"].as_f64().unwrap_or(f64::NAN);
        Ok(Score { points: json["points"].as_u64().unwrap_or(0), rms_mm })
    }

    /// The same scene captured on this machine, without USB: computed once.
    ///
    /// # Errors
    /// When that fails.
    pub fn in_process_score(&mut self) -> Result<Score, String> {
        if let Some(score) = self.in_process {
            return Ok(score);
        }
        let out = self.folder.join("in-process");
        let status = Command::new(&self.stspp)
            .args([
                "capture",
                "--quiet",
                "--force",
                "--method",
                METHOD,
                "-n",
                DEPTH_FRAMES,
                "--source",
            ])
            .args([&scene_uri(), "--out"])
            .arg(&out)
            .stdout(std::process::Stdio::null())
            .status();
        if !status.is_ok_and(|s| s.success()) {
            return Err("the capture in process failed".into());
        }
        let scores: Result<Vec<Score>, String> =
            cloud_names().map(|name| self.score_file(&out.join(name))).collect();
        let score = Score::mean(&scores?);
        self.in_process = Some(score);
        Ok(score)
    }
}

/// Where [`DEPTH_FRAMES`] captured frames have their clouds.
fn cloud_names() -> impl Iterator<Item = String> {
    (0..DEPTH_FRAMES.parse().unwrap_or(1)).map(|k: u32| format!("{k:04}/cloud.ply"))
}

/// The scene as a source of the in-process simulator.
pub fn scene_uri() -> String {
    format!("sim:sphere?scale={SCENE_SCALE}")
}

/// Where cargo puts a program.
pub fn built(name: &str) -> PathBuf {
    workspace::root().join("target/debug").join(name)
}

fn last_lines(text: &str) -> String {
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(4)..].join(" | ")
}
