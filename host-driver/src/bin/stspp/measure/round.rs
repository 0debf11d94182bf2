//! `stspp measure circle` and `cylinder`.

use nalgebra::Point3;
use serde_json::json;
use stspp::measure::circle::{self, RimSearch};
use stspp::measure::cylinder;

use super::input::Input;
use super::{fit_failure, judge, numbers};
use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Fit the circular edge of a hole or a disc: centre, radius, the face it is in.
#[derive(clap::Args)]
pub struct CircleArgs {
    #[command(flatten)]
    input: Input,
    /// Where the circle is about: x,y,z in metres of the left camera's frame.
    #[arg(long, value_name = "POINT", allow_hyphen_values = true)]
    near: String,
    /// Its radius about, millimetres.
    #[arg(long, value_name = "MM")]
    radius_mm: f64,
}

/// Fit a cylinder in a region: axis, diameter, form.
#[derive(clap::Args)]
pub struct CylinderArgs {
    #[command(flatten)]
    input: Input,
    /// True diameter in millimetres: gives the size error.
    #[arg(long, value_name = "MM")]
    diameter_mm: Option<f64>,
    /// Exit with code 6 when the RMS is larger.
    #[arg(long, value_name = "MM")]
    limit_mm: Option<f64>,
}

/// Runs `measure circle`.
pub fn circle(args: &CircleArgs, output: &Output) -> Result<(), Failure> {
    let near = Point3::from(numbers::<3>("--near", &args.near, "x,y,z in metres")?);
    if !(0.1..=500.0).contains(&args.radius_mm) {
        let what = format!("--radius-mm {}: expected 0.1 to 500", args.radius_mm);
        return Err(Failure::new(Kind::Usage, what));
    }
    let region = args.input.region()?;
    let all = args.input.load(output)?.points(region.as_ref())?;
    let radius_m = args.radius_mm * 1e-3;
    let search = RimSearch::around(near, radius_m);
    // The face around it, wide enough that what is cut off here is no edge there.
    let reach_m = search.reach_m + 0.5 * radius_m + 5e-3;
    let around: Vec<_> = all.into_iter().filter(|p| (p - near).norm() < reach_m).collect();
    let rim = circle::rim(&around, &search).map_err(|e| fit_failure(&e))?;
    let c = rim.circle;
    let kind = if rim.is_hole { "hole" } else { "disc" };
    let text = format!(
        "{kind} of radius {:.4} mm at ({:.5}, {:.5}, {:.5}) m\n\
         {} edge points, RMS {:.4} mm; points are {:.3} mm apart, which limits small circles",
        c.radius_m * 1e3,
        c.centre_m.x,
        c.centre_m.y,
        c.centre_m.z,
        c.points,
        c.rms_m * 1e3,
        rim.spacing_m * 1e3,
    );
    let json = json!({
        "shape": "circle", "kind": kind, "centre_m": c.centre_m.coords.as_slice(),
        "normal": c.normal.as_slice(),
        "radius_mm": c.radius_m * 1e3, "radius_off_mm": c.radius_m * 1e3 - args.radius_mm,
        "rms_mm": c.rms_m * 1e3, "points": c.points, "spacing_mm": rim.spacing_m * 1e3,
    });
    output.result(&text, &json);
    Ok(())
}

/// Runs `measure cylinder`.
pub fn cylinder(args: &CylinderArgs, output: &Output) -> Result<(), Failure> {
    let trim = args.input.trim()?;
    let region = args.input.region()?;
    let points = args.input.load(output)?.points(region.as_ref())?;
    let fit = cylinder::fit(&points, &trim).map_err(|e| fit_failure(&e))?;
    let c = fit.shape;
    let used = points.iter().zip(&fit.used).filter(|(_, used)| **used);
    let form = stspp::measure::form::form(used.map(|(p, _)| c.distance_m(p)));
    let size_mm = args.diameter_mm.map(|d| c.radius_m * 2e3 - d);
    let mut text = format!(
        "cylinder of diameter {:.4} mm, axis ({:.5}, {:.5}, {:.5}) through ({:.5}, {:.5}, {:.5}) m\n\
         {} points ({:.2} % left out), RMS {:.4} mm, form (range) {:.4} mm\n",
        c.radius_m * 2e3,
        c.axis.x,
        c.axis.y,
        c.axis.z,
        c.point_m.x,
        c.point_m.y,
        c.point_m.z,
        fit.points(),
        100.0 * fit.rejected(),
        fit.rms_m * 1e3,
        form.map_or(f64::NAN, |f| f.range_mm),
    );
    if let Some(size_mm) = size_mm {
        text += &format!("size error {size_mm:+.4} mm\n");
    }
    let json = json!({
        "shape": "cylinder", "axis": c.axis.as_slice(), "point_m": c.point_m.coords.as_slice(),
        "diameter_mm": c.radius_m * 2e3, "size_error_mm": size_mm, "rms_mm": fit.rms_m * 1e3,
        "points": fit.points(), "rejected": fit.rejected(), "form": form,
    });
    output.result(&text, &json);
    judge("the RMS", fit.rms_m * 1e3, args.limit_mm)
}
