//! `stspp bench calibration`: calibrations whose truth is known.

use std::fmt::Write as _;

use serde_json::json;
use stspp::calibrate::Board;
use stspp::calibrate::trials::{self, PoorSet, Rendered, SIGMA_PX, TrialError, Trials};

use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Largest mean depth error at 1 m and at 2 m, in mm.
const BIAS_MAX_MM: [(f64, f64); 2] = [(1.0, 0.1), (2.0, 0.4)];
/// Largest reprojection RMS in px.
const RMS_MAX_PX: f64 = 0.1;
/// Least share of errors within the stated standard deviation.
const COVERED_MIN: f64 = 0.6;

/// Calibrate simulated rigs and compare with the truth: rendered images, seeded trials on drawn
/// points, and image sets that are poor on purpose.
///
/// Ends with code 6 when a limit is missed: depth bias 0.1 mm at 1 m and 0.4 mm at 2 m, reprojection
/// RMS 0.1 px, 60 % of errors within one stated standard deviation, a warning for each poor set.
#[derive(clap::Args)]
pub struct Args {
    /// The board.
    #[arg(long, default_value_t)]
    board: Board,
    /// Rendered calibrations, each another rig; 0 for none.
    #[arg(long, default_value_t = 1)]
    rendered: u64,
    /// Image pairs of a rendered calibration.
    #[arg(long, default_value_t = 25)]
    images: usize,
    /// Seeded trials on drawn points; 0 for none.
    #[arg(long, default_value_t = 50)]
    trials: usize,
    /// Leave the poor sets out.
    #[arg(long)]
    no_poor_sets: bool,
}

fn failed(error: &TrialError) -> Failure {
    Failure::new(Kind::Other, error)
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let mut text = String::new();
    let mut missed = Vec::new();
    let mut rendered = Vec::new();
    for seed in 1..=args.rendered {
        let progress = output.progress(args.images as u64, "rendering");
        let one = trials::rendered(&args.board, args.images, seed, &mut || progress.inc(1))
            .map_err(|e| failed(&e))?;
        progress.finish_and_clear();
        of_rendered(&one, seed, &mut text, &mut missed);
        rendered.push(one);
    }
    let mut drawn = None;
    if args.trials > 0 {
        let progress = output.progress(args.trials as u64, "trials");
        let result = trials::trials(&args.board, args.trials, SIGMA_PX, &mut || progress.inc(1))
            .map_err(|error| failed(&error.into()))?;
        progress.finish_and_clear();
        of_trials(&result, &mut text, &mut missed);
        drawn = Some(result);
    }
    let mut poor = Vec::new();
    if !args.no_poor_sets {
        let spinner = output.spinner();
        spinner.set_message("poor sets");
        poor = trials::poor_sets(&args.board, &mut || {}).map_err(|e| failed(&e))?;
        spinner.finish_and_clear();
        of_poor(&poor, &mut text, &mut missed);
    }
    let json =
        json!({ "rendered": rendered, "trials": drawn, "poor_sets": poor, "missed": missed });
    output.result(&text, &json);
    if missed.is_empty() {
        return Ok(());
    }
    Err(Failure::new(Kind::Limit, missed.join("; ")))
}

fn of_rendered(one: &Rendered, seed: u64, text: &mut String, missed: &mut Vec<String>) {
    let report = &one.report;
    let _ = writeln!(
        text,
        "rig {seed}, rendered: {} of {} points found, {:.4} / {:.4} px off the truth (rms, left / \
         right)",
        one.points[0], one.points[1], one.detection_rms_px[0], one.detection_rms_px[1]
    );
    let _ = writeln!(
        text,
        "  reprojection RMS {:.4} / {:.4} px, epipolar RMS {:.4} px",
        report.rms_px[0], report.rms_px[1], report.epipolar_rms_px
    );
    for depth in &one.depth {
        let sigma = report.depth_sigma_mm.iter().find(|(d, _)| *d == depth.depth_m);
        let _ = writeln!(
            text,
            "  depth at {:.1} m: bias {:+.4} mm, rms {:.4} mm, worst {:.4} mm; stated 1 sigma {:.4} mm",
            depth.depth_m,
            depth.bias_mm,
            depth.rms_mm,
            depth.worst_mm,
            sigma.map_or(f64::NAN, |(_, s)| *s),
        );
        let limit = BIAS_MAX_MM.iter().find(|(d, _)| *d == depth.depth_m);
        if let Some((_, limit)) = limit.filter(|(_, limit)| depth.bias_mm.abs() > *limit) {
            missed.push(format!(
                "rig {seed}: depth bias {:.3} mm at {} m, limit {limit} mm",
                depth.bias_mm, depth.depth_m
            ));
        }
    }
    let worst = report.rms_px.into_iter().fold(0.0, f64::max);
    if worst > RMS_MAX_PX {
        missed.push(format!("rig {seed}: reprojection RMS {worst:.3} px, limit {RMS_MAX_PX} px"));
    }
    for finding in &report.findings {
        let _ = writeln!(text, "  warning: {}", finding.text);
    }
    for sentence in &report.missing {
        let _ = writeln!(text, "  not covered: {sentence}");
    }
}

fn of_trials(result: &Trials, text: &mut String, missed: &mut Vec<String>) {
    let _ = writeln!(
        text,
        "{} trials, points off by {SIGMA_PX} px: {:.0} % of all parameters within 1 sigma (least {:.0} \
         %), reprojection RMS at most {:.4} px",
        result.trials,
        100.0 * result.covered,
        100.0 * result.covered_least,
        result.rms_worst_px
    );
    for (k, (depth_m, share)) in result.depth_covered.iter().enumerate() {
        let _ = writeln!(
            text,
            "  depth at {depth_m:.1} m: {:.0} % within 1 sigma on the axis; bias over the field {:.4} mm \
             (rms over trials), worst {:.4} mm",
            100.0 * share,
            result.depth_bias_mm[k].1,
            result.depth_bias_worst_mm[k].1
        );
        if *share < COVERED_MIN {
            missed.push(format!("depth at {depth_m} m: {:.0} % covered", 100.0 * share));
        }
    }
    if result.covered < COVERED_MIN {
        missed.push(format!("{:.0} % of errors within 1 sigma", 100.0 * result.covered));
    }
}

fn of_poor(sets: &[PoorSet], text: &mut String, missed: &mut Vec<String>) {
    let found = sets.iter().filter(|set| set.is_found()).count();
    let _ = writeln!(text, "poor sets: {found} of {} get their warning", sets.len());
    for set in sets {
        let mark = if set.is_found() { "ok" } else { "MISSED" };
        let _ = writeln!(text, "  {mark:<6} {} ({:?})", set.name, set.expected);
        for finding in &set.findings {
            let _ = writeln!(text, "           {:?}: {}", finding.kind, finding.text);
        }
        if let Some(error) = &set.error {
            let _ = writeln!(text, "           error: {error}");
        }
        if !set.is_found() {
            missed.push(format!("no warning of {:?} for: {}", set.expected, set.name));
        }
    }
}
