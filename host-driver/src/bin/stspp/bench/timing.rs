//! `stspp bench`: wall and CPU time of each stage of a depth frame.

use std::path::PathBuf;

use serde_json::json;
use stspp::cpu_time::{Step, Stopwatch};
use stspp::reconstruct::{ReconstructError, RectifiedStack};
use stspp::recording::StereoPair;
use stspp::rectify::RectifyScratch;
use stspp::{PointCloud, Recording, StereoCalibration, report, reproject};
use stspp_matcher::Matcher;

use crate::exit::{Failure, Kind};
use crate::output::Output;
use crate::reconstruct::{Matching, reconstruct_failure};

/// What is timed, and how often.
#[derive(clap::Args)]
#[group(id = "timing")]
pub struct Args {
    /// Recording folder; the simulated sphere scene when left out.
    folder: Option<PathBuf>,
    /// Repetitions; the one of least CPU time counts.
    #[arg(long, default_value_t = 3)]
    repeat: usize,
    #[command(flatten)]
    matching: Matching,
}

fn input(args: &Args, output: &Output) -> Result<(StereoCalibration, Vec<StereoPair>), Failure> {
    let frames = args.matching.frames.unwrap_or(10);
    if let Some(folder) = &args.folder {
        let failed = |e| reconstruct_failure(&ReconstructError::Recording(e));
        let recording = Recording::open(folder).map_err(failed)?;
        let frames = frames.min(recording.len());
        let pairs = recording.read_window(0..frames).map_err(failed)?;
        return Ok((recording.calibration, pairs));
    }
    simulated(frames, output)
}

#[cfg(feature = "sim")]
fn simulated(
    frames: usize,
    output: &Output,
) -> Result<(StereoCalibration, Vec<StereoPair>), Failure> {
    use stspp::accuracy::Capture;
    use stspp_hil_sim::world::{SceneSpec, SensorModel};

    let progress = output.progress(frames as u64, "simulating");
    let failed = |e| Failure::new(Kind::Input, e);
    let scene = SceneSpec::parse("sphere", &[]).map_err(failed)?;
    let model = SensorModel::default();
    let capture = Capture::record(&scene, model, frames, &mut |k| progress.set_position(k as u64))
        .map_err(failed)?;
    progress.finish_and_clear();
    Ok((capture.calibration, capture.pairs))
}

#[cfg(not(feature = "sim"))]
fn simulated(_: usize, _: &Output) -> Result<(StereoCalibration, Vec<StereoPair>), Failure> {
    Err(Failure::new(Kind::Usage, "no recording folder").remedy("this build has no simulator"))
}

