//! `stspp measure`: shapes, depth-camera figures and comparisons with a reference.

mod compare;
pub mod input;
mod plane;
mod round;
mod sphere;

use clap::Subcommand;

use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Measure planes, spheres, circles, cylinders, or the distance from a reference.
///
/// INPUT is a point cloud (.ply), a recording folder, or a source (sim:SCENE, usb:, replay:FOLDER).
/// Errors of form and size are named after VDI/VDE 2634 part 2; they are no certificate.
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
#[command(rename_all = "kebab-case")]
enum What {
    Plane(plane::Args),
    Sphere(sphere::Args),
    Spheres(sphere::SpacingArgs),
    Circle(round::CircleArgs),
    Cylinder(round::CylinderArgs),
    Compare(compare::Args),
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    match &args.what {
        What::Plane(args) => plane::run(args, output),
        What::Sphere(args) => sphere::run(args, output),
        What::Spheres(args) => sphere::spacing(args, output),
        What::Circle(args) => round::circle(args, output),
        What::Cylinder(args) => round::cylinder(args, output),
        What::Compare(args) => compare::run(args, output),
    }
}

/// The failure that a fit's error is.
fn fit_failure(error: &stspp::measure::FitError) -> Failure {
    Failure::new(Kind::Input, error).remedy("see --box and --rect")
}

/// Ends with code 6 when a stated limit is missed; the result is printed before.
fn judge(what: &str, value_mm: f64, limit_mm: Option<f64>) -> Result<(), Failure> {
    match limit_mm {
        Some(limit) if value_mm.is_nan() || value_mm.abs() > limit => Err(Failure::new(
            Kind::Limit,
            format!("{what} is {value_mm:.4} mm, the limit {limit} mm"),
        )),
        _ => Ok(()),
    }
}

/// Numbers separated by commas.
pub fn numbers<const N: usize>(option: &str, text: &str, form: &str) -> Result<[f64; N], Failure> {
    let values: Option<Vec<f64>> =
        text.split(',').map(|v| v.trim().parse().ok().filter(|v: &f64| v.is_finite())).collect();
    values
        .and_then(|v| v.try_into().ok())
        .ok_or_else(|| Failure::new(Kind::Usage, format!("{option} `{text}`: expected {form}")))
}
