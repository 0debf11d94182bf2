//! Fits against analytic truth, clean and with a fifth of outliers, and what must be refused.

mod common;

use common::Random;
use nalgebra::{Isometry3, Point3, Vector3};
use stspp::measure::circle::{self, RimSearch};
use stspp::measure::find::{SphereSearch, spheres};
use stspp::measure::plane::PlaneFit;
use stspp::measure::robust::{self, Trim};
use stspp::measure::sphere::SphereFit;
use stspp::measure::{FitError, cylinder, deviation};
use stspp::register::mesh_surface::MeshSurface;

type Points = Vec<Point3<f64>>;

/// A thousandth of a millimetre.
const MICROMETRE: f64 = 1e-6;

fn pose() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(0.03, -0.05, 0.95), Vector3::new(0.2, -0.3, 0.4))
}

fn on_plane(count: usize, random: &mut Random) -> Points {
    (0..count)
        .map(|_| pose() * Point3::new(random.range(-0.2, 0.2), random.range(-0.15, 0.15), 0.0))
        .collect()
}

/// The cap of a sphere that a camera sees.
fn on_sphere(count: usize, centre: Point3<f64>, radius: f64, random: &mut Random) -> Points {
    (0..count)
        .map(|_| {
            let (z, turn) = (random.range(0.3, 1.0), random.range(0.0, std::f64::consts::TAU));
            let r = (1.0 - z * z).sqrt();
            centre + Vector3::new(r * turn.cos(), r * turn.sin(), -z) * radius
        })
        .collect()
}

/// The half of a cylinder that a camera sees, its axis along `pose() * x`.
fn on_cylinder(count: usize, radius: f64, random: &mut Random) -> Points {
    (0..count)
        .map(|_| {
            let (x, turn) = (random.range(-0.12, 0.12), random.range(-1.2, 1.2));
            pose() * Point3::new(x, radius * turn.sin(), -radius * turn.cos())
        })
        .collect()
}

fn on_circle(count: usize, radius: f64, random: &mut Random) -> Points {
    (0..count)
        .map(|_| {
            let turn = random.range(0.0, std::f64::consts::TAU);
            pose() * Point3::new(radius * turn.cos(), radius * turn.sin(), 0.0)
        })
        .collect()
}

/// Every fifth point strays, most of them to the same side, as mismatches at a step do.
fn spoilt(mut points: Points, random: &mut Random) -> Points {
    for point in points.iter_mut().step_by(5) {
        *point += Vector3::new(
            random.range(-0.01, 0.01),
            random.range(-0.01, 0.01),
            random.range(0.003, 0.06),
        );
    }
    points
}

/// Clean and with a fifth of strays.
fn both(points: Points, random: &mut Random) -> [Points; 2] {
    [points.clone(), spoilt(points, random)]
}

#[test]
fn planes_are_found_to_a_micrometre() {
    let mut random = Random(1);
    let truth = pose() * Vector3::z();
    for points in both(on_plane(20_000, &mut random), &mut random) {
        let fit = robust::fit::<PlaneFit>(&points, &Trim::default()).unwrap();
        let off = (fit.shape.point_m - pose() * Point3::origin()).dot(&truth);
        assert!(off.abs() < MICROMETRE && fit.rms_m < MICROMETRE, "{off} {}", fit.rms_m);
        assert!(fit.shape.normal.cross(&truth).norm() < MICROMETRE);
    }
}

#[test]
fn spheres_are_found_to_a_micrometre() {
    let mut random = Random(2);
    let centre = Point3::new(0.04, -0.02, 0.9);
    for points in both(on_sphere(20_000, centre, 0.075, &mut random), &mut random) {
        let fit = robust::fit::<SphereFit>(&points, &Trim::default()).unwrap();
        assert!((fit.shape.centre_m - centre).norm() < MICROMETRE, "{:?}", fit.shape);
        assert!((fit.shape.radius_m - 0.075).abs() < MICROMETRE);
    }
    let strays = spoilt(on_sphere(20_000, centre, 0.075, &mut random), &mut random);
    let fit = robust::fit::<SphereFit>(&strays, &Trim::default()).unwrap();
    assert!((fit.rejected() - 0.2).abs() < 0.003, "{}", fit.rejected());
}

#[test]
fn cylinders_are_found_to_a_micrometre() {
    let mut random = Random(3);
    for points in both(on_cylinder(20_000, 0.03, &mut random), &mut random) {
        let fit = cylinder::fit(&points, &Trim::default()).unwrap().shape;
        assert!((fit.radius_m - 0.03).abs() < MICROMETRE, "{fit:?}");
        assert!(fit.axis.cross(&(pose() * Vector3::x())).norm() < 1e-5, "{fit:?}");
        let origin = pose() * Point3::origin();
        let off = (origin - fit.point_m).cross(&fit.axis).norm();
        assert!(off < MICROMETRE, "{off}");
    }
}

#[test]
fn circles_are_found_to_a_micrometre() {
    let mut random = Random(4);
    for points in both(on_circle(2000, 0.015, &mut random), &mut random) {
        let fit = circle::fit(&points, &Trim::default()).unwrap();
        assert!((fit.radius_m - 0.015).abs() < MICROMETRE, "{fit:?}");
        assert!((fit.centre_m - pose() * Point3::origin()).norm() < MICROMETRE, "{fit:?}");
    }
}

