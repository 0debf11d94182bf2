//! A whole turn of the statue, in views that are fused.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::studio::{RATE_HZ, Take};
use super::{ExperimentError, Row, Section, Studio, pictures};
use crate::fuse::{self, FuseParams, Start, View};
use crate::measure::deviation::{Deviations, deviations};
use crate::measure::rms;
use crate::register::mesh_surface::MeshSurface;

/// Views of a turn.
const VIEWS: usize = 12;
/// Frames of each view: every exposure of a turning statue has to be rendered anew.
const VIEW_FRAMES: usize = 5;
/// Turns a minute (paper).
const RPM: f64 = 1.2;
/// Distance within which a point belongs to the surface, metres.
const MATCH_M: f64 = 5e-3;

/// Fuses a whole turn of the statue, turning or standing.
pub(super) fn whole(
    studio: &mut Studio<'_>,
    section: &mut Section,
    moving: bool,
) -> Result<(), ExperimentError> {
    let what = if moving { "turning" } else { "standing" };
    let mut views = Vec::new();
    let mut surface = None;
    let mut single = Vec::new();
    let mut truth = Vec::new();
    for k in 0..VIEWS {
        // A turn takes 50 s, 1500 frames.
        let first = (k as f64 * 60.0 / RPM / VIEWS as f64 * RATE_HZ).round() as usize;
        let turn = format!("{}", (k as i32 * 30 + 180) % 360 - 180);
        let take = if moving {
            studio.take_frames("turntable", &[], first, VIEW_FRAMES)?
        } else {
            studio.take_frames("statue", &[("turn_deg", &turn)], 0, VIEW_FRAMES)?
        };
        let frame = studio.matched(&take, VIEW_FRAMES, |_| ())?.at_window_middle();
        truth.push(left_from_object(&take, take.time_ns(&frame), "fig6")?);
        let cloud = frame.point_cloud();
        let mesh = surface_of(&take, take.time_ns(&frame), "fig6")?;
        let points: Vec<Point3<f64>> = cloud.points_left_m.iter().map(|p| p.cast()).collect();
        studio.say(format!("{what} view {}: comparing with the surface", k + 1));
        single.push(surface_rms_mm(&points, &mesh));
        if k == 0 {
            surface = Some(mesh);
            let caption = format!("Depth of the first view, {what}");
            section.pictures.push(pictures::depth(&frame, &caption)?);
        }
        let view = View::new(format!("{what} view {}", k + 1), &cloud);
        views.push(view.ok_or_else(|| {
            let what = format!("view {} has too few points", k + 1);
            ExperimentError::Missing { figure: "fig6", what }
        })?);
    }
    let step_rad = std::f64::consts::TAU / VIEWS as f64;
    let params = FuseParams {
        start: Start::Turntable { step_rad, axis: None },
        cell_m: 7e-4,
        ..FuseParams::default()
    };
    let model = fuse::fuse(&views, &params, &mut |step| studio.say(step))?;
    let errors_mm = pose_errors_mm(&views, &model.first_from_view, &truth);
    drop(views);
    let Some(surface) = surface else { return Ok(()) };
    let points: Vec<Point3<f64>> = model.points.iter().map(|p| p.point_m).collect();
    let found = distances(&points, &surface);
    let fused_mm = rms(found.signed_m.iter().copied().filter(|d| !d.is_nan())) * 1e3;
    let far = found.signed_m.iter().filter(|d| d.is_nan()).count() as f64 / points.len() as f64;
    let single_mm = single.iter().sum::<f64>() / single.len() as f64;
    let paper = moving.then_some(0.4381);
    section.rows.push(
        Row::error_mm(format!("{what} statue, {VIEWS} views fused: RMS"), paper, fused_mm).note(
            format!(
                "{} points, {:.2} % farther off than 5 mm; single views {single_mm:.4} mm on average, so \
                 {:.2} times that",
                points.len(),
                100.0 * far,
                fused_mm / single_mm
            ),
        ),
    );
    let worst_mm = errors_mm.iter().copied().fold(0.0, f64::max);
    section.rows.push(
        Row::error_mm(format!("{what} statue: loop, closed"), None, model.loop_closed_mm).note(
            format!(
                "what any of {} pairs, registered alone, would still move by; neighbour by neighbour the \
                 chain misses its start by {}",
                model.pairs.len(),
                model.loop_open_mm.map_or("(no loop)".into(), |open| format!("{open:.4} mm")),
            ),
        ),
    );
    section.rows.push(
        Row::error_mm(
            format!("{what} statue: views' poses against the truth, worst"),
            None,
            worst_mm,
        )
        .note(format!(
            "RMS displacement of a view's points; mean of the views {:.4} mm",
            errors_mm.iter().sum::<f64>() / (errors_mm.len().max(2) - 1) as f64
        )),
    );
    let caption =
        format!("Fused model ({what}), seen from the first view: distance from the surface");
    section.pictures.push(pictures::deviations(&points, &found, 0.5, &caption)?);
    if moving {
        let normals: Vec<_> = model.points.iter().map(|p| p.normal).collect();
        let middle = Point3::from(
            points.iter().fold(Vector3::zeros(), |s, p| s + p.coords) / points.len() as f64,
        );
        for (angle, name) in [(0.0, "front"), (120.0, "side"), (240.0, "back")] {
            let turn = Isometry3::rotation(Vector3::y() * f64::to_radians(angle));
            let seen = Isometry3::translation(0.0, 0.0, 1.6)
                * turn
                * Isometry3::translation(-middle.x, -middle.y, -middle.z);
            let caption = format!("Fused model, {name}");
            section.pictures.push(pictures::shaded(&points, &normals, &seen, &caption)?);
        }
    }
    Ok(())
}

