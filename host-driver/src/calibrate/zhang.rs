//! A first estimate of both cameras and of all poses, from homographies (Zhang, "A flexible new
//! technique for camera calibration", 2000), with the principal point in the image's middle and no
//! distortion. The bundle adjustment starts from it.

use nalgebra::{
    Isometry3, Matrix2, Matrix3, Point2, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3,
};

use super::Board;
use super::homography;
use super::observations::{Observations, Sighting};
use crate::CameraIntrinsics;

/// Fewest points of a view from which a pose is estimated.
pub const POINTS_MIN: usize = 8;

/// Focal length, in parts of the image's width, when the views do not determine it: a lens of 40
/// degrees.
const FOCAL_FALLBACK: f64 = 1.37;

/// First estimate of a camera: intrinsics and, for each view that it saw well enough, the pose.
#[derive(Debug, Clone)]
pub struct Start {
    /// Intrinsics.
    pub camera: CameraIntrinsics,
    /// Pose of the board in this camera's frame, view by view.
    pub camera_from_board: Vec<Option<Isometry3<f64>>>,
}

/// Estimates one camera from its sightings; `side` is 0 for the left camera.
pub fn estimate(observations: &Observations, side: usize) -> Start {
    let [width, height] = observations.resolution_px;
    let middle = Vector2::new((width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0);
    let homographies: Vec<Option<Matrix3<f64>>> = observations
        .views
        .iter()
        .map(|view| of_sighting(&observations.board, view.side(side), middle))
        .collect();
    let focal = focal(homographies.iter().flatten());
    let plausible = focal.filter(|f| {
        f.iter().all(|f| (0.3..20.0).contains(&(f / width as f64)))
            && (0.8..1.25).contains(&(f.x / f.y))
    });
    let focal = plausible.unwrap_or_else(|| Vector2::repeat(FOCAL_FALLBACK * width as f64));
    let camera = CameraIntrinsics {
        focal_px: focal.into(),
        principal_px: middle.into(),
        radtan: [0.0; 4],
        resolution_px: observations.resolution_px,
    };
    let camera_from_board =
        homographies.iter().map(|h| h.as_ref().and_then(|h| pose(h, focal))).collect();
    Start { camera, camera_from_board }
}

/// Homography from the board's plane (metres) to pixels relative to the image's middle.
fn of_sighting(board: &Board, sighting: &[Sighting], middle: Vector2<f64>) -> Option<Matrix3<f64>> {
    if sighting.len() < POINTS_MIN {
        return None;
    }
    let from: Vec<_> = sighting.iter().map(|s| board.point_m(s.point)).collect();
    let to: Vec<_> = sighting.iter().map(|s| Point2::from(s.pixel - middle)).collect();
    homography::fit(&from, &to)
}

/// Focal lengths from the conditions that the plane's axes are perpendicular and equally long: two
/// linear equations in 1/fu^2 and 1/fv^2 for each view.
fn focal<'a>(homographies: impl Iterator<Item = &'a Matrix3<f64>>) -> Option<Vector2<f64>> {
    let mut normal = Matrix2::zeros();
    let mut right = Vector2::zeros();
    for h in homographies {
        let (a, b) = (h.column(0), h.column(1));
        // All equations of a view scale with the homography: norms make views comparable.
        let scale = 1.0 / (a.norm() * b.norm());
        let perpendicular = Vector2::new(a.x * b.x, a.y * b.y);
        let lengths = Vector2::new(a.x * a.x - b.x * b.x, a.y * a.y - b.y * b.y);
        for (row, value) in [(perpendicular, -a.z * b.z), (lengths, b.z * b.z - a.z * a.z)] {
            normal += row * row.transpose() * scale * scale;
            right += row * value * scale * scale;
        }
    }
    let inverse_squares = normal.try_inverse()? * right;
    (inverse_squares.min() > 0.0).then(|| inverse_squares.map(|v| 1.0 / v.sqrt()))
}

/// Pose of the plane from its homography and the focal lengths.
fn pose(homography: &Matrix3<f64>, focal: Vector2<f64>) -> Option<Isometry3<f64>> {
    let calibrated = Matrix3::from_diagonal(&Vector3::new(1.0 / focal.x, 1.0 / focal.y, 1.0));
    let mut m = calibrated * homography;
    let scale = (m.column(0).norm() * m.column(1).norm()).sqrt();
    if !(scale > 0.0 && scale.is_finite()) {
        return None;
    }
    m /= scale;
    // The board is in front of the camera.
    if m[(2, 2)] < 0.0 {
        m = -m;
    }
    let (x, y) = (m.column(0).into_owned(), m.column(1).into_owned());
    let svd = Matrix3::from_columns(&[x, y, x.cross(&y)]).svd(true, true);
    let rotation = Rotation3::from_matrix_unchecked(svd.u? * svd.v_t?);
    Some(Isometry3::from_parts(
        Translation3::from(m.column(2).into_owned()),
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ideal_camera_is_found_exactly() {
        let focal = Vector2::new(1860.0, 1840.0);
        let k = Matrix3::from_diagonal(&Vector3::new(focal.x, focal.y, 1.0));
        let poses = [
            Isometry3::new(Vector3::new(0.05, -0.1, 1.2), Vector3::new(0.4, 0.1, 0.0)),
            Isometry3::new(Vector3::new(-0.1, 0.0, 0.9), Vector3::new(-0.1, 0.5, 0.2)),
            Isometry3::new(Vector3::new(0.0, 0.1, 1.7), Vector3::new(0.3, -0.4, 0.1)),
        ];
        let homographies: Vec<_> = poses
            .iter()
            .map(|pose| {
                let r = pose.rotation.to_rotation_matrix();
                let r = r.matrix();
                let t = pose.translation.vector;
                -2.5 * k * Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), t])
            })
            .collect();
        let found = super::focal(homographies.iter()).unwrap();
        assert!((found - focal).norm() < 1e-6, "{found}");
        for (h, truth) in homographies.iter().zip(&poses) {
            let found = pose(h, focal).unwrap();
            assert!((found.to_homogeneous() - truth.to_homogeneous()).norm() < 1e-9);
        }
    }
}
