//! Figure 8: a large panel, from afar and fused with near views.

use nalgebra::{Isometry3, Point3};

use super::studio::FRAMES;
use super::turn::{distances, surface_of, surface_rms_mm};
use super::{ExperimentError, Figure, Row, Section, Studio, pictures};
use crate::fuse::{self, FuseParams, Start, View};
use crate::measure::rms;
use crate::rectify::DepthRange;

/// Shifts of the panel before the sensor for the near views, mm to the right and down.
const NEAR: [(&str, &str); 6] = [
    ("260", "120"),
    ("0", "120"),
    ("-260", "120"),
    ("260", "-120"),
    ("0", "-120"),
    ("-260", "-120"),
];

/// Runs it.
///
/// # Errors
/// [`ExperimentError`].
pub fn run(studio: &mut Studio<'_>) -> Result<Section, ExperimentError> {
    let mut section = Section::new(
        Figure::Fig8,
        "Large panel, from afar and fused with near views",
        "The paper measures a car door of 0.87 x 0.63 m once at 1.6 m and six times at 0.85 m, and fuses \
         the near views guided by the far one. Ours is a panel of that size with creases, a handle's \
         recess and a sill, by formula; the near views are laid on the far one from anywhere, without \
         knowing where they were taken. The errors are the points' distances from the surface that was \
         rendered, in the far view's frame, with no alignment to it.",
    );
    let far = studio.take("panel", &[("distance_m", "1.6")], 0)?;
    let frame = studio.matched(&far, FRAMES, |_| ())?;
    let surface = surface_of(&far, far.centre_ns, "fig8")?;
    let cloud = frame.point_cloud();
    let points: Vec<Point3<f64>> = cloud.points_left_m.iter().map(|p| p.cast()).collect();
    let alone_mm = surface_rms_mm(&points, &surface);
    section.rows.push(
        Row::error_mm("one view at 1.6 m: RMS", Some(1.2167), alone_mm)
            .note(format!("{} points", points.len())),
    );
    section.pictures.push(pictures::depth(&frame, "Depth at 1.6 m")?);
    let found = distances(&points, &surface);
    section.pictures.push(pictures::deviations(&points, &found, 0.5, "One view at 1.6 m")?);
    let view = |name: String, cloud: &crate::PointCloud| {
        let missing = format!("{name} has too few points");
        View::new(name, cloud).ok_or(ExperimentError::Missing { figure: "fig8", what: missing })
    };
    let mut views = vec![view("far view".into(), &cloud)?];
    studio.depths(DepthRange { min_m: 0.75, max_m: 1.3 });
    for (k, (x, y)) in NEAR.into_iter().enumerate() {
        let options = [("distance_m", "0.85"), ("x_mm", x), ("y_mm", y)];
        let take = studio.take("panel", &options, 0)?;
        let frame = studio.matched(&take, FRAMES, |_| ())?;
        if k == 1 {
            section.pictures.push(pictures::depth(&frame, "Depth of a near view, 0.85 m")?);
        }
        views.push(view(format!("near view {}", k + 1), &frame.point_cloud())?);
    }
    studio.depths(DepthRange::default());
    let params = FuseParams { start: Start::Guide, cell_m: 7e-4, ..FuseParams::default() };
    let model = fuse::fuse(&views, &params, &mut |step| studio.say(step))?;
    drop(views);
    let points: Vec<Point3<f64>> = model.points.iter().map(|p| p.point_m).collect();
    let found = distances(&points, &surface);
    let fused_mm = rms(found.signed_m.iter().copied().filter(|d| !d.is_nan())) * 1e3;
    section.rows.push(
        Row::error_mm("fused with six views at 0.85 m: RMS", Some(0.3698), fused_mm).note(format!(
            "{} points; registered pairs disagree by at most {:.4} mm",
            points.len(),
            model.loop_closed_mm
        )),
    );
    section.pictures.push(pictures::deviations(&points, &found, 0.5, "Fused")?);
    let normals: Vec<_> = model.points.iter().map(|p| p.normal).collect();
    let seen = Isometry3::identity();
    section.pictures.push(pictures::shaded(&points, &normals, &seen, "Fused model")?);
    Ok(section)
}
