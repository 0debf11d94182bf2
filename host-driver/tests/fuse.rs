//! Fusion of synthetic views against the surface that they were taken of.

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use stspp::PointCloud;
use stspp::export::model;
use stspp::fuse::{FuseError, FuseParams, Model, Start, View, fuse};

const VIEWS: usize = 12;

/// A bumpy ellipsoid, different from every side: the surface point in a direction.
fn surface(d: &Vector3<f64>) -> Point3<f64> {
    let bumps = 0.05 * (5.0 * d.x + 1.0).sin() * (4.0 * d.y).cos()
        + 0.04 * (7.0 * d.z - 2.0 * d.x).sin()
        + 0.05 * (3.0 * d.y + 2.0).sin();
    Point3::from(d.component_mul(&Vector3::new(0.11, 0.15, 0.12)) * (1.0 + bumps))
}

/// Distance of a point from the surface along its direction from the middle, metres, times the cosine
/// of how much the surface is tilted there (nearly 1).
fn off(p: &Point3<f64>) -> f64 {
    // The direction in the ellipsoid's own coordinates whose surface point is on the ray through p.
    let d = p.coords.component_div(&Vector3::new(0.11, 0.15, 0.12)).normalize();
    p.coords.norm() - surface(&d).coords.norm()
}

struct Noise(u64);

impl Noise {
    fn normal(&mut self) -> f64 {
        let mut uniform = || {
            self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (self.0 >> 33) as f64 / f64::from(1_u32 << 31)
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    }
}

/// Maps the object's frame to the sensor's when it has turned by `view` steps: 0.9 m away.
fn sensor_from_object(view: usize) -> Isometry3<f64> {
    let turn = std::f64::consts::TAU * view as f64 / VIEWS as f64;
    let axis = Vector3::new(0.05, 1.0, -0.03).normalize();
    Isometry3::translation(0.01, -0.02, 0.9)
        * UnitQuaternion::from_scaled_axis(axis * turn)
        * Isometry3::translation(0.004, 0.0, -0.003)
}

/// What the sensor sees of it, with noise and a few strays.
fn cloud(view: usize, sigma_m: f64) -> PointCloud {
    let mut noise = Noise(view as u64 + 1);
    let pose = sensor_from_object(view);
    let mut cloud = PointCloud::default();
    let count = 30_000;
    for k in 0..count {
        let z = 1.0 - 2.0 * (f64::from(k) + 0.5) / f64::from(count);
        let turn = f64::from(k) * 2.399_963_229_728_653 + view as f64;
        let r = (1.0 - z * z).sqrt();
        let d = Vector3::new(r * turn.cos(), r * turn.sin(), z);
        let at = |d: Vector3<f64>| surface(&d.normalize());
        let p = at(d);
        let (e, f) =
            (at(d + Vector3::new(1e-5, 0.0, 2e-5)), at(d + Vector3::new(0.0, 1e-5, -2e-5)));
        let normal = (e - p).cross(&(f - p)).normalize();
        let normal = if normal.dot(&p.coords) < 0.0 { -normal } else { normal };
        let (q, n) = (pose * p, pose.rotation * normal);
        if n.dot(&q.coords.normalize()) > -0.25 {
            continue;
        }
        let stray = if k % 200 == 0 { 0.02 } else { 0.0 };
        let along = q.coords.normalize() * (sigma_m * noise.normal() - stray);
        cloud.points_left_m.push((q + along).cast());
        cloud.zncc.push(0.98);
        cloud.intensity.push(200);
    }
    cloud
}

fn views(sigma_m: f64) -> Vec<View> {
    (0..VIEWS).map(|k| View::new(format!("view {k}"), &cloud(k, sigma_m)).unwrap()).collect()
}

fn rms_off_m(model: &Model) -> f64 {
    let object_from_first = sensor_from_object(0).inverse();
    let squares: f64 =
        model.points.iter().map(|p| off(&(object_from_first * p.point_m)).powi(2)).sum();
    (squares / model.points.len() as f64).sqrt()
}

fn params(start: Start) -> FuseParams {
    FuseParams { start, cell_m: 2e-3, icp_cell_m: 4e-3, ..FuseParams::default() }
}

#[test]
fn a_turn_is_fused_and_its_loop_closed() {
    let sigma_m = 5e-5;
    let views = views(sigma_m);
    let step_rad = std::f64::consts::TAU / VIEWS as f64;
    let start = Start::Turntable { step_rad, axis: None };
    let model = fuse(&views, &params(start), &mut |_| ()).unwrap();
    // All sides are there, in the right place, quieter than a single view, without the strays.
    let object_from_first = sensor_from_object(0).inverse();
    let back = model.points.iter().filter(|p| (object_from_first * p.point_m).z > 0.05).count();
    assert!(back > 500, "{back} points on the far side");
    let rms_m = rms_off_m(&model);
    assert!(rms_m < sigma_m, "RMS {rms_m} m");
    assert!(model.loop_closed_mm < 0.1, "{:#?}", model.pairs);
    assert!(model.loop_open_mm.is_some_and(|open| open < 0.1), "{:?} mm", model.loop_open_mm);
    for (k, pose) in model.first_from_view.iter().enumerate() {
        let truth = sensor_from_object(0) * sensor_from_object(k).inverse();
        let middle = sensor_from_object(k) * Point3::origin();
        let error_m = (pose * middle - truth * middle).norm();
        assert!(error_m < 1e-4, "view {k} is off by {error_m} m");
    }
    // The E57 file is read back by its own library's reader with as many points.
    let mut bytes = Vec::new();
    model::write_e57(&mut bytes, &model).unwrap();
    let mut file = e57::E57Reader::new(std::io::Cursor::new(bytes)).unwrap();
    let clouds = file.pointclouds();
    assert_eq!(clouds.len(), 1);
    let read: Vec<_> = file.pointcloud_simple(&clouds[0]).unwrap().map(Result::unwrap).collect();
    assert_eq!(read.len(), model.points.len());
    let first = model.points[0].point_m.cast::<f32>();
    let e57::CartesianCoordinate::Valid { x, y, z } = read[0].cartesian else { panic!() };
    assert_eq!([x as f32, y as f32, z as f32], [first.x, first.y, first.z]);
    assert!((read[0].intensity.unwrap() - 200.0 / 255.0).abs() < 0.01);
}

#[test]
fn views_that_cannot_be_fused_are_named() {
    let one = View::new("a", &cloud(0, 1e-5)).unwrap();
    let error = fuse(std::slice::from_ref(&one), &params(Start::Given), &mut |_| ()).unwrap_err();
    assert_eq!(error, FuseError::Views { got: 1 });
    // The same view far away: nothing overlaps.
    let mut far = cloud(0, 1e-5);
    far.points_left_m.iter_mut().for_each(|p| p.z += 1.0);
    let far = View::new("far", &far).unwrap();
    let error = fuse(&[one.clone(), far], &params(Start::Given), &mut |_| ()).unwrap_err();
    assert!(matches!(&error, FuseError::Apart { name, .. } if name == "far"), "{error}");
    let cell_m = 1.0;
    let wrong = FuseParams { cell_m, ..params(Start::Given) };
    let error = fuse(&[one.clone(), one], &wrong, &mut |_| ()).unwrap_err();
    assert!(matches!(error, FuseError::Parameter { name: "cell", .. }), "{error}");
    assert!(View::new("none", &PointCloud::default()).is_none());
}
