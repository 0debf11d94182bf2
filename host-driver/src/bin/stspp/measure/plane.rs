//! `stspp measure plane`: flatness, and what users of depth cameras ask of a flat target.

use serde_json::json;
use stspp::measure::camera::{facing_plane, flat_target};
use stspp::measure::form::form;
use stspp::measure::plane::PlaneFit;
use stspp::measure::region::Region;
use stspp::measure::robust;

use super::input::{Input, Loaded};
use super::{fit_failure, judge};
use crate::exit::Failure;
use crate::output::Output;

/// Fit a plane: flatness error, and of frames fill rate, Z accuracy, sub-pixel RMS, noise over time.
///
/// Without a region, frames are measured in the middle half of what is valid, clouds where most points
/// agree on a plane.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    input: Input,
    /// True distance of a target that faces the sensor, metres along the rectified cameras' axis: gives
    /// the Z accuracy.
    #[arg(long, value_name = "M")]
    distance_m: Option<f64>,
    /// Exit with code 6 when the RMS is larger.
    #[arg(long, value_name = "MM")]
    limit_mm: Option<f64>,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let trim = args.input.trim()?;
    let asked = args.input.region()?;
    let loaded = args.input.load(output)?;
    let region = match &loaded {
        Loaded::Frame(frame, _) => asked.or_else(|| Region::central_half(frame)),
        Loaded::Cloud(_) => asked,
    };
    let points = loaded.points(region.as_ref())?;
    let fit = robust::fit::<PlaneFit>(&points, &trim).map_err(|e| fit_failure(&e))?;
    let plane = fit.shape;
    let used = points.iter().zip(&fit.used).filter(|(_, used)| **used);
    let flatness = form(used.map(|(p, _)| plane.distance_m(p)));
    let mut text = format!(
        "plane of {} points ({:.2} % left out as outliers), {:.4} m from the sensor\n\
         RMS {:.4} mm\n",
        fit.points(),
        100.0 * fit.rejected(),
        plane.point_m.coords.dot(&plane.normal).abs(),
        fit.rms_m * 1e3,
    );
    if let Some(form) = flatness {
        text += &format!(
            "flatness error {:.4} mm (range, {} strays left out; after VDI/VDE 2634-2)\n",
            form.range_mm, form.strays
        );
    }
    let mut json = json!({
        "shape": "plane", "point_m": plane.point_m.coords.as_slice(),
        "normal": plane.normal.as_slice(),
        "rms_mm": fit.rms_m * 1e3, "points": fit.points(), "rejected": fit.rejected(),
        "flatness": flatness,
    });
    if let (Loaded::Frame(frame, noise), Some(region)) = (&loaded, &region) {
        let truth = args.distance_m.map(|d| facing_plane(frame, d));
        let target = flat_target(frame, region, truth).map_err(|e| fit_failure(&e))?;
        text += &format!(
            "fill rate {:.2} % of {} px; depth {:.4} m; plane-fit RMS {:.4} mm ({:.4} %), sub-pixel \
             RMS {:.4} px\n",
            100.0 * target.fill_rate,
            target.pixels,
            target.distance_m,
            target.plane_rms_mm,
            target.plane_rms_percent,
            target.subpixel_rms_px,
        );
        text += &match (target.z_accuracy_mm, target.z_accuracy_percent) {
            (Some(mm), Some(percent)) => format!("Z accuracy {mm:+.4} mm ({percent:+.4} %)\n"),
            _ => "Z accuracy: unknown without --distance-m\n".to_owned(),
        };
        text += &match noise {
            Some(noise) => format!(
                "noise over {} frames: {:.4} mm (median standard deviation of a pixel's depth; 95th \
                 percentile {:.4}), {:.4} px; {:.2} % of the pixels flicker\n",
                noise.frames,
                noise.median_std_mm,
                noise.p95_std_mm,
                noise.median_std_px,
                100.0 * noise.flicker,
            ),
            None => "noise over time: unknown from one frame (--count)\n".to_owned(),
        };
        json["target"] = json!(target);
        json["temporal_noise"] = json!(noise);
    }
    output.result(&text, &json);
    judge("the RMS", fit.rms_m * 1e3, args.limit_mm)
}
