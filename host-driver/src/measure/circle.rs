//! Circles: of rim points in space, and of the rims of holes and discs in a cloud.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::{Matrix3, Point2, Point3, Vector2, Vector3};
use rayon::prelude::*;

use super::plane::PlaneFit;
use super::robust::{self, Shape, Trim, Trimmed};
use super::{FitError, rms};

/// Gauss-Newton steps at most.
const STEPS_MAX: usize = 50;

/// A fitted circle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CircleFit {
    /// Centre.
    pub centre_m: Point3<f64>,
    /// Unit normal of its plane, towards the sensor (z <= 0).
    pub normal: Vector3<f64>,
    /// Radius.
    pub radius_m: f64,
    /// RMS of the points' distances from the circle within its plane, metres.
    pub rms_m: f64,
    /// Points used.
    pub points: usize,
}

/// Fits a circle to rim points in space: the plane of least squares, then the circle of least squared
/// distances in it.
///
/// # Errors
/// Too few points, points on a line.
pub fn fit(rim_m: &[Point3<f64>], trim: &Trim) -> Result<CircleFit, FitError> {
    let plane = robust::fit::<PlaneFit>(rim_m, trim)?;
    let near: Vec<_> =
        rim_m.iter().zip(&plane.used).filter(|(_, used)| **used).map(|(p, _)| *p).collect();
    in_plane(&near, &plane.shape, trim)
}

/// Fits a circle to points near `plane`, seen along its normal.
fn in_plane(rim_m: &[Point3<f64>], plane: &PlaneFit, trim: &Trim) -> Result<CircleFit, FitError> {
    let axes = Axes::new(plane);
    let flat: Vec<Point3<f64>> = rim_m
        .iter()
        .map(|p| {
            let q = axes.flat(p);
            Point3::new(q.x, q.y, 0.0)
        })
        .collect();
    let Trimmed { shape, used, rms_m, .. } = robust::fit::<FlatCircle>(&flat, trim)?;
    Ok(CircleFit {
        centre_m: axes.point(&shape.centre),
        normal: plane.normal,
        radius_m: shape.radius,
        rms_m,
        points: used.iter().filter(|used| **used).count(),
    })
}

/// A circular edge of a flat face, found in a cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct Rim {
    /// The circle.
    pub circle: CircleFit,
    /// The face it is cut out of, or that it bounds.
    pub face: PlaneFit,
    /// Whether the face lies outside (a hole) or inside the circle (a disc, a boss).
    pub is_hole: bool,
    /// Median distance of neighbouring points of the face, metres: what the edge is resolved to.
    pub spacing_m: f64,
}

/// How a rim is looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RimSearch {
    /// Points this far off the face's plane belong to it, metres.
    pub thickness_m: f64,
    /// Where the circle is about, metres; anywhere when `None`.
    pub near_m: Option<Point3<f64>>,
    /// Distance from there within which edge points are taken, metres.
    pub reach_m: f64,
}

impl RimSearch {
    /// A rim of about `radius_m` around `near_m`.
    pub fn around(near_m: Point3<f64>, radius_m: f64) -> Self {
        Self { thickness_m: 1e-3, near_m: Some(near_m), reach_m: 1.4 * radius_m + 3e-3 }
    }
}

/// Neighbours among which the gap of an edge point is looked for.
const NEIGHBOURS: usize = 12;
/// A point of the face with no neighbour in an angle of this is at its edge.
const GAP_RAD: f64 = 2.2;

/// Finds the rim of a hole or a disc in the face that most of `points_m` lie on.
///
/// Points of the face are samples: the last one before the edge lies half a point spacing from it on
/// average, and the circle is corrected by that.
///
/// # Errors
/// No face, or no circular edge in it.
pub fn rim(points_m: &[Point3<f64>], search: &RimSearch) -> Result<Rim, FitError> {
    let face = face(points_m, search)?;
    let axes = Axes::new(&face);
    let on_face: Vec<Point3<f64>> = points_m
        .iter()
        .copied()
        .filter(|p| robust::is_finite(p) && face.distance_m(p).abs() <= search.thickness_m)
        .collect();
    let flat: Vec<[f64; 2]> = on_face
        .iter()
        .map(|p| {
            let q = axes.flat(p);
            [q.x, q.y]
        })
        .collect();
    let few = |got| FitError::TooFewPoints { shape: "circle", needed: 20, got };
    let tree: ImmutableKdTree<f64, 2> =
        ImmutableKdTree::new_from_slice(&flat).map_err(|_| few(flat.len()))?;
    if flat.len() < 4 * NEIGHBOURS {
        return Err(few(flat.len()));
    }
    let count = std::num::NonZero::new(NEIGHBOURS + 1).unwrap_or(std::num::NonZero::<usize>::MIN);
    let looked: Vec<(f64, bool)> = flat
        .par_iter()
        .map(|own| {
            let near = tree.query(own).nearest_n::<SquaredEuclidean<f64>>(count).execute();
            let mut angles: Vec<f64> = near
                .iter()
                .map(|n| flat[n.item as usize])
                .filter(|p| p != own)
                .map(|p| (p[1] - own[1]).atan2(p[0] - own[0]))
                .collect();
            angles.sort_unstable_by(f64::total_cmp);
            let widest = angles
                .windows(2)
                .map(|a| a[1] - a[0])
                .chain(
                    angles.last().zip(angles.first()).map(|(l, f)| f + std::f64::consts::TAU - l),
                )
                .fold(0.0, f64::max);
            let closest = near.iter().map(|n| n.distance).filter(|d| *d > 0.0);
            (closest.fold(f64::INFINITY, f64::min).sqrt(), widest > GAP_RAD)
        })
        .collect();
    let mut spacings: Vec<f64> = looked.iter().map(|l| l.0).filter(|s| s.is_finite()).collect();
    if spacings.is_empty() {
        return Err(few(0));
    }
    let middle = spacings.len() / 2;
    let spacing_m = *spacings.select_nth_unstable_by(middle, f64::total_cmp).1;
    let edge: Vec<Point3<f64>> = on_face
        .iter()
        .zip(&looked)
        .filter(|(_, (_, at_edge))| *at_edge)
        .map(|(p, _)| *p)
        .filter(|p| search.near_m.is_none_or(|near| (p - near).norm() <= search.reach_m))
        .collect();
    let trim = Trim { outliers_max: 0.5, sigmas: 3.0, floor_m: spacing_m };
    let mut circle = in_plane(&edge, &face, &trim)?;
    let centre = axes.flat(&circle.centre_m);
    let inner = flat
        .iter()
        .filter(|q| (Vector2::from(**q) - centre.coords).norm() < 0.8 * circle.radius_m)
        .count() as f64;
    let full = std::f64::consts::PI * (0.8 * circle.radius_m / spacing_m).powi(2);
    let is_hole = inner < 0.4 * full;
    circle.radius_m += if is_hole { -0.5 * spacing_m } else { 0.5 * spacing_m };
    if circle.radius_m <= 0.0 {
        return Err(FitError::Degenerate {
            shape: "circle",
            reason: "the edge is smaller than the points are apart",
        });
    }
    Ok(Rim { circle, face, is_hole, spacing_m })
}

