//! `stspp measure sphere` and `spheres`: probing errors and sphere spacing.

use nalgebra::Point3;
use serde_json::{Value, json};
use stspp::measure::find::{self, Found, SphereSearch};
use stspp::measure::form::form;

use super::input::Input;
use super::{fit_failure, judge};
use crate::exit::Failure;
use crate::output::Output;

/// Find and fit a sphere: probing errors of form and of size.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    input: Input,
    /// Calibrated diameter in millimetres: gives the size error, and helps to find the sphere.
    #[arg(long, value_name = "MM")]
    diameter_mm: Option<f64>,
    /// Exit with code 6 when the form error is larger.
    #[arg(long, value_name = "MM")]
    limit_mm: Option<f64>,
}

/// Find and fit two spheres: sphere spacing error.
#[derive(clap::Args)]
pub struct SpacingArgs {
    #[command(flatten)]
    input: Input,
    /// Calibrated diameter of both in millimetres.
    #[arg(long, value_name = "MM")]
    diameter_mm: Option<f64>,
    /// Calibrated distance of their centres in millimetres: gives the spacing error.
    #[arg(long, value_name = "MM")]
    spacing_mm: Option<f64>,
    /// Exit with code 6 when the magnitude of the spacing error is larger.
    #[arg(long, value_name = "MM")]
    limit_mm: Option<f64>,
}

fn found(
    input: &Input,
    count: usize,
    diameter_mm: Option<f64>,
    output: &Output,
) -> Result<Vec<Found>, Failure> {
    let trim = input.trim()?;
    let region = input.region()?;
    let points: Vec<Point3<f64>> = input.load(output)?.points(region.as_ref())?;
    let radius_m = diameter_mm.map(|d| d / 2000.0);
    find::spheres(&points, &SphereSearch { count, radius_m, trim }).map_err(|e| fit_failure(&e))
}

/// The figures of one sphere, its form error in millimetres last.
fn figures(found: &Found, diameter_mm: Option<f64>) -> (String, Value, f64) {
    let sphere = found.fit.shape;
    let used = found.points_m.iter().zip(&found.fit.used).filter(|(_, used)| **used);
    let probing = form(used.map(|(p, _)| sphere.distance_m(p)));
    let form_mm = probing.map_or(f64::NAN, |f| f.range_mm);
    let size_mm = diameter_mm.map(|d| sphere.radius_m * 2e3 - d);
    let mut text = format!(
        "sphere of diameter {:.4} mm at ({:.5}, {:.5}, {:.5}) m: {} points over {:.0} degrees, RMS {:.4} mm\n\
         probing error of form {form_mm:.4} mm (range of the deviations; after VDI/VDE 2634-2)\n",
        sphere.radius_m * 2e3,
        sphere.centre_m.x,
        sphere.centre_m.y,
        sphere.centre_m.z,
        found.fit.points(),
        found.cap_deg,
        found.fit.rms_m * 1e3,
    );
    if let Some(size_mm) = size_mm {
        text += &format!("probing error of size {size_mm:+.4} mm (after VDI/VDE 2634-2)\n");
    }
    let json = json!({
        "shape": "sphere", "centre_m": sphere.centre_m.coords.as_slice(), "diameter_mm": sphere.radius_m * 2e3,
        "rms_mm": found.fit.rms_m * 1e3, "points": found.fit.points(),
        "rejected": found.fit.rejected(), "cap_deg": found.cap_deg,
        "probing_form": probing, "probing_size_mm": size_mm,
    });
    (text, json, form_mm)
}

/// Runs `measure sphere`.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let spheres = found(&args.input, 1, args.diameter_mm, output)?;
    let (text, json, form_mm) = figures(&spheres[0], args.diameter_mm);
    output.result(&text, &json);
    judge("the form error", form_mm, args.limit_mm)
}

/// Runs `measure spheres`.
pub fn spacing(args: &SpacingArgs, output: &Output) -> Result<(), Failure> {
    let spheres = found(&args.input, 2, args.diameter_mm, output)?;
    let [first, second] = [0, 1].map(|k| figures(&spheres[k], args.diameter_mm));
    let centres = [0, 1].map(|k| spheres[k].fit.shape.centre_m);
    let spacing_mm = (centres[0] - centres[1]).norm() * 1e3;
    let error_mm = args.spacing_mm.map(|true_mm| spacing_mm - true_mm);
    let mut text = format!("{}{}spacing of the centres {spacing_mm:.4} mm\n", first.0, second.0);
    if let Some(error_mm) = error_mm {
        text += &format!("sphere spacing error {error_mm:+.4} mm (after VDI/VDE 2634-2)\n");
    }
    let json = json!({
        "shape": "spheres", "spheres": [first.1, second.1], "spacing_mm": spacing_mm,
        "spacing_error_mm": error_mm,
    });
    output.result(&text, &json);
    judge("the spacing error", error_mm.unwrap_or(0.0), args.limit_mm)
}
