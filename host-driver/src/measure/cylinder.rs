//! The cylinder of least squared distances.

use nalgebra::{Matrix3, Matrix5, Point3, UnitQuaternion, Vector3, Vector5};
use rayon::prelude::*;

use super::robust::{self, Shape, Trim, Trimmed};
use super::{FitError, rms};

/// Gauss-Newton steps at most.
const STEPS_MAX: usize = 60;

/// A fitted cylinder, infinitely long.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CylinderFit {
    /// The point of the axis closest to the points' centroid.
    pub point_m: Point3<f64>,
    /// Unit direction of the axis.
    pub axis: Vector3<f64>,
    /// Radius.
    pub radius_m: f64,
}

impl CylinderFit {
    /// Signed distance of a point from the surface, positive outside.
    pub fn distance_m(&self, point_m: &Point3<f64>) -> f64 {
        (point_m - self.point_m).cross(&self.axis).norm() - self.radius_m
    }
}

const NOT_ROUND: FitError = FitError::Degenerate {
    shape: "cylinder",
    reason: "the points are all on a plane, on a line or on no cylinder",
};

/// Directions that are tried as the axis before refining.
const DIRECTIONS: usize = 400;

/// Fits a cylinder to the points that agree on one.
///
/// # Errors
/// Too few points, or points that are on no cylinder.
pub fn fit(points_m: &[Point3<f64>], trim: &Trim) -> Result<Trimmed<CylinderFit>, FitError> {
    let fit: Trimmed<CylinderFit> = robust::fit(points_m, trim)?;
    let used: Vec<_> =
        points_m.iter().zip(&fit.used).filter(|(_, used)| **used).map(|(p, _)| *p).collect();
    // Points of a plane lie on many cylinders badly, and on the plane well.
    match super::plane::fit(&used) {
        Ok(plane) if plane.rms_m <= fit.rms_m => Err(NOT_ROUND),
        _ => Ok(fit),
    }
}

impl Shape for CylinderFit {
    const NAME: &'static str = "cylinder";
    // More than the five that determine one: a start by directions needs the redundance.
    const SAMPLE: usize = 8;

    fn fit(points_m: &[Point3<f64>]) -> Result<Self, FitError> {
        let finite: Vec<_> = points_m.iter().copied().filter(robust::is_finite).collect();
        if finite.len() < 6 {
            return Err(FitError::TooFewPoints { shape: "cylinder", needed: 6, got: finite.len() });
        }
        best_direction(&finite, DIRECTIONS).ok_or(NOT_ROUND)?.refit(&finite)
    }

    /// Gauss-Newton over the axis's tilt and place and the radius.
    fn refit(mut self, points_m: &[Point3<f64>]) -> Result<Self, FitError> {
        if points_m.len() < 6 {
            return Err(FitError::TooFewPoints {
                shape: "cylinder",
                needed: 6,
                got: points_m.len(),
            });
        }
        let n = points_m.len() as f64;
        let centroid =
            Point3::from(points_m.iter().fold(Vector3::zeros(), |sum, p| sum + p.coords) / n);
        let size = rms(points_m.iter().map(|p| (p - centroid).norm()));
        if size <= 0.0 {
            return Err(NOT_ROUND);
        }
        for _ in 0..STEPS_MAX {
            self.point_m += self.axis * (centroid - self.point_m).dot(&self.axis);
            let (u, v) = across(&self.axis);
            let (h, g) = points_m
                .par_chunks(8192)
                .map(|chunk| {
                    let (mut h, mut g) = (Matrix5::zeros(), Vector5::zeros());
                    for p in chunk {
                        let d = p - self.point_m;
                        let along = d.dot(&self.axis);
                        let radial = d - self.axis * along;
                        let distance = radial.norm().max(1e-12);
                        let out = radial / distance;
                        let (nu, nv) = (out.dot(&u), out.dot(&v));
                        // Lengths along the axis are in units of the points' spread.
                        let row = Vector5::new(nu, nv, nu * along / size, nv * along / size, 1.0);
                        h += row * row.transpose();
                        g += row * (distance - self.radius_m);
                    }
                    (h, g)
                })
                .collect::<Vec<_>>()
                .into_iter()
                .fold((Matrix5::zeros(), Vector5::zeros()), |a, b| (a.0 + b.0, a.1 + b.1));
            if (h / n).symmetric_eigenvalues().min() < 1e-9 {
                return Err(NOT_ROUND);
            }
            let step = h.cholesky().ok_or(NOT_ROUND)?.solve(&g);
            self.point_m += u * step[0] + v * step[1];
            self.axis = (self.axis + (u * step[2] + v * step[3]) / size).normalize();
            self.radius_m += step[4];
            if step.norm() < 1e-14 * (size + self.radius_m.abs()) {
                break;
            }
        }
        let is_finite = self.point_m.coords.norm() + self.radius_m;
        // The sagitta would be a hundredth of the points' spread: flat, as far as can be told.
        if !is_finite.is_finite() || self.radius_m <= 0.0 || self.radius_m > 50.0 * size {
            return Err(NOT_ROUND);
        }
        if self.axis.z < 0.0 {
            self.axis = -self.axis;
        }
        Ok(self)
    }

    fn through(sample_m: &[Point3<f64>]) -> Option<Self> {
        best_direction(sample_m, DIRECTIONS / 4)?.refit(sample_m).ok()
    }

    fn distance_m(&self, point_m: &Point3<f64>) -> f64 {
        self.distance_m(point_m)
    }
}

/// The best of evenly spread axes, each with the algebraic circle of the points seen along it.
fn best_direction(points_m: &[Point3<f64>], directions: usize) -> Option<CylinderFit> {
    let stride = points_m.len().div_ceil(500);
    let points: Vec<_> = points_m.iter().step_by(stride).collect();
    let mean = points.iter().fold(Vector3::zeros(), |s, p| s + p.coords) / points.len() as f64;
    let spread = rms(points.iter().map(|p| (p.coords - mean).norm())).max(1e-12);
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 0.2, 0.3));
    (0..directions)
        .filter_map(|k| {
            // A spiral of equal areas over the half sphere.
            let z = (k as f64 + 0.5) / directions as f64;
            let (s, c) = (k as f64 * 2.399_963_229_728_653).sin_cos();
            let r = (1.0 - z * z).sqrt();
            let axis = turn * Vector3::new(r * c, r * s, z);
            let (u, v) = across(&axis);
            let flat = |p: &Point3<f64>| {
                let d = (p.coords - mean) / spread;
                (d.dot(&u), d.dot(&v))
            };
            let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
            for p in &points {
                let (x, y) = flat(p);
                let row = Vector3::new(x, y, 1.0);
                a += row * row.transpose();
                b += row * (x * x + y * y);
            }
            let solution = a.cholesky()?.solve(&b);
            let (cx, cy) = (solution.x / 2.0, solution.y / 2.0);
            let radius = (solution.z + cx * cx + cy * cy).max(0.0).sqrt();
            let error = rms(points.iter().map(|p| {
                let (x, y) = flat(p);
                (x - cx).hypot(y - cy) - radius
            }));
            let point_m = Point3::from(mean + (u * cx + v * cy) * spread);
            let fit = CylinderFit { point_m, axis, radius_m: radius * spread };
            (error.is_finite() && radius < 100.0).then_some((error, fit))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, fit)| fit)
}

/// Two directions across an axis.
fn across(axis: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if axis.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let u = axis.cross(&helper).normalize();
    (u, axis.cross(&u))
}