/// Faces that are looked at before giving up.
const FACES: usize = 5;

/// The face that most points lie on; of those that pass through the place where the circle is about, if
/// one is given.
fn face(points_m: &[Point3<f64>], search: &RimSearch) -> Result<PlaneFit, FitError> {
    let trim = Trim { outliers_max: 0.6, ..Trim::default() };
    let mut rest: Vec<Point3<f64>> = points_m.to_vec();
    for _ in 0..FACES {
        let face = robust::fit::<PlaneFit>(&rest, &trim)?.shape;
        let passes = |near: Point3<f64>| face.distance_m(&near).abs() <= 3.0 * search.thickness_m;
        if search.near_m.is_none_or(passes) {
            return Ok(face);
        }
        rest.retain(|p| face.distance_m(p).abs() > search.thickness_m);
    }
    Err(FitError::Degenerate { shape: "circle", reason: "no face passes through the place given" })
}

/// Two axes in a plane.
struct Axes {
    origin: Point3<f64>,
    x: Vector3<f64>,
    y: Vector3<f64>,
}

impl Axes {
    fn new(plane: &PlaneFit) -> Self {
        let helper = if plane.normal.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
        let x = plane.normal.cross(&helper).normalize();
        Self { origin: plane.point_m, x, y: plane.normal.cross(&x) }
    }

    fn flat(&self, p: &Point3<f64>) -> Point2<f64> {
        let d = p - self.origin;
        Point2::new(d.dot(&self.x), d.dot(&self.y))
    }

    fn point(&self, q: &Point2<f64>) -> Point3<f64> {
        self.origin + self.x * q.x + self.y * q.y
    }
}

/// A circle in the plane z = 0.
#[derive(Debug, Clone, Copy, PartialEq)]
struct FlatCircle {
    centre: Point2<f64>,
    radius: f64,
}

impl Shape for FlatCircle {
    const NAME: &'static str = "circle";
    const SAMPLE: usize = 3;

    fn fit(points: &[Point3<f64>]) -> Result<Self, FitError> {
        if points.len() < Self::SAMPLE {
            return Err(FitError::TooFewPoints { shape: "circle", needed: 3, got: points.len() });
        }
        let straight =
            FitError::Degenerate { shape: "circle", reason: "the points are on a straight line" };
        let n = points.len() as f64;
        let mean = points.iter().fold(Vector2::zeros(), |sum, p| sum + p.xy().coords) / n;
        let spread = rms(points.iter().map(|p| (p.xy().coords - mean).norm()));
        if spread <= 0.0 {
            return Err(straight);
        }
        // The algebraic circle (Kasa) in units of the spread, as a start.
        let unit = |p: &Point3<f64>| (p.xy().coords - mean) / spread;
        let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
        for p in points {
            let q = unit(p);
            let row = Vector3::new(q.x, q.y, 1.0);
            a += row * row.transpose();
            b += row * q.norm_squared();
        }
        // The sagitta of the arc is below a ten-thousandth of its length.
        if (a / n).symmetric_eigenvalues().min() < 1e-8 {
            return Err(straight);
        }
        let solution = a.cholesky().ok_or_else(|| straight.clone())?.solve(&b);
        let mut centre = solution.xy() / 2.0;
        let mut radius = (solution.z + centre.norm_squared()).max(0.0).sqrt();
        for _ in 0..STEPS_MAX {
            let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
            for p in points {
                let d = unit(p) - centre;
                let distance = d.norm().max(1e-12);
                let row = Vector3::new(d.x / distance, d.y / distance, 1.0);
                h += row * row.transpose();
                g += row * (distance - radius);
            }
            let step = h.cholesky().ok_or_else(|| straight.clone())?.solve(&g);
            centre += step.xy();
            radius += step.z;
            if step.norm() < 1e-13 * (1.0 + radius) {
                break;
            }
        }
        if !(centre.norm() + radius).is_finite() || radius <= 0.0 || radius > 1e3 {
            return Err(straight);
        }
        Ok(Self { centre: (centre * spread + mean).into(), radius: radius * spread })
    }

    fn distance_m(&self, point: &Point3<f64>) -> f64 {
        (point.xy() - self.centre).norm() - self.radius
    }
}