#[test]
fn noise_goes_into_the_rms_and_not_into_the_size() {
    let mut random = Random(5);
    let centre = Point3::new(0.0, 0.0, 1.0);
    let mut points = on_sphere(40_000, centre, 0.05, &mut random);
    for p in &mut points {
        let normal: f64 = (0..12).map(|_| random.next()).sum::<f64>() - 6.0;
        *p += (*p - centre).normalize() * normal * 5e-5;
    }
    let fit = robust::fit::<SphereFit>(&points, &Trim::default()).unwrap();
    assert!((fit.rms_m - 5e-5).abs() < 2e-6, "{}", fit.rms_m);
    assert!((fit.shape.radius_m - 0.05).abs() < 3e-6, "{}", fit.shape.radius_m);
    assert!(fit.rejected() < 1e-3, "{}", fit.rejected());
}

#[test]
fn rims_of_holes_and_discs_are_found_in_a_sampled_face() {
    let mut random = Random(6);
    // Samples 0.4 mm apart, each a little off its place.
    let spacing = 4e-4;
    let face: Vec<(f64, f64)> = (0..200 * 200)
        .map(|k| {
            let at = |k: i32, random: &mut Random| {
                (f64::from(k) - 100.0 + random.range(-0.05, 0.05)) * spacing
            };
            (at(k % 200, &mut random), at(k / 200, &mut random))
        })
        .collect();
    let centre = (0.0031, -0.0047);
    let radius = 0.012;
    for hole in [true, false] {
        let points: Points = face
            .iter()
            .filter(|(x, y)| ((x - centre.0).hypot(y - centre.1) > radius) == hole)
            .map(|(x, y)| pose() * Point3::new(*x, *y, 0.0))
            .collect();
        let near = pose() * Point3::new(0.003, -0.004, 0.0);
        let rim = circle::rim(&points, &RimSearch::around(near, radius)).unwrap();
        assert_eq!(rim.is_hole, hole);
        let off = rim.circle.centre_m - pose() * Point3::new(centre.0, centre.1, 0.0);
        assert!(off.norm() < 4e-5, "{off}");
        assert!((rim.circle.radius_m - radius).abs() < 8e-5, "{hole} {:?}", rim.circle);
    }
}

#[test]
fn two_spheres_are_found_before_a_wall() {
    let mut random = Random(7);
    let centres = [Point3::new(-0.1, 0.02, 0.95), Point3::new(0.12, -0.03, 1.0)];
    let mut points: Points = (0..30_000)
        .map(|_| Point3::new(random.range(-0.3, 0.3), random.range(-0.25, 0.25), 1.2))
        .collect();
    for centre in centres {
        points.extend(on_sphere(4000, centre, 0.04, &mut random));
    }
    for radius_m in [None, Some(0.04)] {
        let search = SphereSearch { count: 2, radius_m, trim: Trim::default() };
        let found = spheres(&points, &search).unwrap();
        let spacing = (found[0].fit.shape.centre_m - found[1].fit.shape.centre_m).norm();
        let truth = (centres[0] - centres[1]).norm();
        assert!((spacing - truth).abs() < MICROMETRE, "{spacing} {truth}");
    }
    let search = SphereSearch { count: 3, radius_m: None, trim: Trim::default() };
    let error = spheres(&points, &search).unwrap_err();
    assert_eq!(error, FitError::NotFound { shape: "sphere", found: 2, wanted: 3 });
}

#[test]
fn degenerate_points_are_refused() {
    let mut random = Random(8);
    let trim = Trim::default();
    let plane = on_plane(500, &mut random);
    let line: Points = (0..100).map(|k| Point3::new(f64::from(k), 0.0, 1.0)).collect();
    let nan = vec![Point3::new(f64::NAN, 0.0, 0.0); 50];
    let degenerate = |e: FitError| matches!(e, FitError::Degenerate { .. });
    assert!(degenerate(robust::fit::<SphereFit>(&plane, &trim).unwrap_err()));
    assert!(degenerate(cylinder::fit(&plane, &trim).unwrap_err()));
    assert!(degenerate(robust::fit::<PlaneFit>(&line, &trim).unwrap_err()));
    assert!(degenerate(circle::fit(&line, &trim).unwrap_err()));
    for error in [
        robust::fit::<SphereFit>(&nan, &trim).err(),
        cylinder::fit(&nan, &trim).err(),
        circle::fit(&[], &trim).err(),
    ] {
        assert!(matches!(error, Some(FitError::TooFewPoints { got: 0, .. })), "{error:?}");
    }
}

#[test]
fn deviations_have_the_sign_of_the_sensors_side() {
    let corner = |x: f64, y: f64| Point3::new(x, y, 1.0);
    // One triangle's normal points to the sensor, the other's away from it.
    let mesh = MeshSurface::new([
        [corner(-1.0, -1.0), corner(1.0, -1.0), corner(-1.0, 1.0)],
        [corner(1.0, 1.0), corner(1.0, -1.0), corner(-1.0, 1.0)],
    ])
    .unwrap();
    let points = [
        Point3::new(-0.3, -0.3, 0.998),
        Point3::new(0.3, 0.3, 0.998),
        Point3::new(0.3, 0.3, 1.001),
        Point3::new(0.0, 0.0, 1.5),
        Point3::new(f64::NAN, 0.0, 1.0),
    ];
    let found = deviation::deviations(&points, &mesh, &Isometry3::identity(), 0.01);
    for (d, expected) in found.signed_m.iter().zip([0.002, 0.002, -0.001]) {
        assert!((d - expected).abs() < 1e-12, "{d} {expected}");
    }
    assert!(found.signed_m[3].is_nan() && found.signed_m[4].is_nan());
    let summary = found.summary(&points).unwrap();
    assert_eq!((summary.points, summary.matched), (4, 0.75));
    assert!((summary.max_mm - 2.0).abs() < 1e-9);
}
