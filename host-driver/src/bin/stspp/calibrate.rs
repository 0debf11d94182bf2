//! `stspp calibrate`: cameras and rig from images of a board.

mod board;
mod convert;
mod live;

use std::path::PathBuf;

use clap::{Subcommand, ValueEnum};
use serde_json::json;
use stspp::calibrate::bundle::Loss;
use stspp::calibrate::findings::{Finding, findings};
use stspp::calibrate::images::{self, Found};
use stspp::calibrate::report::Report;
use stspp::calibrate::{Board, date, solve};

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;

/// Calibrate the cameras and the rig from images of a board.
///
/// With FOLDER: from the PNG images of its left/ and right/, paired by name. Without: live from
/// --source under the floodlight; hold the board still at about 25 places, near and far, in the
/// corners of both images, tilted to all sides. A frame is taken when the board rests somewhere new.
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Args {
    #[command(subcommand)]
    what: Option<What>,
    /// Folder with left/ and right/.
    folder: Option<PathBuf>,
    /// The board: charuco:COLUMNSxROWS:MM or circles:COLUMNSxROWS:MM, counted in squares or discs.
    #[arg(long, default_value_t)]
    board: Board,
    /// Calibration file to write.
    #[arg(long, short, default_value = "camchain.yaml")]
    out: PathBuf,
    /// Write the whole report as JSON here.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Replace files that are there.
    #[arg(long)]
    force: bool,
    /// How far-off points count: huber, or cauchy where many are false.
    #[arg(long, value_enum, default_value_t)]
    loss: LossName,
    /// Baseline that the sensor was built with, in metres, to find out a wrong square size; 0 for
    /// unknown.
    #[arg(long, default_value_t = 0.4, value_name = "M")]
    baseline: f64,
    /// Temperature of the sensor in degrees Celsius, for the file [default: the sensor's own].
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    temperature: Option<f64>,
    #[command(flatten)]
    live: live::Args,
}

#[derive(Subcommand)]
enum What {
    Board(board::Args),
    Import(convert::ImportArgs),
    Export(convert::ExportArgs),
}

/// Names of [`Loss`].
#[derive(ValueEnum, Clone, Copy, Default)]
enum LossName {
    /// Squares near zero, linear beyond.
    #[default]
    Huber,
    /// Squares near zero, logarithmic beyond.
    Cauchy,
}

pub use convert::calibration_failure;

/// A file that is not to be replaced.
pub fn refuse_existing(path: &std::path::Path, force: bool) -> Result<(), Failure> {
    if path.exists() && !force {
        let what = format!("{}: exists already", path.display());
        return Err(Failure::new(Kind::Output, what).remedy("give another name, or --force"));
    }
    Ok(())
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    match &args.what {
        Some(What::Board(args)) => return board::run(args, output),
        Some(What::Import(args)) => return convert::import(args, output),
        Some(What::Export(args)) => return convert::export(args, output),
        None => {}
    }
    // Before the work, not after it.
    refuse_existing(&args.out, args.force)?;
    if let Some(report) = &args.report {
        refuse_existing(report, args.force)?;
    }
    let (found, temperature_c) = match &args.folder {
        Some(folder) => (of_folder(folder, args, output)?, None),
        None => live::collect(&args.live, &args.board, args.force, output)?,
    };
    interrupt::check()?;
    finish(args, &found, args.temperature.or(temperature_c), output)
}

fn of_folder(folder: &std::path::Path, args: &Args, output: &Output) -> Result<Found, Failure> {
    let failed = |error: images::FolderError| Failure::new(Kind::Input, error);
    let pairs = images::pairs(folder).map_err(failed)?;
    let progress = output.progress(pairs.len() as u64, "finding boards");
    let found = images::find_in_folder(&pairs, &args.board, &|| progress.inc(1));
    progress.finish_and_clear();
    found.map_err(failed)
}

/// Findings as the end of a one-line error.
fn listed(findings: &[Finding]) -> String {
    let texts: Vec<&str> = findings.iter().map(|finding| finding.text.as_str()).collect();
    texts.join("; ")
}

fn finish(
    args: &Args,
    found: &Found,
    temperature_c: Option<f64>,
    output: &Output,
) -> Result<(), Failure> {
    let loss = match args.loss {
        LossName::Huber => Loss::Huber,
        LossName::Cauchy => Loss::Cauchy,
    };
    let baseline_m = (args.baseline > 0.0).then_some(args.baseline);
    let observations = &found.observations;
    let solution = solve(observations, loss).map_err(|error| {
        let findings = findings(observations, &found.images, None, baseline_m);
        let failure = Failure::new(Kind::Input, error);
        if findings.is_empty() {
            failure.remedy("take more images; nothing was written")
        } else {
            failure.remedy(format!("{}; nothing was written", listed(&findings)))
        }
    })?;
    let report = Report::new(observations, &found.images, &solution, baseline_m);
    let mut calibration = solution.calibration();
    calibration.temperature_c = temperature_c;
    calibration.date = Some(date::now());
    let written = |error: std::io::Error, path: &std::path::Path| {
        let what = format!("{}: cannot be written: {error}", path.display());
        Failure::new(Kind::Output, what).remedy("nothing was left behind")
    };
    let json = json!({
        "calibration_file": args.out,
        "date": calibration.date,
        "temperature_c": calibration.temperature_c,
        "report": report,
    });
    calibration
        .write(&args.out)
        .map_err(|error| Failure::new(Kind::Output, error).remedy("nothing was left behind"))?;
    if let Some(path) = &args.report {
        let text = format!("{json:#}\n");
        stspp::export::atomic::write_file(path, |out| out.write_all(text.as_bytes()))
            .map_err(|error| written(error, path))?;
    }
    let text = format!("{}\nwritten: {}", report.to_text(), args.out.display());
    output.result(&text, &json);
    Ok(())
}
