//! Registration against analytic truth.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use stspp::register::icp::{IcpParams, register};
use stspp::register::mesh_surface::MeshSurface;
use stspp::register::surface::CloudSurface;
use stspp::register::{RegisterError, surface::Surface};

/// A relief with enough shape to fix all six degrees of freedom.
fn relief(x: f64, y: f64) -> Point3<f64> {
    let z = 0.9 + 0.03 * (9.0 * x).sin() * (7.0 * y).cos() + 0.02 * (21.0 * x + 13.0 * y).sin();
    Point3::new(x, y, z)
}

fn noise(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
    (*state >> 33) as f64 / f64::from(1u32 << 30) - 1.0
}

fn grid(n: usize, offset: f64) -> Vec<Point3<f64>> {
    (0..n * n)
        .map(|i| {
            let at = |k: usize| 0.4 * ((k as f64 + offset) / n as f64 - 0.5);
            relief(at(i % n), at(i / n))
        })
        .collect()
}

fn offset_pose() -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.02, 0.015));
    Isometry3::from_parts(Translation3::new(0.003, -0.002, 0.004), rotation)
}

/// Largest displacement of a corner of the relief by an error of the pose, metres.
fn worst_corner_m(error: &Isometry3<f64>) -> f64 {
    [(-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2), (0.2, 0.2)]
        .map(|(x, y)| relief(x, y))
        .iter()
        .map(|p| (error * p - p).norm())
        .fold(0.0, f64::max)
}

fn mesh(n: usize) -> MeshSurface {
    let points = grid(n, 0.0);
    let at = |x: usize, y: usize| points[y * n + x];
    let cells = (0..n - 1).flat_map(|y| (0..n - 1).map(move |x| (x, y)));
    let triangles = cells.flat_map(|(x, y)| {
        [[at(x, y), at(x + 1, y), at(x, y + 1)], [at(x + 1, y), at(x + 1, y + 1), at(x, y + 1)]]
    });
    MeshSurface::new(triangles).unwrap()
}

#[test]
fn a_clean_cloud_finds_its_pose_on_a_mesh_to_a_micrometre() {
    let truth = offset_pose();
    let source: Vec<_> = grid(150, 0.37).iter().map(|p| truth.inverse() * p).collect();
    let result = register(&source, &mesh(600), Isometry3::identity(), &IcpParams::default());
    let result = result.unwrap();
    let error = worst_corner_m(&(result.target_from_source * truth.inverse()));
    assert!(result.settled);
    assert!(error < 1e-6, "off by {error} m");
}

#[test]
fn a_fifth_of_outliers_is_rejected() {
    let truth = offset_pose();
    let mut state = 3;
    let source: Vec<_> = grid(150, 0.37)
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let stray = if i % 5 == 0 { 0.004 + 0.01 * noise(&mut state).abs() } else { 0.0 };
            truth.inverse() * (p + Vector3::z() * stray)
        })
        .collect();
    let params = IcpParams { keep: 0.75, ..IcpParams::default() };
    let result = register(&source, &mesh(600), Isometry3::identity(), &params).unwrap();
    let error = worst_corner_m(&(result.target_from_source * truth.inverse()));
    assert!(error < 1e-6, "off by {error} m");
}

#[test]
fn two_noisy_clouds_meet() {
    let truth = offset_pose();
    let mut state = 11;
    let mut noisy = |offset: f64| -> Vec<Point3<f64>> {
        let shift = |p: &Point3<f64>, n: f64| p + Vector3::z() * (3e-5 * n);
        grid(160, offset).iter().map(|p| shift(p, noise(&mut state))).collect()
    };
    let target = CloudSurface::new(&noisy(0.0)).unwrap();
    let source: Vec<_> = noisy(0.4).iter().map(|p| truth.inverse() * p).collect();
    let result = register(&source, &target, Isometry3::identity(), &IcpParams::default()).unwrap();
    let error = worst_corner_m(&(result.target_from_source * truth.inverse()));
    assert!(error < 2e-5, "off by {error} m");
    assert!(result.overlap > 0.9, "{}", result.overlap);
}

