//! `stspp fuse`: several views into one model.

use std::path::{Path, PathBuf};

use nalgebra::{Point3, Vector3};
use serde_json::json;
use stspp::export::{folder::OutputFolder, model};
use stspp::fuse::{self, FuseError, FuseParams, Start, View};
use stspp::measure::region::Region;
use stspp::measure::units;
use stspp::reconstruct::{self, ReconstructError};
use stspp::report::peak_memory_bytes;
use stspp::{PointCloud, Recording};

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::measure::input::cloud_of_result;
use crate::measure::numbers;
use crate::output::Output;
use crate::reconstruct::{Matching, output_failure, reconstruct_failure};

/// Fuse several views of a thing into one model: model.ply, model.e57, report.json.
///
/// INPUTS are recording folders or point clouds (.ply), each in its own sensor frame, in the order in
/// which they were taken. Neighbours must overlap by half or so; background that does not move with the
/// object must be cut away with --box.
#[derive(clap::Args)]
pub struct Args {
    /// Recordings or clouds, two or more.
    #[arg(required = true, num_args = 2..)]
    inputs: Vec<PathBuf>,
    /// Folder to write to; made if missing.
    #[arg(long, short)]
    out: PathBuf,
    /// Replace outputs that are there.
    #[arg(long)]
    force: bool,
    /// How the views are brought near each other.
    #[arg(long, value_enum, default_value_t)]
    start: StartName,
    /// Turntable: angle between views in degrees [default: 360 / number of views].
    #[arg(long, value_name = "DEG", allow_hyphen_values = true)]
    step_deg: Option<f64>,
    /// Turntable: a point on the axis and its direction in the first view's frame, x,y,z,dx,dy,dz; found
    /// from the first two views when not given.
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    axis: Option<String>,
    /// Use only what is in a box of each view's own frame: x0,y0,z0,x1,y1,z1 in metres.
    #[arg(long = "box", value_name = "CORNERS", allow_hyphen_values = true)]
    corners: Option<String>,
    /// Metres per unit of the clouds: 0.001 for millimetres.
    #[arg(long, default_value_t = 1.0)]
    scale: f64,
    /// Point spacing of the model, millimetres.
    #[arg(long, default_value_t = 0.5, value_name = "MM")]
    cell_mm: f64,
    /// Pairs of views with less overlap are not registered, a share.
    #[arg(long, default_value_t = 0.25, value_name = "SHARE")]
    overlap_min: f64,
    #[command(flatten)]
    matching: Matching,
}

/// Names of [`Start`].
#[derive(clap::ValueEnum, Clone, Copy, Default, PartialEq)]
enum StartName {
    /// Each view on the one before, from anywhere.
    #[default]
    Global,
    /// Each view on the first, which shows everything, from anywhere.
    Guide,
    /// The object turned by the same angle between views.
    Turntable,
    /// They are near each other as they are.
    Given,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let params = parameters(args)?;
    let mut out = OutputFolder::create(&args.out, args.force).map_err(|e| output_failure(&e))?;
    let progress = output.spinner();
    let mut views = Vec::new();
    let region = match &args.corners {
        Some(text) => Region::parse_box(text).map_err(|e| Failure::new(Kind::Usage, e))?,
        None => Region::All,
    };
    for path in &args.inputs {
        progress.set_message(format!("reading {}", path.display()));
        views.push(view(path, &region, args)?);
        interrupt::check()?;
    }
    let model = fuse::fuse(&views, &params, &mut |step| progress.set_message(step))
        .map_err(|e| fuse_failure(&e))?;
    drop(views);
    interrupt::check()?;
    let poses: Vec<Vec<f64>> = model
        .first_from_view
        .iter()
        .map(|pose| pose.to_homogeneous().transpose().as_slice().to_vec())
        .collect();
    let report = json!({
        "inputs": args.inputs, "points_in": model.points_in, "points": model.points.len(),
        "removed_cells": model.removed, "first_from_view": poses, "pairs": model.pairs,
        "loop_open_mm": model.loop_open_mm, "loop_closed_mm": model.loop_closed_mm,
        "peak_memory_bytes": peak_memory_bytes(), "versions": stspp::report::versions_json(),
    });
    progress.set_message("model.ply");
    out.file("model.ply", |w| model::write_ply(w, &model.points))
        .map_err(|e| output_failure(&e))?;
    progress.set_message("model.e57");
    out.file("model.e57", |w| model::write_e57(w, &model)).map_err(|e| output_failure(&e))?;
    out.file("report.json", |w| writeln!(w, "{report:#}")).map_err(|e| output_failure(&e))?;
    interrupt::check()?;
    out.commit().map_err(|e| output_failure(&e))?;
    progress.finish_and_clear();
    let mut text = format!(
        "{} views, {} points in, {} points of the model\n{} pairs registered; ",
        args.inputs.len(),
        model.points_in,
        model.points.len(),
        model.pairs.len(),
    );
    text += &match model.loop_open_mm {
        Some(open) => format!(
            "the chain of neighbours misses its start by {open:.4} mm; with the loop closed no pair is \
             off by more than {:.4} mm\n",
            model.loop_closed_mm
        ),
        None => format!("no pair is off by more than {:.4} mm\n", model.loop_closed_mm),
    };
    if let Some(bytes) = peak_memory_bytes() {
        text += &format!("peak memory {:.0} MiB\n", bytes as f64 / f64::from(1 << 20));
    }
    text += &format!("look at {}", args.out.join("model.ply").display());
    output.result(&text, &report);
    Ok(())
}

