//! Calibrations for other programs, read back by the importers and by the projection equations.

mod common;

use common::{Folder, rig};
use nalgebra::{Point3, Vector3};
use stspp::StereoCalibration;
use stspp::calibration::export::{opencv_text, ros_texts};
use stspp::calibration::opencv::{self, OpenCvImport};
use stspp::calibration::ros;

fn assert_same(a: &StereoCalibration, b: &StereoCalibration) {
    assert_eq!(a.left, b.left);
    assert_eq!(a.right, b.right);
    let apart = a.right_from_left.inverse() * b.right_from_left;
    assert!(apart.translation.vector.norm() < 1e-12 && apart.rotation.angle() < 1e-9, "{apart}");
}

#[test]
fn exported_files_import_again() {
    let folder = Folder::new("calibration-export");
    let calibration = rig();
    let file = folder.path("stereo.yaml");
    std::fs::write(&file, opencv_text(&calibration)).unwrap();
    let back = opencv::import(&[&file], &OpenCvImport::default()).unwrap();
    assert_same(&calibration, &back);
    let [left, right] = ros_texts(&calibration).unwrap();
    let files = [folder.path("left.yaml"), folder.path("right.yaml")];
    std::fs::write(&files[0], left).unwrap();
    std::fs::write(&files[1], right).unwrap();
    assert_same(&calibration, &ros::import(&files[0], &files[1]).unwrap());
}

/// Numbers after `data:` under a name, by hand.
fn data(text: &str, name: &str) -> Vec<f64> {
    let after = text.split(&format!("{name}:\n")).nth(1).unwrap();
    let list = after.split("data: [").nth(1).unwrap().split(']').next().unwrap();
    list.split(',').map(|v| v.trim().parse().unwrap()).collect()
}

/// What ROS does with the files: P (R X) is where a point is on the rectified image, on one row.
#[test]
fn a_point_is_on_the_same_row_of_both_rectified_images() {
    let calibration = rig();
    let [left, right] = ros_texts(&calibration).unwrap();
    let seen = |text: &str, in_camera: Vector3<f64>, tx: f64| {
        let (r, p) = (data(text, "rectification_matrix"), data(text, "projection_matrix"));
        let q = nalgebra::Matrix3::from_row_slice(&r) * in_camera;
        assert_eq!(p[7], 0.0);
        assert!((p[3] / p[0] - tx).abs() < 1e-9, "{p:?}");
        (p[0] * q.x / q.z + p[2], p[5] * q.y / q.z + p[6])
    };
    let baseline_m = calibration.baseline_m();
    for point in [Point3::new(0.2, 0.1, 1.2), Point3::new(0.3, -0.15, 1.9)] {
        let in_right = calibration.right_from_left * point;
        let (xl, yl) = seen(&left, point.coords, 0.0);
        let (xr, yr) = seen(&right, in_right.coords, -baseline_m);
        assert!((yl - yr).abs() < 1e-6, "{yl} {yr}");
        // Depth by the difference of columns and of principal points.
        let (cl, cr) = (data(&left, "projection_matrix")[2], data(&right, "projection_matrix")[2]);
        let f = data(&left, "projection_matrix")[0];
        let z = f * baseline_m / ((xl - cl) - (xr - cr));
        let r = data(&left, "rectification_matrix");
        let expected = (nalgebra::Matrix3::from_row_slice(&r) * point.coords).z;
        assert!((z - expected).abs() < 1e-9, "{z} {expected}");
    }
}
