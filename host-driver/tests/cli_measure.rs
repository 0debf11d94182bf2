//! `stspp measure` and `stspp fuse` as a user meets them: results as JSON, refusals that say what to do,
//! nothing left behind.

mod common;

use std::path::Path;
use std::process::{Command, Output};

use common::{Folder, Random};
use nalgebra::{Point3, Vector3};
use serde_json::Value;
use stspp::PointCloud;

fn stspp(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_stspp")).args(arguments).output().unwrap()
}

fn json(arguments: &[&str]) -> Value {
    let output = stspp(&[arguments, &["--json"]].concat());
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {error}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The one line of a failure; it has the given code.
fn refused(arguments: &[&str], code: i32) -> String {
    let output = stspp(arguments);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {error}");
    assert_eq!(error.lines().filter(|l| l.starts_with("error:")).count(), 1, "{error}");
    error
}

fn write(path: &Path, points: &[Point3<f64>]) -> String {
    let cloud = PointCloud {
        points_left_m: points.iter().map(|p| p.cast()).collect(),
        zncc: vec![1.0; points.len()],
        intensity: vec![128; points.len()],
        ..PointCloud::default()
    };
    cloud.write_ply(path).unwrap();
    path.to_str().unwrap().to_owned()
}

/// A wall at 1.2 m with two balls of 40 mm radius, 220 mm apart, before it.
fn scene(random: &mut Random) -> Vec<Point3<f64>> {
    let mut points: Vec<_> = (0..30_000)
        .map(|_| Point3::new(random.range(-0.3, 0.3), random.range(-0.25, 0.25), 1.2))
        .collect();
    for x in [-0.11, 0.11] {
        for _ in 0..4000 {
            let (z, turn) = (random.range(0.3, 1.0), random.range(0.0, std::f64::consts::TAU));
            let r = (1.0 - z * z).sqrt();
            let d = Vector3::new(r * turn.cos(), r * turn.sin(), -z);
            points.push(Point3::new(x, 0.0, 1.0) + d * 0.04);
        }
    }
    points
}

#[test]
fn planes_spheres_and_spacings_are_measured() {
    let folder = Folder::new("cli-measure");
    let cloud = write(&folder.path("cloud.ply"), &scene(&mut Random(3)));
    let plane = json(&["measure", "plane", &cloud]);
    // The folder of a result stands for its cloud.
    let result = cloud.strip_suffix("cloud.ply").unwrap();
    assert_eq!(json(&["measure", "plane", result]), plane);
    assert!(plane["rms_mm"].as_f64().unwrap() < 1e-3, "{plane}");
    assert!((plane["point_m"][2].as_f64().unwrap() - 1.2).abs() < 1e-6, "{plane}");
    let arguments = ["measure", "spheres", &cloud, "--diameter-mm", "80", "--spacing-mm", "219.9"];
    let spheres = json(&arguments);
    assert!((spheres["spacing_error_mm"].as_f64().unwrap() - 0.1).abs() < 1e-3, "{spheres}");
    let size = spheres["spheres"][0]["probing_size_mm"].as_f64().unwrap();
    assert!(size.abs() < 1e-3, "{spheres}");
    // A limit makes it an inspection.
    let error = refused(&[&arguments[..], &["--limit-mm", "0.05"]].concat(), 6);
    assert!(error.contains("0.05"), "{error}");
    let one = json(&["measure", "sphere", &cloud, "--box", "-0.2,-0.1,0.9,0,0.1,1.1"]);
    assert!((one["centre_m"][0].as_f64().unwrap() + 0.11).abs() < 1e-6, "{one}");
}

#[test]
fn a_cloud_is_compared_with_a_mesh_in_other_units() {
    let folder = Folder::new("cli-compare");
    let relief = |x: f64, y: f64| {
        let wave = 0.03 * (9.0 * x).sin() * (7.0 * y).cos() + 0.02 * (21.0 * x + 13.0 * y).sin();
        Point3::new(x, y, 1.0 + wave)
    };
    // The mesh as ASCII PLY in millimetres, two triangles a cell.
    let n = 120;
    let at = |k: usize| 0.4 * (k as f64 / (n - 1) as f64 - 0.5);
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        n * n,
        (n - 1) * (n - 1)
    );
    for k in 0..n * n {
        let p = relief(at(k % n), at(k / n)) * 1000.0;
        text += &format!("{} {} {}\n", p.x, p.y, p.z);
    }
    for y in 0..n - 1 {
        for x in 0..n - 1 {
            let a = y * n + x;
            text += &format!("4 {a} {} {} {}\n", a + 1, a + n + 1, a + n);
        }
    }
    let mesh = folder.path("mesh.ply");
    std::fs::write(&mesh, text).unwrap();
    let mesh = mesh.to_str().unwrap();
    let mut random = Random(4);
    // 0.1 mm off to the sensor's side.
    let points: Vec<_> = (0..20_000)
        .map(|_| relief(random.range(-0.19, 0.19), random.range(-0.19, 0.19)))
        .map(|p| p - Vector3::z() * 1e-4)
        .collect();
    let cloud = write(&folder.path("cloud.ply"), &points);
    let out = folder.path("out");
    let out = out.to_str().unwrap();
    let common = ["measure", "compare", &cloud, "--to", mesh, "--to-scale", "0.001"];
    let left = json(&[&common[..], &["--align", "none", "--out", out]].concat());
    let mean = left["deviation"]["mean_mm"].as_f64().unwrap();
    assert!((0.08..0.1).contains(&mean), "{left}");
    let names: Vec<_> = ["deviation.ply", "deviation.png", "report.json"].into();
    let mut written: Vec<_> =
        std::fs::read_dir(out).unwrap().map(|e| e.unwrap().file_name()).collect();
    written.sort();
    assert_eq!(written, names);
    let aligned = json(&common);
    // Chords of the mesh are up to 0.04 mm off the relief.
    assert!(aligned["deviation"]["rms_mm"].as_f64().unwrap() < 0.02, "{aligned}");
    // Without the scale the mesh is 400 m large.
    let error = refused(&["measure", "compare", &cloud, "--to", mesh], 3);
    assert!(error.contains("--to-scale 0.001"), "{error}");
    // Moved by a metre it is nowhere near, and says so without leaving anything.
    let far: Vec<_> = points.iter().map(|p| p + Vector3::x()).collect();
    let far = write(&folder.path("far.ply"), &far);
    let nowhere = folder.path("nowhere");
    let to = ["--to", mesh, "--to-scale", "0.001", "--out", nowhere.to_str().unwrap()];
    let error = refused(&[&["measure", "compare", &far][..], &to].concat(), 3);
    assert!(error.contains("overlap") && error.contains("--align"), "{error}");
    assert!(!nowhere.exists());
}

