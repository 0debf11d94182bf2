//! How clouds compare with what stands before the simulated sensor, in the guest and without USB.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::Value;

use super::bench::{Bench, SCENE, built};

/// How depth is matched, in the guest and in process: the fastest of the sub-pixel methods, because
/// per-point IC-GN takes minutes on an emulated processor.
pub const METHOD: &str = "dense";

/// Depth frames of which the in-process figure is the mean. Noise makes the RMS of one vary by some per
/// cent, and frames whose windows overlap vary together: one window of each cycle is taken.
const FRAMES_IN_PROCESS: usize = 6;

/// Slots of a cycle.
const CYCLE: usize = 10;

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// How clouds compare with the truth.
#[derive(Debug, Clone, Default)]
pub struct Score {
    /// Mean number of points of a frame.
    pub points: u64,
    /// RMS of each frame's errors within 5 mm.
    pub rms_mm: Vec<f64>,
    /// Median magnitude of each frame's errors.
    pub median_mm: Vec<f64>,
}

impl Score {
    /// Standard deviation of the frames' RMS.
    pub fn deviation_mm(&self) -> f64 {
        let mean = mean(&self.rms_mm);
        let squares: f64 = self.rms_mm.iter().map(|rms| (rms - mean).powi(2)).sum();
        (squares / self.rms_mm.len().saturating_sub(1).max(1) as f64).sqrt()
    }

    fn add(&mut self, cloud: &Path, scene: &str) -> Result<(), String> {
        let scorer = built("examples/cloud_against_truth");
        let output = Command::new(&scorer)
            .arg(cloud)
            .arg(scene)
            .output()
            .map_err(|e| format!("{}: {e}", scorer.display()))?;
        let json: Value = serde_json::from_slice(&output.stdout).map_err(|_| {
            format!("comparison with the truth: {}", String::from_utf8_lossy(&output.stderr))
        })?;
        let frames = self.rms_mm.len() as u64;
        let points = json["points"].as_u64().unwrap_or(0);
        self.points = (self.points * frames + points) / (frames + 1);
        self.rms_mm.push(json["rms_mm"].as_f64().unwrap_or(f64::NAN));
        self.median_mm.push(json["median_mm"].as_f64().unwrap_or(f64::NAN));
        Ok(())
    }
}

/// The scene as a source of the in-process simulator.
fn scene_uri(scale: u32) -> String {
    format!("sim:{SCENE}?scale={scale}")
}

impl Bench {
    /// The same scene captured on this machine, without USB: computed once.
    ///
    /// # Errors
    /// When that fails.
    pub fn in_process_score(&mut self) -> Result<Score, String> {
        if let Some(score) = self.in_process.get(&self.scale) {
            return Ok(score.clone());
        }
        let out = self.folder.join("in-process");
        let scene = scene_uri(self.scale);
        let frames = (FRAMES_IN_PROCESS - 1) * CYCLE + 1;
        let status = Command::new(built("stspp"))
            .args(["capture", "--quiet", "--force", "--method", METHOD, "--source", &scene])
            .args(["-n", &frames.to_string(), "--out"])
            .arg(&out)
            .stdout(Stdio::null())
            .status();
        if !status.is_ok_and(|s| s.success()) {
            return Err("the capture in process failed".into());
        }
        let mut score = Score::default();
        for frame in (0..frames).step_by(CYCLE) {
            score.add(&out.join(format!("{frame:04}/cloud.ply")), &scene)?;
        }
        self.in_process.insert(self.scale, score.clone());
        Ok(score)
    }

    /// Compares clouds that came out of the guest with the truth, and with how well that is met without USB.
    ///
    /// # Errors
    /// When the RMS differs by more than 5 %, or points are missing.
    pub fn compare(&mut self, clouds: &[PathBuf]) -> Result<String, String> {
        let mut guest = Score::default();
        for cloud in clouds {
            guest.add(cloud, &scene_uri(self.scale))?;
        }
        let host = self.in_process_score()?;
        let [rms, median] = [[&guest.rms_mm, &host.rms_mm], [&guest.median_mm, &host.median_mm]]
            .map(|both| both.map(|values| mean(values)));
        // One frame's RMS hangs on some dozen points at depth steps, and varies by a tenth: its median is
        // compared instead.
        let [guest_mm, host_mm] = if guest.rms_mm.len() > 1 { rms } else { median };
        let ratio = guest_mm / host_mm;
        let told = format!(
            "RMS {:.4} mm (of {}, each +-{:.4}), in-process {:.4} (of {}, +-{:.4}); median {:.4} and {:.4}: \
             {:+.1} %; {} and {} points",
            rms[0],
            guest.rms_mm.len(),
            guest.deviation_mm(),
            rms[1],
            host.rms_mm.len(),
            host.deviation_mm(),
            median[0],
            median[1],
            100.0 * (ratio - 1.0),
            guest.points,
            host.points,
        );
        let alike = (0.95..=1.05).contains(&ratio) && guest.points * 100 >= host.points * 97;
        if alike { Ok(told) } else { Err(told) }
    }
}
