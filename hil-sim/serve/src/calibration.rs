//! The simulated cameras' calibration as Kalibr's camchain.yaml.

use std::fmt::Write as _;

use stspp_hil_sim::world::{CameraModel, SensorModel};

/// The exact calibration of a sensor model.
pub fn to_text(model: &SensorModel) -> String {
    let mut text = String::from("# Simulated stspp sensor; Kalibr's format, lengths in metres.\n");
    camera(&mut text, "cam0", &model.left);
    camera(&mut text, "cam1", &model.right);
    text += "  T_cn_cnm1:\n";
    for row in model.right_from_left.to_homogeneous().row_iter() {
        // `{:?}` prints the shortest digits that read back as the same number.
        let _ = writeln!(text, "  - [{:?}, {:?}, {:?}, {:?}]", row[0], row[1], row[2], row[3]);
    }
    text
}

fn camera(text: &mut String, name: &str, camera: &CameraModel) {
    let ([fu, fv], [pu, pv]) = (camera.focal_px, camera.principal_px);
    let [k1, k2, p1, p2] = camera.radtan;
    let (width, height) = (camera.width, camera.height);
    let _ = write!(
        text,
        "{name}:\n  camera_model: pinhole\n  intrinsics: [{fu:?}, {fv:?}, {pu:?}, {pv:?}]\n  \
         distortion_model: radtan\n  distortion_coeffs: [{k1:?}, {k2:?}, {p1:?}, {p2:?}]\n  \
         resolution: [{width}, {height}]\n"
    );
}
