//! `stspp measure compare`: a cloud against a mesh or another cloud.

use std::path::PathBuf;

use nalgebra::{Isometry3, Point3};
use serde_json::json;
use stspp::export::{folder::OutputFolder, ply};
use stspp::image_io;
use stspp::measure::deviation::{deviations, picture};
use stspp::measure::mesh_file::Reference;
use stspp::measure::units;
use stspp::register::icp::{IcpParams, register};
use stspp::register::mesh_surface::MeshSurface;
use stspp::register::surface::{CloudSurface, Surface};
use stspp::register::{RegisterError, global};

use super::input::{Input, reference};
use super::judge;
use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;
use crate::reconstruct::output_failure;

/// Compare a cloud with a mesh (.ply, .stl, .obj) or another cloud, aligned by point-to-plane ICP.
///
/// Written with --out: deviation.png as the left camera sees it (blue: behind the reference, red: before
/// it), deviation.ply in colours, report.json.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    input: Input,
    /// The reference.
    #[arg(long, value_name = "FILE")]
    to: PathBuf,
    /// Metres per unit of the reference: 0.001 for millimetres.
    #[arg(long, default_value_t = 1.0)]
    to_scale: f64,
    /// How the cloud is laid on the reference first.
    #[arg(long, value_enum, default_value_t)]
    align: Align,
    /// Points farther from the reference than this do not count, millimetres.
    #[arg(long, default_value_t = 5.0, value_name = "MM")]
    max_mm: f64,
    /// Full colour of the pictures, millimetres [default: twice the 95th percentile].
    #[arg(long, value_name = "MM")]
    full_mm: Option<f64>,
    /// Folder for the pictures.
    #[arg(long, short)]
    out: Option<PathBuf>,
    /// Replace outputs that are there.
    #[arg(long)]
    force: bool,
    /// Exit with code 6 when the RMS is larger.
    #[arg(long, value_name = "MM")]
    limit_mm: Option<f64>,
}

/// Names of ways to align.
#[derive(clap::ValueEnum, Clone, Copy, Default, PartialEq)]
enum Align {
    /// Both are in the same frame already.
    None,
    /// Nearly the same frame: ICP from where they are.
    #[default]
    Icp,
    /// Any frames: global registration, then ICP.
    Global,
}

/// The failure that a registration's error is.
pub fn register_failure(error: &RegisterError) -> Failure {
    let failure = Failure::new(Kind::Input, error);
    match error {
        RegisterError::NoOverlap { .. } => {
            failure.remedy("are both in metres and in the same frame? see --align, --scale")
        }
        _ => failure,
    }
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let mut out = match &args.out {
        Some(path) => Some(OutputFolder::create(path, args.force).map_err(|e| output_failure(&e))?),
        None => None,
    };
    if !(args.max_mm.is_finite() && args.max_mm > 0.0) {
        let what = format!("--max-mm {}: expected a distance above 0", args.max_mm);
        return Err(Failure::new(Kind::Usage, what));
    }
    let region = args.input.region()?;
    let read = reference(&args.to, args.to_scale, "--to-scale")?;
    let points = args.input.load(output)?.points(region.as_ref())?;
    units::check("the cloud", &points, "--scale").map_err(|e| Failure::new(Kind::Input, e))?;
    let progress = output.spinner();
    progress.set_message("building the search tree");
    let failed = |e: RegisterError| register_failure(&e);
    let (surface, samples): (Box<dyn Surface>, Vec<Point3<f64>>) = match read {
        Reference::Mesh(triangles) => {
            let samples = global::samples_of_mesh(&triangles);
            (Box::new(MeshSurface::new(triangles).map_err(failed)?), samples)
        }
        Reference::Cloud(cloud) => (Box::new(CloudSurface::new(&cloud).map_err(failed)?), cloud),
    };
    progress.set_message("aligning");
    let params = IcpParams::default();
    let aligned = match args.align {
        Align::None => None,
        Align::Icp => Some(register(&points, &*surface, Isometry3::identity(), &params)),
        Align::Global => {
            let start = global::register(&points, &samples, &global::GlobalParams::default())
                .map_err(failed)?;
            Some(register(&points, &*surface, start.target_from_source, &params))
        }
    };
    let aligned = aligned.transpose().map_err(failed)?;
    interrupt::check()?;
    let pose = aligned.as_ref().map_or(Isometry3::identity(), |a| a.target_from_source);
    progress.set_message("comparing");
    let found = deviations(&points, &*surface, &pose, args.max_mm * 1e-3);
    let Some(summary) = found.summary(&points) else {
        let what = format!("no point is within {} mm of {}", args.max_mm, args.to.display());
        let remedy = "are both in metres and in the same frame? see --align, --to-scale, --max-mm";
        return Err(Failure::new(Kind::Input, what).remedy(remedy));
    };
    let full_mm = args.full_mm.filter(|mm| *mm > 0.0).unwrap_or((2.0 * summary.p95_mm).max(0.01));
    let json = json!({
        "deviation": summary, "full_colour_mm": full_mm, "max_mm": args.max_mm,
        "reference_from_cloud": pose.to_homogeneous().transpose().as_slice(),
        "icp": aligned.as_ref().map(|a| json!({
            "rms_mm": a.rms_m * 1e3, "overlap": a.overlap, "settled": a.settled,
        })),
    });
    if let Some(out) = &mut out {
        let colours = found.colours(full_mm);
        let legend = format!(
            "Deviation: blue -{full_mm:.4} mm (behind the reference), white 0, red +{full_mm:.4} mm"
        );
        let texts = [("Description", legend.as_str())];
        out.file("deviation.png", |w| image_io::write_rgb8(w, &picture(&points, &colours), &texts))
            .map_err(|e| output_failure(&e))?;
        out.file("deviation.ply", |w| ply::write_coloured(w, &points, &found.signed_m, &colours))
            .map_err(|e| output_failure(&e))?;
        out.file("report.json", |w| writeln!(w, "{json:#}")).map_err(|e| output_failure(&e))?;
    }
    interrupt::check()?;
    if let Some(out) = out {
        out.commit().map_err(|e| output_failure(&e))?;
    }
    progress.finish_and_clear();
    let mut text = format!(
        "{} points, {:.2} % of them within {} mm of the reference\n\
         RMS {:.4} mm, median {:.4} mm, 95 % within {:.4} mm, mean {:+.4} mm\n",
        summary.points,
        100.0 * summary.matched,
        args.max_mm,
        summary.rms_mm,
        summary.median_mm,
        summary.p95_mm,
        summary.mean_mm,
    );
    if aligned.as_ref().is_some_and(|a| !a.settled) {
        text += "the alignment has not settled: start from a better pose, or try --align global\n";
    }
    if let Some(folder) = &args.out {
        text += &format!("look at {}", folder.join("deviation.png").display());
    }
    output.result(&text, &json);
    judge("the RMS", summary.rms_mm, args.limit_mm)
}
