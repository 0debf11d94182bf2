//! `stspp reconstruct`: depth from a recording folder.

use std::path::PathBuf;

use clap::ValueEnum;
use stspp::export::{folder::OutputError, folder::OutputFolder, outputs};
use stspp::reconstruct::{Options, ReconstructError};
use stspp::rectify::{Canvas, DepthRange, RectifyError};
use stspp::{Recording, reconstruct, report};
use stspp_matcher::{Method, ShapeFunction};

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;

/// Compute depth image and point cloud of a recording folder.
///
/// The folder holds camchain.yaml (Kalibr), left/00.png ... and right/00.png ... (raw grey images of 8
/// or 16 bits) and, if there is one, frames.json. Written are cloud.ply, disparity.tiff, depth.png,
/// depth_color.png, zncc.png and report.json: all of them or, after an error, none.
#[derive(clap::Args)]
pub struct Args {
    /// Recording folder.
    folder: PathBuf,
    /// Folder to write to; made if missing.
    #[arg(long, short)]
    out: PathBuf,
    /// Replace outputs that are there.
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    matching: Matching,
    /// First pair to use.
    #[arg(long, default_value_t = 0)]
    first: usize,
    /// Also write the speed along depth: depth_rate.tiff (m/s), and depth_rate of each point. Method
    /// dense, and a frames.json with times.
    #[arg(long)]
    depth_rate: bool,
}

/// How frames are matched; shared by the verbs that match.
#[derive(clap::Args, Clone)]
pub struct Matching {
    /// Sub-pixel method.
    #[arg(long, value_enum, default_value_t)]
    pub method: MethodName,
    /// Order of the subset's shape function.
    #[arg(long, value_enum, default_value_t)]
    pub order: OrderName,
    /// Side of the square subset in pixels, odd, 5 to 17 (icgn: 15): larger ones have less noise and less
    /// detail.
    #[arg(long, default_value_t = 9, value_name = "PX", value_parser = subset_px)]
    pub subset: usize,
    /// Least ZNCC of a point, -1 to 1: a higher one leaves fewer wrong points, and fewer right ones.
    #[arg(long, default_value_t = 0.8, value_name = "ZNCC", allow_negative_numbers = true)]
    pub zncc_min: f32,
    /// Frames to match, 1 to 16 [default: the recording's slots].
    #[arg(long)]
    pub frames: Option<usize>,
    /// Nearest depth in metres.
    #[arg(long, default_value_t = 0.8, value_name = "M")]
    pub depth_min: f64,
    /// Farthest depth in metres.
    #[arg(long, default_value_t = 2.0, value_name = "M")]
    pub depth_max: f64,
    /// Size of the rectified images.
    #[arg(long, value_enum, default_value_t)]
    pub canvas: CanvasName,
    /// Threads to use [default: all cores].
    #[arg(long)]
    pub threads: Option<usize>,
    /// With `--method dense`: leave depth steps where the coarse search puts them, a pixel or two beyond
    /// silhouettes, instead of letting the pixels' own grey values decide. Saves a few milliseconds.
    #[arg(long)]
    pub keep_steps: bool,
}

/// The side of a subset.
fn subset_px(text: &str) -> Result<usize, String> {
    let px = text.parse().ok().filter(|px| (5..=17).contains(px) && px % 2 == 1);
    px.ok_or_else(|| "an odd number from 5 to 17 is needed".into())
}

/// Names of [`Method`].
#[derive(ValueEnum, Clone, Copy, Default)]
pub enum MethodName {
    /// Parabola through the census costs, no refinement.
    Parabola,
    /// Per-point Gauss-Newton, as the paper does.
    Icgn,
    /// Dense least squares with shared warps: the same estimate in real time.
    #[default]
    Dense,
}

/// Names of [`ShapeFunction`].
#[derive(ValueEnum, Clone, Copy, Default)]
pub enum OrderName {
    /// First order: least noise on flat surfaces.
    #[value(name = "1")]
    First,
    /// Second order: follows curvature.
    #[value(name = "2")]
    Second,
    /// The order that fits each pixel.
    #[default]
    Auto,
}