#[test]
fn what_cannot_be_measured_is_refused_with_what_to_do() {
    let folder = Folder::new("cli-refused");
    let points = scene(&mut Random(5));
    let cloud = write(&folder.path("a.ply"), &points);
    let millimetres: Vec<_> = points.iter().map(|p| p * 1000.0).collect();
    let millimetres = write(&folder.path("mm.ply"), &millimetres);
    let nan = write(&folder.path("nan.ply"), &vec![Point3::new(f64::NAN, 0.0, 0.0); 40]);
    let empty = write(&folder.path("empty.ply"), &[]);
    let wall: Vec<_> = points.iter().filter(|p| p.z > 1.19).copied().collect();
    let wall = write(&folder.path("wall.ply"), &wall);
    let moved = |by: Vector3<f64>| points.iter().map(|p| p + by).collect::<Vec<_>>();
    let away = write(&folder.path("away.ply"), &moved(Vector3::new(0.0, 0.0, 3.0)));
    let tiny: Vec<_> = points.iter().map(|p| p * 1e-3).collect();
    let tiny = write(&folder.path("tiny.ply"), &tiny);
    let line: Vec<_> = (0..500).map(|k| Point3::new(f64::from(k) * 1e-3, 0.0, 1.0)).collect();
    let line = write(&folder.path("line.ply"), &line);
    let flat = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 1\nvertex 0 0 1\nvertex 0 0 1\n\
                endloop\nendfacet\nendsolid a\n";
    std::fs::write(folder.path("flat.stl"), flat).unwrap();
    for (arguments, code, says) in [
        (vec!["measure", "plane", &millimetres], 3, "--scale 0.001"),
        (vec!["measure", "plane", &nan], 3, "no usable points"),
        (vec!["measure", "plane", &empty], 3, "no usable points"),
        (vec!["measure", "plane", "missing.ply"], 3, "missing.ply"),
        (vec!["measure", "plane", "nonsense:"], 3, "recording folder"),
        (vec!["measure", "sphere", &wall], 3, "--box"),
        (vec!["measure", "plane", &cloud, "--box", "1,2"], 2, "two opposite corners"),
        (vec!["measure", "plane", &cloud, "--box", "5,5,5,6,6,6"], 3, "spans x"),
        (vec!["measure", "plane", &cloud, "--rect", "1,2,3,4"], 3, "give a box"),
        (vec!["measure", "plane", &cloud, "--outliers", "2"], 2, "0 to 0.8"),
        (vec!["measure", "cylinder", &wall], 3, "on a plane"),
        (vec!["measure", "circle", &cloud, "--near", "1", "--radius-mm", "5"], 2, "x,y,z"),
        (vec!["fuse", &cloud, &millimetres, "--out", "gone"], 3, "--scale"),
        (vec!["fuse", &cloud, "--out", "gone"], 2, ""),
        (vec!["fuse", &cloud, &nan, "--out", "gone"], 3, "none of them finite"),
        (vec!["fuse", &cloud, &line, "--out", "gone"], 3, "line.ply: its points make no surface"),
        (vec!["fuse", &wall, &wall, "--out", "gone", "--start", "given"], 3, "slide"),
        (
            vec!["fuse", &cloud, &away, "--out", "gone", "--start", "given"],
            3,
            "away.ply is connected",
        ),
        (vec!["fuse", &cloud, &cloud, "--out", "gone", "--scale", "nan"], 2, "metres per unit"),
        (vec!["measure", "plane", &tiny], 3, "too small"),
        (vec!["measure", "plane", &line], 3, "on a line"),
        (vec!["measure", "compare", &cloud, "--to", &away], 3, "do not overlap"),
        (vec!["measure", "compare", &wall, "--to", &wall], 3, "slide"),
        (vec!["measure", "compare", &cloud, "--to", "flat.stl"], 3, "flat.stl"),
        (vec!["fuse", &cloud, &wall, "--out", "gone", "--axis", "1"], 2, "turntable"),
    ] {
        let output = Command::new(env!("CARGO_BIN_EXE_stspp"))
            .args(&arguments)
            .current_dir(folder.path("."))
            .output()
            .unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {error}");
        assert!(error.contains(says), "{arguments:?}: {error}");
    }
    assert!(!folder.path("gone").exists());
    let given = ["a.ply", "away.ply", "empty.ply", "flat.stl", "line.ply", "mm.ply", "nan.ply"];
    assert_eq!(folder.names(), [&given[..], &["tiny.ply", "wall.ply"]].concat());
}
