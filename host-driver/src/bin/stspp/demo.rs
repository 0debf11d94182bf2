//! `stspp demo`: from light to depth on the simulated sensor, compared with the truth.

use std::path::PathBuf;
use std::time::Instant;

use nalgebra::Point3;
use serde_json::{Value, json};
use stspp::DepthFrame;
use stspp::accuracy::{CanvasTruth, score};
use stspp::export::{folder::OutputFolder, outputs};
use stspp::measure::{plane, rms, sphere};
use stspp_hil_sim::world::{PrimitiveShape, World};

use crate::exit::{Failure, Kind};
use crate::output::Output;
use crate::reconstruct::Matching;
use crate::source::{Source, failure, output_failure, stream_options};
use crate::{frame_report, interrupt};

/// Pixels around a point that must show the same object: beyond the matching window, no step is felt.
const MARGIN_PX: usize = 6;

/// Fewest points of an object that are worth a fit.
const POINTS_MIN: usize = 100;

/// Take one depth frame of a simulated scene and compare it with the truth.
///
/// The simulated sensor projects its patterns one by one, the cameras expose, the driver pairs,
/// rectifies and matches, exactly as with hardware. Outputs are written to a folder.
#[derive(clap::Args)]
pub struct Args {
    /// Folder to write to; made if missing, outputs in it are replaced.
    #[arg(long, short, default_value = "stspp-out")]
    out: PathBuf,
    /// Scene of the simulated sensor: NAME or NAME?OPTION=VALUE&... (`stspp list --scenes`).
    #[arg(long, default_value = stspp::sim::options::DEFAULT_SCENE)]
    scene: String,
    /// Projection timing to use: a JSON file as `timing get --json` prints it.
    #[arg(long, value_name = "FILE")]
    timing: Option<PathBuf>,
    #[command(flatten)]
    matching: Matching,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let begun = Instant::now();
    // Found out before the work: whether the output can be written at all.
    let mut out = OutputFolder::create(&args.out, true).map_err(|e| output_failure(&e))?;
    let source = Source::new(format!("sim:{}", args.scene), args.timing.clone());
    let progress = output.spinner();
    progress.set_message("building the scene");
    let (mut sensor, world) = source.open_sim()?;
    let options = stream_options(None, Some(&args.matching));
    let mut stream = sensor.stream_with(&options).map_err(|e| failure(&e))?;
    interrupt::stops(stream.stop_handle());
    let frame = stream.next_observed(|stats| {
        progress.set_message(match stats.windows {
            0 => format!("projecting and exposing: {} pairs", stats.pairs),
            _ => "matching".into(),
        });
    });
    // The light goes off before anything else is done.
    stream.stop_handle().stop();
    interrupt::check()?;
    let Some(frame) = frame else {
        return Err(Failure::new(Kind::Other, "the stream ended without a depth frame"));
    };
    let frame = frame.map_err(|e| failure(&e))?;

    progress.set_message("comparing with the truth");
    // What moves is compared where it was at the depth's own time.
    let time_ns = (frame.time_device_s.unwrap_or(0.0) * 1e9) as u64;
    let matching = stream.matching().clone();
    let truth = CanvasTruth::trace(&world, &frame.geometry, &matching.left_mask, time_ns);
    let scored = score::score(&frame, &truth);
    let (lines, fits) = residuals(&frame, &truth, &world, time_ns);
    interrupt::check()?;

    let mut report = frame_report::of(&source.uri, &frame, &matching, &stream.stats());
    report["truth"] = json!({ "score": scored, "fits": fits });
    outputs::write(&mut out, &frame, &report, outputs::Extras::default(), &mut |file| {
        progress.set_message(file)
    })
    .map_err(|e| output_failure(&e))?;
    drop(stream);
    interrupt::check()?;
    out.commit().map_err(|e| output_failure(&e))?;
    progress.finish_and_clear();

    let mut text = format!(
        "{}: {} points from {} stereo pairs in {:.1} s\n\
         {:.2} % of what both cameras see is within 5 mm of the truth, {:.3} % of the points are \
         farther off; surface RMS {:.4} mm\n",
        source.uri,
        scored.points,
        frame.labels.len(),
        begun.elapsed().as_secs_f64(),
        100.0 * scored.completeness,
        100.0 * scored.outliers_visible,
        scored.surface_rms_mm,
    );
    lines.iter().for_each(|line| text += &format!("{line}\n"));
    text += &format!(
        "look at {} (near is red) and {} (MeshLab, CloudCompare)",
        args.out.join("depth_color.png").display(),
        args.out.join("cloud.ply").display(),
    );
    report["wall_s"] = json!(begun.elapsed().as_secs_f64());
    output.result(&text, &report);
    Ok(())
}

/// Fits of the scene's planes and spheres, for people and for programs.
fn residuals(
    frame: &DepthFrame,
    truth: &CanvasTruth,
    world: &World,
    time_ns: u64,
) -> (Vec<String>, Vec<Value>) {
    let (mut lines, mut fits) = (Vec::new(), Vec::new());
    for primitive in world.truth().primitives(time_ns) {
        let object = world.object_name(primitive.object);
        if !matches!(primitive.shape, PrimitiveShape::Plane { .. } | PrimitiveShape::Sphere { .. })
        {
            continue;
        }
        let points = score::object_points(frame, truth, world, object, MARGIN_PX, 90.0);
        if points.len() < POINTS_MIN {
            continue;
        }
        match primitive.shape {
            PrimitiveShape::Plane { point_left_m, normal_left } => {
                let Ok(fit) = plane::fit(&points) else { continue };
                let off_mm = |p: &Point3<f64>| (p.coords - point_left_m).dot(&normal_left) * 1e3;
                let truth_mm = rms(points.iter().map(off_mm));
                lines.push(format!(
                    "{object}: plane fit RMS {:.4} mm, distance from the true plane RMS {truth_mm:.4} mm \
                     ({} points)",
                    fit.rms_m * 1e3,
                    points.len(),
                ));
                fits.push(json!({
                    "object": object, "shape": "plane", "points": points.len(),
                    "fit_rms_mm": fit.rms_m * 1e3, "truth_rms_mm": truth_mm,
                }));
            }
            PrimitiveShape::Sphere { centre_left_m, radius_m } => {
                let Ok(fit) = sphere::fit(&points) else { continue };
                let off_mm = |p: &Point3<f64>| ((p.coords - centre_left_m).norm() - radius_m) * 1e3;
                let truth_mm = rms(points.iter().map(off_mm));
                let radius_error_mm = (fit.radius_m - radius_m) * 1e3;
                let centre_error_mm = (fit.centre_m.coords - centre_left_m).norm() * 1e3;
                lines.push(format!(
                    "{object}: sphere fit RMS {:.4} mm, radius off by {radius_error_mm:+.4} mm, centre \
                     by {centre_error_mm:.4} mm; distance from the true sphere RMS {truth_mm:.4} mm \
                     ({} points)",
                    fit.rms_m * 1e3,
                    points.len(),
                ));
                fits.push(json!({
                    "object": object, "shape": "sphere", "points": points.len(),
                    "fit_rms_mm": fit.rms_m * 1e3, "radius_error_mm": radius_error_mm,
                    "centre_error_mm": centre_error_mm, "truth_rms_mm": truth_mm,
                }));
            }
            _ => {}
        }
    }
    (lines, fits)
}