/// Names of [`Canvas`].
#[derive(ValueEnum, Clone, Copy, Default)]
pub enum CanvasName {
    /// All that both cameras see within the depth range.
    #[default]
    Whole,
    /// The cameras' own size: loses a margin of some pixels, and saves that much time.
    Sensor,
}

impl CanvasName {
    /// The library's size.
    pub fn canvas(self) -> Canvas {
        match self {
            Self::Whole => Canvas::Whole,
            Self::Sensor => Canvas::Sensor,
        }
    }
}

impl MethodName {
    /// The library's method.
    pub fn method(self) -> Method {
        match self {
            Self::Parabola => Method::Parabola,
            Self::Icgn => Method::IcGn,
            Self::Dense => Method::Dense,
        }
    }
}

impl OrderName {
    /// The library's order.
    pub fn shape(self) -> ShapeFunction {
        match self {
            Self::First => ShapeFunction::First,
            Self::Second => ShapeFunction::Second,
            Self::Auto => ShapeFunction::Auto,
        }
    }
}

impl Matching {
    /// The library's options.
    pub fn options(&self) -> Options {
        Options {
            depth: DepthRange { min_m: self.depth_min, max_m: self.depth_max },
            canvas: self.canvas.canvas(),
            method: self.method.method(),
            shape: self.order.shape(),
            subset_radius: self.subset / 2,
            zncc_min: self.zncc_min,
            frames: self.frames,
            first: 0,
            threads: self.threads,
            keep_steps: self.keep_steps,
        }
    }
}

/// An output failure with its remedy.
pub fn output_failure(error: &OutputError) -> Failure {
    let remedy = match error {
        OutputError::Exists { .. } => "give another --out, or --force to replace it",
        _ => "check the path, its permissions and the free space; nothing was left behind",
    };
    Failure::new(Kind::Output, error).remedy(remedy)
}

/// A reconstruction failure with its remedy.
pub fn reconstruct_failure(error: &ReconstructError) -> Failure {
    let remedy = match error {
        ReconstructError::Rectify(RectifyError::DepthRange { .. }) => {
            "see --depth-min, --depth-max"
        }
        ReconstructError::Rectify(_) => "check camchain.yaml and the depth range",
        ReconstructError::Match(_) => {
            "see --method, --subset (with icgn up to 15), --zncc-min, --threads"
        }
        ReconstructError::Window { .. } => "see --frames and --first",
        _ => {
            "a recording is camchain.yaml, left/00.png ..., right/00.png ... of equal number and size"
        }
    };
    Failure::new(Kind::Input, error).remedy(remedy)
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let recording = Recording::open(&args.folder)
        .map_err(|e| reconstruct_failure(&ReconstructError::Recording(e)))?;
    let mut out = OutputFolder::create(&args.out, args.force).map_err(|e| output_failure(&e))?;
    let progress = output.spinner();
    let options = Options { first: args.first, ..args.matching.options() };
    let result =
        reconstruct::reconstruct(&recording, &options, &mut |what| progress.set_message(what))
            .map_err(|e| reconstruct_failure(&e))?;
    interrupt::check()?;
    let source = args.folder.display().to_string();
    let report = report::of_reconstruction(&source, &result);
    let extras = outputs::Extras { depth_rate: args.depth_rate };
    outputs::write(&mut out, &result.frame, &report, extras, &mut |file| {
        progress.set_message(file)
    })
    .map_err(|e| output_failure(&e))?;
    interrupt::check()?;
    out.commit().map_err(|e| output_failure(&e))?;
    progress.finish_and_clear();
    let summary = report::Summary::of(&result.frame, result.seen_pixels);
    let total_ms: f64 = result.steps.iter().map(|step| step.wall_ms).sum();
    let text = format!(
        "{} points ({:.1} % of what the left camera saw) from {} pairs in {:.2} s\n\
         depth {} m (median), ZNCC {} (median)\n\
         look at {}",
        summary.points,
        100.0 * summary.completeness,
        result.pairs.len(),
        total_ms / 1e3,
        summary.depth_median_m.map_or("none".into(), |z| format!("{z:.4}")),
        summary.zncc_median.map_or("none".into(), |v| format!("{v:.4}")),
        args.out.join("depth_color.png").display(),
    );
    output.result(&text, &report);
    Ok(())
}
