//! `stspp bench compare`: the dense method against point-by-point IC-GN, at the same pixels.

use std::fmt::Write as _;

use serde_json::json;
use stspp::accuracy::compare::{self, Compared, ComparedCircle};
use stspp::accuracy::tables::{AccuracyError, Case};
use stspp::reconstruct::Options;
use stspp_hil_sim::world::{SceneSpec, SensorModel};
use stspp_matcher::{Method, ShapeFunction};

use crate::exit::{Failure, Kind};
use crate::output::Output;

/// The reference's RMS may be exceeded by this part.
const EXCESS_MAX: f64 = 0.03;

/// Scenes, and the distance of planes in metres.
const SCENES: [(&str, Option<&str>); 6] = [
    ("plane", Some("1")),
    ("plane", Some("1.5")),
    ("plane", Some("2")),
    ("sphere", None),
    ("part", None),
    ("statue", None),
];

/// Compare the dense method with IC-GN of second order and quintic B-splines on simulated scenes.
#[derive(clap::Args)]
pub struct Args {
    /// Frames to match.
    #[arg(long, default_value_t = 10)]
    frames: usize,
    /// Seed of the simulated sensor.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Threads to use [default: all cores].
    #[arg(long)]
    threads: Option<usize>,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let of = |method, shape| Options { method, shape, threads: args.threads, ..Options::default() };
    let dense = of(Method::Dense, ShapeFunction::Auto);
    let reference = of(Method::IcGn, ShapeFunction::Second);
    let spinner = output.spinner();
    let (mut lines, mut circles) = (Vec::new(), Vec::new());
    for (scene, distance_m) in SCENES {
        let name = distance_m.map_or(scene.to_owned(), |d| format!("{scene} {d} m"));
        let options: Vec<_> = distance_m.map(|d| ("distance_m", d)).into_iter().collect();
        let failure = |e: AccuracyError| Failure::new(Kind::Input, &e);
        let spec = SceneSpec::parse(scene, &options).map_err(|e| failure(e.into()))?;
        let model = SensorModel::with_seed(args.seed);
        let case = Case::new(&spec, model, args.frames, &dense, &mut |k| {
            spinner.set_message(format!("{name}: image {} of {}", k + 1, args.frames));
        })
        .map_err(failure)?;
        spinner.set_message(format!("{name}: matching"));
        let (compared, found) =
            compare::compare(&case, &name, args.frames, dense, reference).map_err(failure)?;
        lines.extend(compared);
        circles.extend(found);
    }
    spinner.finish_and_clear();
    let json =
        json!({ "seed": args.seed, "frames": args.frames, "lines": lines, "circles": circles });
    output.result(&(lines_text(&lines) + "\n" + &circles_text(&circles)), &json);
    Ok(())
}

fn lines_text(lines: &[Compared]) -> String {
    let mut text = format!(
        "{:<12} {:<22} {:>9} {:>9} {:>9} {:>8}  \n{:<12} {:<22} {:>9} {:>9} {:>9} {:>8}\n",
        "scene", "pixels of both", "count", "dense", "icgn", "excess", "", "", "", "mm", "mm", "%",
    );
    for line in lines {
        let verdict = if line.excess() <= EXCESS_MAX { "" } else { " over" };
        let _ = writeln!(
            text,
            "{:<12} {:<22} {:>9} {:>9.4} {:>9.4} {:>+8.1}{verdict}",
            line.scene,
            line.pixels,
            line.count,
            line.rms_mm,
            line.reference_rms_mm,
            100.0 * line.excess(),
        );
    }
    text
}

fn circles_text(circles: &[ComparedCircle]) -> String {
    let mut text = format!("{:<24} {:>12} {:>12}\n", "circle, radius error mm", "dense", "icgn");
    let number = |e: Option<f64>| e.map_or("-".to_owned(), |e| format!("{e:+.3}"));
    for circle in circles {
        let kind = match circle.is_hole {
            Some(true) => "hole",
            Some(false) => "disc",
            None => "circle",
        };
        let _ = writeln!(
            text,
            "{:<24} {:>12} {:>12}",
            format!("{kind} of {:.0} mm", circle.radius_mm),
            number(circle.radius_error_mm),
            number(circle.reference_radius_error_mm),
        );
    }
    text
}
