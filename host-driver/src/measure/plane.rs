//! The plane of least squared distances.

use nalgebra::{Matrix3, Point3, Vector3};

use super::robust::Shape;
use super::{FitError, rms};

/// A fitted plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneFit {
    /// Centroid of the points: on the plane.
    pub point_m: Point3<f64>,
    /// Unit normal, towards the sensor (z <= 0).
    pub normal: Vector3<f64>,
    /// RMS of the points' distances in metres.
    pub rms_m: f64,
    /// Points used.
    pub points: usize,
}

impl PlaneFit {
    /// Signed distance of a point, positive on the sensor's side.
    pub fn distance_m(&self, point_m: &Point3<f64>) -> f64 {
        (point_m - self.point_m).dot(&self.normal)
    }
}

/// Fits a plane to the finite points: centroid, and the direction of least variance.
///
/// # Errors
/// Fewer than three points, or points on a line.
pub fn fit(points_m: &[Point3<f64>]) -> Result<PlaneFit, FitError> {
    let finite = || points_m.iter().filter(|p| p.coords.iter().all(|v| v.is_finite()));
    let count = finite().count();
    if count < 3 {
        return Err(FitError::TooFewPoints { shape: "plane", needed: 3, got: count });
    }
    let centroid = finite().fold(Vector3::zeros(), |sum, p| sum + p.coords) / count as f64;
    let covariance = finite().fold(Matrix3::zeros(), |sum, p| {
        let d = p.coords - centroid;
        sum + d * d.transpose()
    }) / count as f64;
    let eigen = covariance.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let [least, middle, most] = order.map(|k| eigen.eigenvalues[k]);
    // A spread across the line below a ten-thousandth of that along it says nothing about a plane.
    if middle <= 1e-8 * most || middle <= 4.0 * least.max(0.0) {
        return Err(FitError::Degenerate {
            shape: "plane",
            reason: "the points are on a line or as thick as wide",
        });
    }
    let normal: Vector3<f64> = eigen.eigenvectors.column(order[0]).into_owned();
    let normal = if normal.z > 0.0 { -normal } else { normal };
    let mut plane = PlaneFit { point_m: centroid.into(), normal, rms_m: 0.0, points: count };
    plane.rms_m = rms(finite().map(|p| plane.distance_m(p)));
    Ok(plane)
}

impl Shape for PlaneFit {
    const NAME: &'static str = "plane";
    const SAMPLE: usize = 3;

    fn fit(points_m: &[Point3<f64>]) -> Result<Self, FitError> {
        fit(points_m)
    }

    fn distance_m(&self, point_m: &Point3<f64>) -> f64 {
        PlaneFit::distance_m(self, point_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recovers_a_plane_and_its_noise() {
        // A deterministic pattern of +-1 mm off z = 1 + 0.2 x - 0.1 y, along the normal.
        let normal = Vector3::new(0.2, -0.1, -1.0).normalize();
        let points: Vec<_> = (0..400)
            .map(|k| {
                let (x, y) = (f64::from(k % 20) * 0.01, f64::from(k / 20) * 0.01);
                let sign = if (k % 20 + k / 20) % 2 == 0 { 1e-3 } else { -1e-3 };
                Point3::new(x, y, 1.0 + 0.2 * x - 0.1 * y) + normal * sign
            })
            .collect();
        let plane = fit(&points).unwrap();
        assert!((plane.normal - normal).norm() < 1e-3);
        assert!((plane.rms_m - 1e-3).abs() < 1e-6);
    }

    #[test]
    fn rejects_lines_and_too_few() {
        let line: Vec<_> = (0..10).map(|k| Point3::new(f64::from(k), 0.0, 1.0)).collect();
        assert!(matches!(fit(&line), Err(FitError::Degenerate { .. })));
        let nan = [Point3::new(f64::NAN, 0.0, 0.0); 5];
        assert!(matches!(fit(&nan), Err(FitError::TooFewPoints { got: 0, .. })));
    }
}
