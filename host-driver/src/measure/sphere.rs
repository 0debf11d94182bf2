//! The sphere of least squared distances.

use nalgebra::{Matrix4, Point3, Vector3, Vector4};

use super::robust::Shape;
use super::{FitError, rms};

/// Gauss-Newton steps at most; a handful suffice.
const STEPS_MAX: usize = 50;

/// A fitted sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SphereFit {
    /// Centre.
    pub centre_m: Point3<f64>,
    /// Radius.
    pub radius_m: f64,
    /// RMS of the points' distances from the surface.
    pub rms_m: f64,
    /// Points used.
    pub points: usize,
}

impl SphereFit {
    /// Signed distance of a point from the surface, positive outside.
    pub fn distance_m(&self, point_m: &Point3<f64>) -> f64 {
        (point_m - self.centre_m).norm() - self.radius_m
    }
}

/// Fits a sphere to the finite points by their distances from the surface (not the algebraic residual,
/// which shrinks the sphere): Gauss-Newton from the algebraic solution.
///
/// # Errors
/// Fewer than four points, or points that are all on a plane.
pub fn fit(points_m: &[Point3<f64>]) -> Result<SphereFit, FitError> {
    fit_with(points_m, None)
}

/// Fits the centre of a sphere of known radius.
///
/// # Errors
/// As [`fit`].
pub fn fit_centre(points_m: &[Point3<f64>], radius_m: f64) -> Result<SphereFit, FitError> {
    fit_with(points_m, Some(radius_m))
}

fn fit_with(points_m: &[Point3<f64>], radius_m: Option<f64>) -> Result<SphereFit, FitError> {
    let finite = || points_m.iter().filter(|p| p.coords.iter().all(|v| v.is_finite()));
    let count = finite().count();
    if count < 4 {
        return Err(FitError::TooFewPoints { shape: "sphere", needed: 4, got: count });
    }
    let flat = FitError::Degenerate {
        shape: "sphere",
        reason: "the points are all on a plane or on no sphere",
    };
    let n = count as f64;
    let mean = finite().fold(Vector3::zeros(), |sum, p| sum + p.coords) / n;
    // Scaled to unit spread, so that the equations are well conditioned at any size.
    let spread = (finite().map(|p| (p.coords - mean).norm_squared()).sum::<f64>() / n).sqrt();
    if spread <= 0.0 {
        return Err(flat);
    }
    let unit = |p: &Point3<f64>| (p.coords - mean) / spread;
    let (mut a, mut b) = (Matrix4::zeros(), Vector4::zeros());
    for p in finite() {
        let q = unit(p);
        let row = Vector4::new(q.x, q.y, q.z, 1.0);
        a += row * row.transpose();
        b += row * q.norm_squared();
    }
    let smallest = (a / n).symmetric_eigenvalues().min();
    // Sagitta of the cap below 1e-6 of its width: a plane to any camera.
    if smallest < 1e-12 {
        return Err(flat);
    }
    let solution = a.cholesky().ok_or_else(|| flat.clone())?.solve(&b);
    let mut centre = solution.xyz() / 2.0;
    let mut radius = match radius_m {
        Some(radius_m) => radius_m / spread,
        None => (solution.w + centre.norm_squared()).max(0.0).sqrt(),
    };
    for _ in 0..STEPS_MAX {
        let (mut h, mut g) = (Matrix4::zeros(), Vector4::zeros());
        for p in finite() {
            let d = unit(p) - centre;
            let distance = d.norm().max(1e-12);
            let direction = d / distance;
            let along_radius = if radius_m.is_some() { 0.0 } else { 1.0 };
            let row = Vector4::new(direction.x, direction.y, direction.z, along_radius);
            h += row * row.transpose();
            g += row * (distance - radius);
        }
        if radius_m.is_some() {
            h[(3, 3)] = 1.0;
        }
        let step = h.cholesky().ok_or_else(|| flat.clone())?.solve(&g);
        centre += step.xyz();
        radius += step.w;
        if step.norm() < 1e-13 * (1.0 + radius) {
            break;
        }
    }
    if !(centre.norm() + radius).is_finite() || radius <= 0.0 || radius > 1e4 {
        return Err(flat);
    }
    let mut sphere = SphereFit {
        centre_m: (centre * spread + mean).into(),
        radius_m: radius * spread,
        rms_m: 0.0,
        points: count,
    };
    sphere.rms_m = rms(finite().map(|p| sphere.distance_m(p)));
    Ok(sphere)
}

impl Shape for SphereFit {
    const NAME: &'static str = "sphere";
    const SAMPLE: usize = 4;

    fn fit(points_m: &[Point3<f64>]) -> Result<Self, FitError> {
        fit(points_m)
    }

    fn distance_m(&self, point_m: &Point3<f64>) -> f64 {
        SphereFit::distance_m(self, point_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cap(radius: f64, opening: f64, noise: f64) -> Vec<Point3<f64>> {
        (0..2000)
            .map(|k| {
                // A spiral over the cap; the noise is a pattern without order.
                let t = (f64::from(k) + 0.5) / 2000.0;
                let (polar, azimuth) = (opening * t.sqrt(), f64::from(k) * 2.399_963);
                let r = radius + noise * (f64::from(k) * 12.9898).sin() * 1.414;
                let (s, c) = polar.sin_cos();
                Point3::new(s * azimuth.cos() * r, s * azimuth.sin() * r, 0.95 - c * r)
            })
            .collect()
    }

    #[test]
    fn recovers_a_cap() {
        let sphere = fit(&cap(0.075, 1.0, 0.0)).unwrap();
        assert!((sphere.radius_m - 0.075).abs() < 1e-12);
        assert!((sphere.centre_m - Point3::new(0.0, 0.0, 0.95)).norm() < 1e-12);
        let noisy = fit(&cap(0.075, 1.0, 1e-4)).unwrap();
        assert!((noisy.radius_m - 0.075).abs() < 3e-5);
        assert!((noisy.rms_m - 1e-4).abs() < 5e-6);
        let known = fit_centre(&cap(0.075, 1.0, 1e-4), 0.075).unwrap();
        assert!((known.centre_m - Point3::new(0.0, 0.0, 0.95)).norm() < 1e-5);
        assert_eq!(known.radius_m, 0.075);
    }

    #[test]
    fn rejects_planes() {
        let plane: Vec<_> =
            (0..100).map(|k| Point3::new(f64::from(k % 10), f64::from(k / 10), 1.0)).collect();
        assert!(matches!(fit(&plane), Err(FitError::Degenerate { .. })));
    }
}