#[test]
fn what_cannot_be_registered_is_refused() {
    let plane: Vec<_> = (0..10_000)
        .map(|i| Point3::new(f64::from(i % 100) * 1e-3, f64::from(i / 100) * 1e-3, 1.0))
        .collect();
    let target = CloudSurface::new(&plane).unwrap();
    let params = IcpParams::default();
    let error = register(&plane, &target, Isometry3::identity(), &params).unwrap_err();
    assert_eq!(error, RegisterError::Degenerate { free: 3 });

    let far = Isometry3::translation(0.0, 0.0, 1.0);
    let error = register(&plane, &target, far, &params).unwrap_err();
    assert!(matches!(error, RegisterError::NoOverlap { pairs: 0, .. }), "{error}");

    let nothing = [Point3::new(f64::NAN, 0.0, 0.0); 100];
    let error = register(&nothing, &target, far, &params).unwrap_err();
    assert!(matches!(error, RegisterError::TooFewPoints { got: 0, .. }), "{error}");
    assert!(CloudSurface::new(&nothing).is_err());
    assert!(target.closest(&Point3::new(0.0, 0.0, 5.0), 0.1).is_none());
}

/// A bump-covered block that looks different from every side, seen from one: points that face `to`.
fn blob(seen_from: Vector3<f64>, shift: f64) -> Vec<Point3<f64>> {
    (0..40_000)
        .map(|k| {
            let z = 1.0 - 2.0 * (f64::from(k) + 0.5 + shift) / 40_000.0;
            let turn = f64::from(k) * 2.399_963_229_728_653 + shift;
            let r = (1.0 - z * z).sqrt();
            let d = Vector3::new(r * turn.cos(), r * turn.sin(), z);
            let bumps = 0.02 * (5.0 * d.x + 1.0).sin() * (4.0 * d.y).cos()
                + 0.015 * (7.0 * d.z - 2.0 * d.x).sin()
                + 0.02 * (3.0 * d.y + 2.0).sin();
            (d, Point3::from(d.component_mul(&Vector3::new(0.12, 0.16, 0.2)) * (1.0 + 4.0 * bumps)))
        })
        .filter(|(d, _)| d.dot(&seen_from.normalize()) > 0.1)
        .map(|(_, p)| p)
        .collect()
}

#[test]
fn views_meet_from_anywhere() {
    use stspp::register::global::{self, GlobalParams};
    let target = blob(Vector3::new(0.0, 0.0, 1.0), 0.0);
    // Seen from 40 degrees away, and laid down anyhow.
    let seen = blob(Vector3::new(0.64, 0.1, 0.77), 0.3);
    for turn in [Vector3::new(0.3, 2.0, -1.0), Vector3::new(-2.5, 0.4, 1.1)] {
        let truth = Isometry3::new(Vector3::new(0.4, -0.3, 0.9), turn);
        let source: Vec<_> = seen.iter().map(|p| truth.inverse() * p).collect();
        let coarse = global::register(&source, &target, &GlobalParams::default()).unwrap();
        let surface = CloudSurface::new(&target).unwrap();
        let params = IcpParams { max_distance_m: coarse.reach_m, ..IcpParams::default() };
        let fine = register(&source, &surface, coarse.target_from_source, &params).unwrap();
        let error = fine.target_from_source * truth.inverse();
        let worst = target.iter().map(|p| (error * p - p).norm()).fold(0.0, f64::max);
        assert!(worst < 1e-4, "off by {worst} m, overlap {}", coarse.overlap);
    }
    // Another object: a flat plate cannot be laid on it.
    let plate: Vec<_> = (0..10_000)
        .map(|k| Point3::new(f64::from(k % 100) * 5e-3, f64::from(k / 100) * 5e-3, 1.0))
        .collect();
    let error = global::register(&plate, &target, &GlobalParams::default()).unwrap_err();
    assert!(matches!(error, RegisterError::NoPose { .. }), "{error}");
}
