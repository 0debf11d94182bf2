//! What several tests share: a rig and its optics, written out again in f64 from the definitions.
#![allow(dead_code)]

use nalgebra::{Isometry3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use stspp::{CameraIntrinsics, StereoCalibration};

/// Two distorted cameras, 0.4 m apart, toed in by 10 degrees each, with small errors of every kind.
pub fn rig() -> StereoCalibration {
    let toe_in = 10_f64.to_radians();
    let left_from_rig = Rotation3::from_euler_angles(0.004, -toe_in, 0.006);
    let right_from_rig = Rotation3::from_euler_angles(-0.003, toe_in + 0.002, -0.005);
    let right_in_rig_m = Vector3::new(0.4, 0.0015, -0.002);
    let right_from_left = right_from_rig * left_from_rig.inverse();
    let translation_m = -(right_from_rig * right_in_rig_m);
    StereoCalibration {
        left: CameraIntrinsics {
            focal_px: [1861.3, 1859.2],
            principal_px: [641.7, 509.3],
            radtan: [-0.092, 0.071, 0.0004, -0.0003],
            resolution_px: [1280, 1024],
        },
        right: CameraIntrinsics {
            focal_px: [1856.8, 1857.9],
            principal_px: [636.1, 516.2],
            radtan: [-0.087, 0.064, -0.0002, 0.0005],
            resolution_px: [1280, 1024],
        },
        right_from_left: Isometry3::from_parts(
            Translation3::from(translation_m),
            UnitQuaternion::from_rotation_matrix(&right_from_left),
        ),
        temperature_c: None,
        date: None,
    }
}

/// Brown's distortion, straight from its definition.
pub fn distorted(k: [f64; 4], x: f64, y: f64) -> [f64; 2] {
    let [k1, k2, p1, p2] = k;
    let r2 = x * x + y * y;
    let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
    [
        x * radial + (2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)),
        y * radial + (p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y),
    ]
}

/// Raw pixel of a point in the camera's frame.
pub fn raw_pixel(camera: &CameraIntrinsics, p: Point3<f64>) -> [f64; 2] {
    let [x, y] = distorted(camera.radtan, p.x / p.z, p.y / p.z);
    [
        camera.focal_px[0] * x + camera.principal_px[0],
        camera.focal_px[1] * y + camera.principal_px[1],
    ]
}

/// Inverse of the distortion by plain fixed-point iteration, run until nothing changes.
pub fn undistorted(camera: &CameraIntrinsics, pixel: [f64; 2]) -> [f64; 2] {
    let d = [
        (pixel[0] - camera.principal_px[0]) / camera.focal_px[0],
        (pixel[1] - camera.principal_px[1]) / camera.focal_px[1],
    ];
    let mut p = d;
    for _ in 0..500 {
        let e = distorted(camera.radtan, p[0], p[1]);
        let next = [p[0] + d[0] - e[0], p[1] + d[1] - e[1]];
        if next == p {
            break;
        }
        p = next;
    }
    p
}

/// Whether a pixel is inside an image.
pub fn inside(camera: &CameraIntrinsics, pixel: [f64; 2]) -> bool {
    let [w, h] = camera.resolution_px.map(|s| (s - 1) as f64);
    (0.0..=w).contains(&pixel[0]) && (0.0..=h).contains(&pixel[1])
}

/// A small deterministic generator (SplitMix64), uniform in 0..1.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (((z ^ (z >> 31)) >> 11) as f64) / (1_u64 << 53) as f64
    }

    pub fn range(&mut self, min: f64, max: f64) -> f64 {
        min + (max - min) * self.next()
    }
}

/// A temporary folder that is removed at the end.
pub struct Folder(std::path::PathBuf);

impl Folder {
    pub fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("stspp-test-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub fn path(&self, name: &str) -> std::path::PathBuf {
        self.0.join(name)
    }

    /// Names of everything in it, hidden ones too, sorted.
    pub fn names(&self) -> Vec<String> {
        let entries = std::fs::read_dir(&self.0).unwrap();
        let mut names: Vec<_> =
            entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
