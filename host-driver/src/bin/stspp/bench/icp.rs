//! `stspp bench icp`: time of registering a large cloud.

use nalgebra::{Isometry3, Point3, Vector3};
use serde_json::json;
use stspp::cpu_time::Stopwatch;
use stspp::register::icp::{IcpParams, register};
use stspp::register::surface::CloudSurface;

use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Print the time of a point-to-plane ICP of two noisy clouds of a relief, 20 mm and 2 degrees apart.
#[derive(clap::Args)]
pub struct Args {
    /// Points of each cloud.
    #[arg(long, default_value_t = 1_000_000)]
    points: usize,
}

/// A relief of 0.4 m, seen at 1 m.
fn relief(points: usize, shift: f64) -> Vec<Point3<f64>> {
    let side = (points as f64).sqrt().ceil() as usize;
    let mut state = 0x1234_5678_9abc_def0_u64 ^ shift.to_bits();
    let mut noise = move || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1_u32 << 30) - 1.0
    };
    (0..side * side)
        .map(|k| {
            let at = |k: usize| 0.4 * ((k as f64 + shift) / side as f64 - 0.5);
            let (x, y) = (at(k % side), at(k / side));
            let wave =
                0.03 * (9.0 * x).sin() * (7.0 * y).cos() + 0.02 * (21.0 * x + 13.0 * y).sin();
            Point3::new(x, y, 1.0 + wave + 5e-5 * noise())
        })
        .collect()
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    if !(1000..=50_000_000).contains(&args.points) {
        let what = format!("--points {}: expected 1000 to 50 million", args.points);
        return Err(Failure::new(Kind::Usage, what));
    }
    let progress = output.spinner();
    progress.set_message("registering");
    let truth = Isometry3::new(Vector3::new(0.012, -0.01, 0.012), Vector3::new(0.02, -0.02, 0.02));
    let target = relief(args.points, 0.0);
    let source: Vec<_> = relief(args.points, 0.4).iter().map(|p| truth.inverse() * p).collect();
    let mut watch = Stopwatch::default();
    let failed = |e| Failure::new(Kind::Other, e);
    let surface = CloudSurface::new(&target).map_err(failed)?;
    watch.step("tree and normals");
    let found = register(&source, &surface, Isometry3::identity(), &IcpParams::default());
    let found = found.map_err(failed)?;
    watch.step("icp");
    progress.finish_and_clear();
    let error = found.target_from_source * truth.inverse();
    let corner = Point3::new(0.2, 0.2, 1.0);
    let off_mm = (error * corner - corner).norm() * 1e3;
    let mut text = String::new();
    for step in watch.steps() {
        let cpu = step.cpu_ms.map_or("-".into(), |ms| format!("{ms:.0}"));
        text += &format!("{:<18} {:>8.0} ms wall {cpu:>8} ms CPU\n", step.stage, step.wall_ms);
    }
    text += &format!("{} points each, off by {off_mm:.5} mm at a corner\n", source.len());
    let json = json!({
        "points": source.len(), "steps": watch.steps(), "off_mm": off_mm,
        "overlap": found.overlap, "settled": found.settled,
    });
    output.result(&text, &json);
    Ok(())
}
