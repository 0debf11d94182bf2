//! `stspp check`: health of a calibration from a speckle recording.

use std::path::PathBuf;

use clap::ValueEnum;
use serde_json::json;
use stspp::check::drift::Axes;
use stspp::check::report::Report;
use stspp::check::{self, Options};
use stspp::rectify::DepthRange;
use stspp::{Recording, StereoCalibration, reconstruct};

use crate::calibrate::{calibration_failure, refuse_existing};
use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;
use crate::reconstruct::reconstruct_failure;

/// Check a calibration by an ordinary speckle recording: how far corresponding points are from their
/// common row, what that costs, and which turn of a camera would explain it.
///
/// Any surface that fills most of the field will do. --correct writes a calibration with the right
/// camera turned; it mends small drifts (0.01 to 0.1 degrees), not a lens that was touched.
#[derive(clap::Args)]
pub struct Args {
    /// Recording folder.
    folder: PathBuf,
    /// Calibration to check [default: the recording's own].
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Write the corrected calibration here.
    #[arg(long, value_name = "OUT.yaml")]
    correct: Option<PathBuf>,
    /// Replace the file if it is there.
    #[arg(long)]
    force: bool,
    /// Axes about which a turn is looked for.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "pitch,yaw,roll")]
    axes: Vec<Axis>,
    /// Nearest depth in metres.
    #[arg(long, default_value_t = 0.8, value_name = "M")]
    depth_min: f64,
    /// Farthest depth in metres.
    #[arg(long, default_value_t = 2.0, value_name = "M")]
    depth_max: f64,
    /// Frames to use [default: the recording's slots].
    #[arg(long)]
    frames: Option<usize>,
}

/// Axes of the right camera.
#[derive(ValueEnum, Clone, Copy, PartialEq)]
enum Axis {
    /// About x.
    Pitch,
    /// About y.
    Yaw,
    /// About z.
    Roll,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    if let Some(path) = &args.correct {
        refuse_existing(path, args.force)?;
    }
    let recording = Recording::open(&args.folder).map_err(|e| reconstruct_failure(&e.into()))?;
    let calibration = match &args.calibration {
        Some(path) => StereoCalibration::read(path).map_err(calibration_failure)?,
        None => recording.calibration.clone(),
    };
    let depth = DepthRange { min_m: args.depth_min, max_m: args.depth_max };
    let window = reconstruct::Options { depth, frames: args.frames, ..Default::default() };
    let spinner = output.spinner();
    spinner.set_message("reading");
    let (pairs, _) =
        reconstruct::read_window(&recording, &window).map_err(|e| reconstruct_failure(&e))?;
    let has = |axis: Axis| args.axes.contains(&axis);
    let axes = Axes { pitch: has(Axis::Pitch), yaw: has(Axis::Yaw), roll: has(Axis::Roll) };
    let options = Options { depth, ..Options::default() };
    let checked =
        check::check(&calibration, &pairs, &options, axes, &mut |what| spinner.set_message(what))
            .map_err(|error| Failure::new(Kind::Input, error))?;
    interrupt::check()?;
    let report = Report::new(&calibration, &checked);
    spinner.finish_and_clear();
    let mut text = report.to_text();
    let mut json =
        json!({ "recording": args.folder, "check": report, "verdict": report.verdict_text() });
    if let Some(path) = &args.correct {
        if !report.is_significant {
            let what = format!(
                "{}: the turn found is within its uncertainty, there is nothing to correct",
                path.display()
            );
            return Err(Failure::new(Kind::Input, what)
                .remedy("nothing was written; the calibration stands as it is"));
        }
        checked.corrected.write(path).map_err(calibration_failure)?;
        let change = change(&calibration, &checked.corrected);
        text += &format!(
            "written: {}\n  cam1.T_cn_cnm1 {}; all else as it was\n",
            path.display(),
            change["text"].as_str().unwrap_or_default()
        );
        json["corrected"] = json!({ "file": path, "change": change });
    }
    output.result(&text, &json);
    Ok(())
}

/// What is different in the file.
fn change(before: &StereoCalibration, after: &StereoCalibration) -> serde_json::Value {
    let turn = after.right_from_left.rotation * before.right_from_left.rotation.inverse();
    let turn_deg = turn.scaled_axis().map(f64::to_degrees);
    let moved_mm = (after.right_from_left.translation.vector
        - before.right_from_left.translation.vector)
        * 1e3;
    let text = format!(
        "turned by ({:+.5}, {:+.5}, {:+.5}) degrees, its translation moved by ({:+.4}, {:+.4}, \
         {:+.4}) mm, the baseline is still {:.4} mm",
        turn_deg.x,
        turn_deg.y,
        turn_deg.z,
        moved_mm.x,
        moved_mm.y,
        moved_mm.z,
        1e3 * after.baseline_m()
    );
    json!({
        "text": text,
        "turn_deg": turn_deg.as_slice(),
        "translation_mm": moved_mm.as_slice(),
        "before": before.right_from_left.to_homogeneous().transpose().as_slice(),
        "after": after.right_from_left.to_homogeneous().transpose().as_slice(),
    })
}