fn parameters(args: &Args) -> Result<FuseParams, Failure> {
    let usage = |what: &str| Err(Failure::new(Kind::Usage, what));
    let start = match args.start {
        StartName::Global => Start::Global,
        StartName::Guide => Start::Guide,
        StartName::Given => Start::Given,
        StartName::Turntable => {
            let step_deg = args.step_deg.unwrap_or(360.0 / args.inputs.len() as f64);
            let axis = match &args.axis {
                Some(text) => {
                    let v = numbers::<6>("--axis", text, "x,y,z,dx,dy,dz")?;
                    let direction = Vector3::new(v[3], v[4], v[5]);
                    if direction.norm() < 1e-6 {
                        return usage("--axis: expected a direction that is not 0");
                    }
                    Some((Point3::new(v[0], v[1], v[2]), direction))
                }
                None => None,
            };
            Start::Turntable { step_rad: step_deg.to_radians(), axis }
        }
    };
    if args.start != StartName::Turntable && (args.step_deg.is_some() || args.axis.is_some()) {
        return usage("--step-deg and --axis belong to --start turntable");
    }
    if !(1e-6..=1e6).contains(&args.scale) {
        return usage(&format!("--scale {}: expected metres per unit, such as 0.001", args.scale));
    }
    if !(0.01..=1.0).contains(&args.overlap_min) {
        return usage("--overlap-min: expected a share from 0.01 to 1");
    }
    let cell_m = args.cell_mm * 1e-3;
    let params = FuseParams::default();
    let icp_cell_m = params.icp_cell_m.max(cell_m);
    Ok(FuseParams { start, cell_m, icp_cell_m, overlap_min: args.overlap_min, ..params })
}

/// Reads a view: a cloud as it is, a recording reconstructed.
fn view(path: &Path, region: &Region, args: &Args) -> Result<View, Failure> {
    let input = |e: &dyn std::fmt::Display| Failure::new(Kind::Input, e);
    let path = &cloud_of_result(path);
    let name = path.display().to_string();
    let mut cloud = if path.is_dir() {
        let failed = |e: ReconstructError| reconstruct_failure(&e);
        let recording = Recording::open(path).map_err(|e| failed(e.into()))?;
        let found = reconstruct::reconstruct(&recording, &args.matching.options(), &mut |_| ())
            .map_err(failed)?;
        // Views of something that turns: at the middle of their windows they are most exact.
        found.frame.at_window_middle().point_cloud()
    } else {
        PointCloud::read_ply(path).map_err(|e| input(&format!("{name}: {e}")))?
    };
    let scale = args.scale as f32;
    let mut kept = PointCloud::default();
    for k in 0..cloud.len() {
        let p = if path.is_dir() { cloud.points_left_m[k] } else { cloud.points_left_m[k] * scale };
        if region.holds(&p.cast()) {
            kept.points_left_m.push(p);
            kept.zncc.push(cloud.zncc[k]);
            kept.intensity.push(cloud.intensity[k]);
        }
    }
    cloud = kept;
    let points: Vec<Point3<f64>> = cloud.points_left_m.iter().map(|p| p.cast()).collect();
    units::check(&name, &points, "--scale").map_err(|e| input(&e))?;
    View::new(name.clone(), &cloud).ok_or_else(|| {
        let finite = points.iter().filter(|p| p.coords.iter().all(|c| c.is_finite())).count();
        input(&format!("{name}: {finite} points are too few for a view, expected 100 or more"))
            .remedy("see --box, --depth-min, --depth-max")
    })
}

/// The failure that a fusion's error is.
fn fuse_failure(error: &FuseError) -> Failure {
    let failure = Failure::new(Kind::Input, error);
    match error {
        FuseError::Pair { .. } => {
            failure.remedy("do they overlap? see --start, --box, --overlap-min")
        }
        FuseError::View { .. } => failure.remedy("see --box, --depth-min, --depth-max"),
        _ => failure,
    }
}
