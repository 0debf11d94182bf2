//! `stspp bench accuracy`: the accuracy tables on the simulated sensor.

use std::path::PathBuf;

use serde_json::json;
use stspp::accuracy::bound;
use stspp::accuracy::budget::{self, Class};
use stspp::accuracy::maps;
use stspp::accuracy::similar::{self, Alike};
use stspp::accuracy::tables::{self, AccuracyError, Case, Line};
use stspp::export::folder::OutputFolder;
use stspp::reconstruct::Options;
use stspp_hil_sim::world::{SceneSpec, SensorModel};
use stspp_matcher::Method;

use crate::exit::{Failure, Kind};
use crate::output::Output;
use crate::reconstruct::{Matching, output_failure};

/// Print accuracy against truth on the simulated sensor.
#[derive(clap::Args)]
pub struct Args {
    /// Scenes: sphere, planes, statue, part, moving, turntable [default: the first three].
    scenes: Vec<String>,
    /// Numbers of frames for the sphere.
    #[arg(long, value_delimiter = ',', default_value = "1,3,5,7,10")]
    counts: Vec<usize>,
    /// Folder for error maps, one picture a line.
    #[arg(long, value_name = "DIR")]
    maps: Option<PathBuf>,
    /// Seed of the simulated sensor: other dots, tolerances and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Also print what each line's error is made of: its pixels by distance from true steps, slope,
    /// curvature and incidence.
    #[arg(long)]
    budget: bool,
    /// Also print how near fits of windows come that are told the truth, a sample of the pixels by distance
    /// from true steps: what noise, blur and windows cost by themselves; and how alike the cameras see each
    /// pixel at its true place, which bounds how many can be found. Takes seconds a line.
    #[arg(long)]
    bound: bool,
    #[command(flatten)]
    matching: Matching,
}

fn failure(error: &AccuracyError) -> Failure {
    Failure::new(Kind::Input, error)
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let default = ["sphere", "planes", "statue"];
    let known = [default.as_slice(), &["part", "moving", "turntable"]].concat();
    if let Some(other) = args.scenes.iter().find(|s| !known.contains(&s.as_str())) {
        return Err(Failure::new(
            Kind::Usage,
            format!("scene `{other}`: expected one of {known:?}"),
        ));
    }
    let wanted = |scene: &str| match args.scenes.as_slice() {
        [] => default.contains(&scene),
        scenes => scenes.iter().any(|s| s == scene),
    };
    let options = args.matching.options();
    let frames = args.matching.frames.unwrap_or(10);
    let spinner = output.spinner();
    let mut lines: Vec<Line> = Vec::new();
    let mut budgets: Vec<(String, Vec<Class>)> = Vec::new();
    let mut bounds: Vec<(String, Vec<bound::Class>, Vec<Alike>)> = Vec::new();
    let mut folder = match &args.maps {
        Some(path) => Some(OutputFolder::create(path, true).map_err(|e| output_failure(&e))?),
        None => None,
    };
    let mut measure = |case: &Case, name: &str, frames: usize, options: Options| {
        spinner.set_message(format!("{name}: matching {frames} frames"));
        let (line, frame) = case.line(name, frames, options).map_err(|e| failure(&e))?;
        let truth = case.truth_for(options, frames);
        if let Some(folder) = &mut folder {
            let method = format!("{:?}-{:?}", options.method, options.shape).to_lowercase();
            let file = format!("{}-{frames}-{method}.png", name.replace(' ', "-"));
            folder
                .file(&file, |out| maps::write_error_png(out, &frame, truth, 0.1))
                .map_err(|e| output_failure(&e))?;
        }
        let title = format!("{name}, {frames} frames, {}", line.method);
        if args.budget {
            budgets.push((title.clone(), budget::budget(&frame, truth)));
        }
        if args.bound {
            spinner.set_message(format!("{name}: windows that are told the truth"));
            let alike = similar::similar(case.stack(), frames, &frame, truth);
            bounds.push((title, bound::bound(case.stack(), frames, &frame, truth), alike));
        }
        lines.push(line);
        Ok::<(), Failure>(())
    };
    let matched = &options;
    let case = |scene: &str, options: &[(&str, &str)], frames: usize| {
        let spec = SceneSpec::parse(scene, options).map_err(AccuracyError::from)?;
        let model = SensorModel::with_seed(args.seed);
        Case::new(&spec, model, frames, matched, &mut |k| {
            spinner.set_message(format!("{scene}: image {} of {frames}", k + 1));
        })
    };
    if wanted("sphere") {
        let most = args.counts.iter().copied().max().unwrap_or(frames);
        let case = case("sphere", &[], most).map_err(|e| failure(&e))?;
        for &count in &args.counts {
            measure(&case, "sphere", count, options)?;
        }
    }
    if wanted("planes") {
        for distance_m in ["1", "1.5", "2"] {
            let case =
                case("plane", &[("distance_m", distance_m)], frames).map_err(|e| failure(&e))?;
            measure(&case, &format!("plane {distance_m} m"), frames, options)?;
        }
    }
    // The statue is scored for the parabola too: what the refinement brings is the point of it.
    if wanted("statue") {
        let case = case("statue", &[], frames).map_err(|e| failure(&e))?;
        let parabola = Options { method: Method::Parabola, ..options };
        for options in [parabola, options] {
            measure(&case, "statue", frames, options)?;
        }
    }
    if wanted("part") {
        let case = case("part", &[], frames).map_err(|e| failure(&e))?;
        measure(&case, "part", frames, options)?;
    }
    // The same plane at rest, and away from and towards the sensor.
    if wanted("moving") {
        for speed_mm_s in ["0", "9", "-9"] {
            let scene = [("speed_mm_s", speed_mm_s)];
            let case = case("moving-plane", &scene, frames).map_err(|e| failure(&e))?;
            measure(&case, &format!("plane {speed_mm_s} mm/s"), frames, options)?;
        }
    }
    if wanted("turntable") {
        for rpm in ["0", "1.2"] {
            let case = case("turntable", &[("rpm", rpm)], frames).map_err(|e| failure(&e))?;
            measure(&case, &format!("turning {rpm} rpm"), frames, options)?;
        }
    }
    if let Some(folder) = folder {
        folder.commit().map_err(|e| output_failure(&e))?;
    }
    spinner.finish_and_clear();
    let mut text = tables::to_text(&lines);
    for (title, classes) in &budgets {
        text += &format!("\n{title}\n{}", budget::to_text(classes));
    }
    for (title, classes, alike) in &bounds {
        text += &format!("\n{title}: RMS from the surface in mm\n{}", bound::to_text(classes));
        let part =
            "part of what both cameras see, by the similarity over time at its true place, %";
        text += &format!("\n{title}: {part}\n{}", similar::to_text(alike));
    }
    let budgets: Vec<_> = budgets
        .iter()
        .map(|(title, classes)| json!({ "line": title, "classes": classes }))
        .collect();
    let bounds: Vec<_> = bounds
        .iter()
        .map(|(title, classes, alike)| {
            json!({ "line": title, "windows": bound::WINDOWS, "classes": classes,
                "similarities": similar::SIMILARITIES, "alike": alike })
        })
        .collect();
    let json = json!({ "seed": args.seed, "lines": lines, "budgets": budgets, "bounds": bounds });
    output.result(&text, &json);
    Ok(())
}
