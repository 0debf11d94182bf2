//! `stspp bench check`: turns of a camera, injected and found.

use std::fmt::Write as _;

use serde_json::json;
use stspp::check::Options;
use stspp::check::drift::Axes;
use stspp::check::trials::{self, Trial};
use stspp_hil_sim::world::{SceneSpec, SensorModel};

use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Largest error of a corrected turn, in degrees.
const ERROR_MAX_DEG: f64 = 0.005;

/// Turn the simulated sensor's right camera after calibration, and see what `stspp check` finds.
///
/// Ends with code 6 when a turn is found with an error of more than 0.005 degrees about any axis.
#[derive(clap::Args)]
pub struct Args {
    /// Scenes to look at.
    #[arg(default_value = "statue")]
    scenes: Vec<String>,
    /// Angle to turn by, in degrees; about each axis in turn.
    #[arg(long, default_value_t = 0.05, value_name = "DEG")]
    angle: f64,
    /// Frames of the recording.
    #[arg(long, default_value_t = 10)]
    frames: usize,
    /// Cameras with 1/SCALE of the pixels in each direction.
    #[arg(long, default_value_t = 1)]
    scale: usize,
    /// Seed of the simulated sensor.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    if !(1..=16).contains(&args.scale) {
        return Err(Failure::new(Kind::Usage, "--scale: expected 1 to 16"));
    }
    let model = SensorModel::with_seed(args.seed).scaled_down(args.scale);
    let angle = args.angle;
    let turns = [[0.0; 3], [angle, 0.0, 0.0], [0.0, angle, 0.0], [0.0, 0.0, angle], [-angle; 3]];
    let progress = output.progress((turns.len() * args.scenes.len()) as u64, "checking");
    let mut text = String::new();
    let mut trials: Vec<(String, Trial)> = Vec::new();
    let mut missed = Vec::new();
    for scene in &args.scenes {
        let spec =
            SceneSpec::parse(scene, &[]).map_err(|error| Failure::new(Kind::Input, error))?;
        for turn in turns {
            let trial = trials::injected(
                &spec,
                &model,
                turn,
                args.frames,
                &Options::default(),
                Axes::default(),
            )
            .map_err(|error| Failure::new(Kind::Other, error))?;
            progress.inc(1);
            line(scene, &trial, &mut text);
            let worst = trial.error_deg.iter().fold(0.0, |worst: f64, e| e.abs().max(worst));
            if worst > ERROR_MAX_DEG {
                missed.push(format!("{scene}, turned by {turn:?}: off by {worst:.4} degrees"));
            }
            trials.push((scene.clone(), trial));
        }
    }
    progress.finish_and_clear();
    let trials: Vec<_> =
        trials.iter().map(|(scene, trial)| json!({ "scene": scene, "trial": trial })).collect();
    output.result(&text, &json!({ "trials": trials, "missed": missed }));
    if missed.is_empty() {
        return Ok(());
    }
    Err(Failure::new(Kind::Limit, missed.join("; ")))
}

fn line(scene: &str, trial: &Trial, text: &mut String) {
    let Trial { turned_deg, error_deg, report } = trial;
    let degrees = |v: &[f64; 3]| format!("{:+.4} {:+.4} {:+.4}", v[0], v[1], v[2]);
    let _ = writeln!(
        text,
        "{scene}, turned by {} (pitch yaw roll, degrees)\n  found {}, error {}, stated 1 sigma {}\n  \
         epipolar RMS {:.3} px -> {:.3} px; depth {:+.3} mm mean, {:.3} mm rms; ZNCC {:.3} on the row, \
         {:.3} with v; windows {:?}\n  {}",
        degrees(turned_deg),
        degrees(&report.drift.angles_deg),
        degrees(error_deg),
        degrees(&report.drift.sigmas_deg),
        report.before.rms_px,
        report.after.rms_px,
        report.depth.mean_mm,
        report.depth.rms_mm,
        report.zncc_on_row,
        report.zncc,
        report.windows,
        report.verdict_text(),
    );
}
