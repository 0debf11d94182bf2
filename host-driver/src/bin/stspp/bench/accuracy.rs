//! `stspp bench accuracy`: the accuracy tables on the simulated sensor.

use serde_json::json;
use stspp::accuracy::tables::{self, AccuracyError, Case, Line, Setting};
use stspp_hil_sim::world::{SceneSpec, SensorModel};

use crate::exit::{Failure, Kind};
use crate::output::Output;
use crate::reconstruct::Matching;

/// Print accuracy against truth on the simulated sensor: sphere, planes, statue.
#[derive(clap::Args)]
pub struct Args {
    /// Scenes: sphere, planes, statue [default: all].
    scenes: Vec<String>,
    /// Numbers of frames for the sphere.
    #[arg(long, value_delimiter = ',', default_value = "1,3,5,7,10")]
    counts: Vec<usize>,
    /// Seed of the simulated sensor: other dots, tolerances and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    matching: Matching,
}

fn failure(error: &AccuracyError) -> Failure {
    Failure::new(Kind::Input, error)
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let known = ["sphere", "planes", "statue"];
    if let Some(other) = args.scenes.iter().find(|s| !known.contains(&s.as_str())) {
        return Err(Failure::new(
            Kind::Usage,
            format!("scene `{other}`: expected one of {known:?}"),
        ));
    }
    let wanted = |scene: &str| args.scenes.is_empty() || args.scenes.iter().any(|s| s == scene);
    let options = args.matching.options();
    let setting =
        Setting { method: options.method, shape: options.shape, threads: options.threads };
    let frames = args.matching.frames.unwrap_or(10);
    let spinner = output.spinner();
    let mut lines: Vec<Line> = Vec::new();
    let case = |scene: &str, options: &[(&str, &str)], frames: usize| {
        let spec = SceneSpec::parse(scene, options).map_err(AccuracyError::from)?;
        let model = SensorModel::with_seed(args.seed);
        Case::new(&spec, model, frames, &mut |k| {
            spinner.set_message(format!("{scene}: image {} of {frames}", k + 1));
        })
    };
    if wanted("sphere") {
        let most = args.counts.iter().copied().max().unwrap_or(frames);
        let case = case("sphere", &[], most).map_err(|e| failure(&e))?;
        for &count in &args.counts {
            spinner.set_message(format!("sphere: matching {count} frames"));
            lines.push(case.line("sphere", count, setting).map_err(|e| failure(&e))?);
        }
    }
    if wanted("planes") {
        for distance_m in ["1", "1.5", "2"] {
            let case =
                case("plane", &[("distance_m", distance_m)], frames).map_err(|e| failure(&e))?;
            spinner.set_message(format!("plane at {distance_m} m: matching"));
            let name = format!("plane {distance_m} m");
            lines.push(case.line(&name, frames, setting).map_err(|e| failure(&e))?);
        }
    }
    spinner.finish_and_clear();
    output.result(&tables::to_text(&lines), &json!({ "seed": args.seed, "lines": lines }));
    Ok(())
}
