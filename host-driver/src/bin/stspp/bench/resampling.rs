//! `stspp bench resampling`: the rectification's kernels and depths by what they cost in accuracy.

use std::fmt::Write as _;

use serde_json::json;
use stspp::accuracy::resampling::{self, Resampled};

use crate::exit::{Failure, Kind};
use crate::output::Output;
use crate::reconstruct::Matching;

/// Rectify simulated planes by every kernel, with samples of 14 and of 8 bits, and fit the planes.
#[derive(clap::Args)]
pub struct Args {
    /// Distances of the planes in metres.
    #[arg(default_values_t = [1.0, 1.5, 2.0])]
    distances_m: Vec<f64>,
    /// Seed of the simulated sensor.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    matching: Matching,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let options = args.matching.options();
    let frames = args.matching.frames.unwrap_or(10);
    let spinner = output.spinner();
    let mut lines: Vec<Resampled> = Vec::new();
    for &distance_m in &args.distances_m {
        let mut progress = |what: String| spinner.set_message(what);
        let found = resampling::plane(distance_m, args.seed, frames, &options, &mut progress)
            .map_err(|error| Failure::new(Kind::Input, error))?;
        lines.extend(found);
    }
    spinner.finish_and_clear();
    let mut text = format!(
        "{:<12} {:>4} {:>10} {:>10} {:>10}\n{:<12} {:>4} {:>10} {:>10} {:>10}\n",
        "kernel", "bits", "plane", "fit RMS", "bias", "", "", "m", "mm", "mm",
    );
    for line in &lines {
        let Resampled { kernel, bits, distance_m, fit_rms_mm, bias_mm } = line;
        let _ = writeln!(
            text,
            "{kernel:<12} {bits:>4} {distance_m:>10} {fit_rms_mm:>10.4} {bias_mm:>+10.4}"
        );
    }
    output.result(&text, &json!({ "seed": args.seed, "frames": frames, "lines": lines }));
    Ok(())
}