/// The surface of a take's object at a time.
pub(super) fn surface_of(
    take: &Take,
    time_ns: u64,
    figure: &'static str,
) -> Result<MeshSurface, ExperimentError> {
    let mesh = take.world.truth().mesh(0, time_ns).ok_or_else(|| {
        let what = "the object has no mesh".to_owned();
        ExperimentError::Missing { figure, what }
    })?;
    let corner = |i: u32| Point3::from(mesh.vertices_left_m[i as usize]);
    Ok(MeshSurface::new(mesh.triangles.iter().map(|t| t.map(corner)))?)
}

/// Distances of points from the surface, those beyond 5 mm left out.
pub(super) fn distances(points: &[Point3<f64>], surface: &MeshSurface) -> Deviations {
    deviations(points, surface, &Isometry3::identity(), MATCH_M)
}

pub(super) fn surface_rms_mm(points: &[Point3<f64>], surface: &MeshSurface) -> f64 {
    let found = distances(points, surface);
    rms(found.signed_m.into_iter().filter(|d| !d.is_nan())) * 1e3
}

/// The pose of a take's object at a time, up to a motion that is the same for all times and turns: the
/// frame that three corners of its mesh make.
pub(super) fn left_from_object(
    take: &Take,
    time_ns: u64,
    figure: &'static str,
) -> Result<Isometry3<f64>, ExperimentError> {
    let missing = || ExperimentError::Missing { figure, what: "the object has no mesh".into() };
    let corners = take.world.truth().mesh(0, time_ns).ok_or_else(missing)?.vertices_left_m;
    let [a, b, c] = [0, corners.len() / 3, 2 * corners.len() / 3]
        .map(|k| corners.get(k).copied().unwrap_or_default());
    let x = (b - a).normalize();
    let z = x.cross(&(c - a)).normalize();
    let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, z.cross(&x), z]));
    let rotation = UnitQuaternion::from_rotation_matrix(&axes);
    Ok(Isometry3::from_parts(Translation3::from(a), rotation))
}

/// How far each view's points are from where its true pose puts them, RMS, millimetres; the first view
/// is where it is by definition.
pub(super) fn pose_errors_mm(
    views: &[View],
    first_from_view: &[Isometry3<f64>],
    left_from_object: &[Isometry3<f64>],
) -> Vec<f64> {
    let first = left_from_object[0];
    let found = views.iter().zip(first_from_view).zip(left_from_object);
    found
        .map(|((view, pose), object)| {
            let truth = first * object.inverse();
            let points = view.points_m.iter().step_by(20).map(|p| p.cast::<f64>());
            rms(points.map(|p| (pose * p - truth * p).norm())) * 1e3
        })
        .collect()
}