/// Largest memory that the process has held so far, simulation and all raw images included, in MiB;
/// `None` where the system does not say.
fn peak_resident_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.split_whitespace().next()?.parse::<f64>().ok().map(|kib| kib / 1024.0)
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let (calibration, pairs) = input(args, output)?;
    let options = args.matching.options();
    let failed = |e: ReconstructError| reconstruct_failure(&e);
    let rectifier = options.rectifier(&calibration).map_err(|e| failed(e.into()))?;
    let params = options.params(&rectifier);
    let candidates = params.disparity.max_px - params.disparity.min_px + 1;
    let stack = RectifiedStack::new(rectifier, &pairs, Vec::new()).map_err(|e| failed(e.into()))?;
    let mut matcher = Matcher::new(params).map_err(|e| failed(e.into()))?;
    let Some(newest) = pairs.last() else {
        return Err(Failure::new(Kind::Input, "no pair of images to time"));
    };
    let progress = output.progress(args.repeat.max(1) as u64, "matching");
    let mut best: Option<(Vec<Step>, usize)> = None;
    let mut walls_ms = Vec::new();
    let (mut scratch, mut cloud) = (RectifyScratch::default(), PointCloud::default());
    let (mut left, mut right) = (stack.rectifier.canvas(), stack.rectifier.canvas());
    let pool = matcher.pool().clone();
    let mut frame = || {
        let mut watch = Stopwatch::default();
        // A stream rectifies the newest pair only: the others are in its window already.
        stack.rectifier.rectify_left(&newest.left, &mut left, &mut scratch)?;
        stack.rectifier.rectify_right(&newest.right, &mut right, &mut scratch)?;
        watch.step("rectify");
        let mut matched = stack.matched(&mut matcher, 0..stack.len())?;
        watch.step("match");
        let inner: Vec<Step> = matched
            .stages
            .iter()
            .map(|s| Step {
                stage: format!("match/{}", s.stage),
                wall_ms: s.wall_ms,
                cpu_ms: s.cpu_ms,
            })
            .collect();
        let lefts: Vec<_> = stack.left.iter().collect();
        let intensity = reproject::brightness(&mut matched, &lefts);
        let frame =
            reproject::depth_frame(stack.rectifier.geometry(), matched, intensity, Vec::new());
        watch.step("reproject");
        frame.point_cloud_into(&mut cloud);
        watch.step("point cloud");
        Ok((watch, inner, cloud.len()))
    };
    for _ in 0..args.repeat.max(1) {
        let (watch, inner, points) = pool.frame(&mut frame).map_err(failed)?;
        let steps: Vec<Step> = watch.steps().to_vec();
        walls_ms.push(steps.iter().map(|s| s.wall_ms).sum::<f64>());
        let total = |steps: &[Step]| -> f64 {
            let outer = steps.iter().filter(|s| !s.stage.contains('/'));
            outer.map(|s| s.cpu_ms.unwrap_or(s.wall_ms)).sum()
        };
        if best.as_ref().is_none_or(|(fastest, _)| total(&steps) < total(fastest)) {
            let steps = steps.into_iter().chain(inner).collect();
            best = Some((steps, points));
        }
        progress.inc(1);
    }
    progress.finish_and_clear();
    let Some((steps, points)) = best else { return Ok(()) };
    let (outer, inner): (Vec<Step>, Vec<Step>) =
        steps.into_iter().partition(|step| !step.stage.contains('/'));
    let wall_ms: f64 = outer.iter().map(|s| s.wall_ms).sum();
    let cpu_ms: Option<f64> = outer.iter().map(|s| s.cpu_ms).sum();
    walls_ms.sort_unstable_by(f64::total_cmp);
    let geometry = stack.rectifier.geometry();
    let machine = stspp_matcher::machine::measure(matcher.level());
    let samples = (geometry.width * geometry.height * stack.len()) as f64;
    let json = json!({
        "total_wall_ms": wall_ms,
        "total_cpu_ms": cpu_ms,
        "fastest_wall_ms": walls_ms.first(),
        "median_wall_ms": walls_ms.get(walls_ms.len() / 2),
        "stages": outer,
        "matching_stages": inner,
        "threads": matcher.threads(),
        "simd": matcher.level().name(),
        "frames": stack.len(),
        "width_px": geometry.width,
        "height_px": geometry.height,
        "candidates": candidates,
        "points": points,
        "points_per_s": points as f64 / wall_ms * 1e3,
        "cpu_ns_per_sample": cpu_ms.map(|ms| ms * 1e6 / samples),
        "repeat": args.repeat,
        "machine": {
            "popcount_g_per_s": machine.popcount_g_per_s,
            "fma_gflop_per_s": machine.fma_gflop_per_s,
        },
        "peak_resident_mib": peak_resident_mib(),
        "parameters": report::params_json(matcher.params()),
        "versions": report::versions_json(),
    });
    let mut text = format!("{:<24} {:>9} {:>9}\n", "stage", "wall ms", "CPU ms");
    for step in outer.iter().chain(&inner) {
        let cpu = step.cpu_ms.map_or("-".to_owned(), |ms| format!("{ms:.1}"));
        text += &format!("{:<24} {:>9.1} {:>9}\n", step.stage, step.wall_ms, cpu);
    }
    let cpu = cpu_ms.map_or("-".to_owned(), |ms| format!("{ms:.1}"));
    text += &format!("{:<24} {wall_ms:>9.1} {cpu:>9}\n", "total");
    if let Some(median_ms) = walls_ms.get(walls_ms.len() / 2) {
        text += &format!("of {} frames: {:.1} ms the fastest, ", walls_ms.len(), walls_ms[0]);
        text +=
            &format!("{median_ms:.1} the median of wall time; above, the one of least CPU time\n");
    }
    text += &format!(
        "{points} points, {:.2} million a second; {} x {} px, {} frames, {candidates} candidates, \
         {} threads, {}\n",
        points as f64 / wall_ms / 1e3,
        geometry.width,
        geometry.height,
        stack.len(),
        matcher.threads(),
        matcher.level(),
    );
    text += &format!(
        "machine, one core: {:.1} G descriptor comparisons/s, {:.0} GFLOP/s of multiply-adds\n",
        machine.popcount_g_per_s, machine.fma_gflop_per_s,
    );
    output.result(&text, &json);
    Ok(())
}
