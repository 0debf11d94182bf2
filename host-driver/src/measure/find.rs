//! Spheres anywhere in a cloud: candidates from pairs of points with normals, which meet in a sphere's
//! centre, judged by how many points lie on them; then a trimmed fit.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::FitError;
use super::robust::{self, Draw, Trim, Trimmed};
use super::sphere::SphereFit;
use crate::register::surface::CloudSurface;
use crate::register::thin::thinned;

/// What spheres are looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SphereSearch {
    /// Spheres wanted.
    pub count: usize,
    /// Their radius about (within a seventh), metres; any from 4 mm to 0.3 m when `None`.
    pub radius_m: Option<f64>,
    /// How a found sphere's points are trimmed.
    pub trim: Trim,
}

/// A sphere that was found: the fit and the points that are on it.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// The trimmed fit.
    pub fit: Trimmed<SphereFit>,
    /// The points it was fitted to, metres, as long as `fit.used`.
    pub points_m: Vec<Point3<f64>>,
    /// How much of it is covered: the opening angle of the cap, degrees (180: half a sphere).
    pub cap_deg: f64,
}

/// Pairs of points that are tried for each sphere.
const PAIRS: u64 = 60_000;
/// Points that candidates are judged by first.
const JUDGES: usize = 2500;
/// Candidates that are judged by all points.
const FINALISTS: usize = 24;
/// Points of the thinned cloud, at most.
const THINNED: usize = 40_000;
/// Fewest points of a sphere.
const POINTS_MIN: usize = 150;
/// Cosine of the largest angle between a point's normal and the direction from the centre.
const NORMAL_COS: f64 = 0.94;
/// A smaller cap fixes no radius.
const CAP_MIN_DEG: f64 = 35.0;

/// Finds spheres, the one with most points first.
///
/// # Errors
/// [`FitError::NotFound`] when there are fewer than wanted.
pub fn spheres(points_m: &[Point3<f64>], search: &SphereSearch) -> Result<Vec<Found>, FitError> {
    let mut rest: Vec<Point3<f64>> = points_m.iter().copied().filter(robust::is_finite).collect();
    let mut found = Vec::new();
    while found.len() < search.count {
        let next = one(&rest, search).ok_or(FitError::NotFound {
            shape: "sphere",
            found: found.len(),
            wanted: search.count,
        })?;
        let shape = next.fit.shape;
        // What lies on it or within it belongs to it and is out of the way of the next.
        rest.retain(|p| (p - shape.centre_m).norm() > 1.05 * shape.radius_m);
        found.push(next);
    }
    Ok(found)
}

fn one(points_m: &[Point3<f64>], search: &SphereSearch) -> Option<Found> {
    if points_m.len() < POINTS_MIN {
        return None;
    }
    let thin = thinned(points_m, THINNED);
    let surface = CloudSurface::new(&thin).ok()?;
    let (points, normals) = (surface.points_m(), surface.normals());
    let radii = match search.radius_m {
        Some(radius_m) => radius_m / 1.15..=radius_m * 1.15,
        None => 0.004..=0.3,
    };
    let at = |i: usize| Point3::from(points[i]);
    let reach_m = 1.6 * radii.end();
    let stride = points.len().div_ceil(JUDGES);
    let mut candidates: Vec<(usize, Point3<f64>, f64)> = (0..PAIRS)
        .into_par_iter()
        .filter_map(|pair| {
            let mut draw = Draw(pair.wrapping_mul(0xD134_2543_DE82_EF95));
            let i = draw.below(points.len());
            let j = (0..12).map(|_| draw.below(points.len())).find(|j| {
                let d = (at(*j) - at(i)).norm();
                d > 0.2 * radii.start() && d < reach_m
            })?;
            let (centre, radius) = meeting(at(i), normals[i], at(j), normals[j])?;
            if !radii.contains(&radius) {
                return None;
            }
            let score = (0..points.len())
                .step_by(stride)
                .filter(|k| on_sphere(&at(*k), &normals[*k], &centre, radius))
                .count();
            // Two of them are the pair itself.
            (score > 3).then_some((score, centre, radius))
        })
        .collect();
    candidates.sort_by_key(|c| std::cmp::Reverse(c.0));
    candidates.truncate(FINALISTS);
    let (_, centre, radius) = candidates
        .into_iter()
        .map(|(_, centre, radius)| {
            let on = |k: &usize| on_sphere(&at(*k), &normals[*k], &centre, radius);
            ((0..points.len()).filter(on).count(), centre, radius)
        })
        .max_by_key(|c| c.0)?;
    // The band around the candidate holds the sphere's points; two rounds let it move there.
    let (mut centre, mut radius) = (centre, radius);
    for band in [0.06, 0.03] {
        let near = in_band(points_m, &centre, radius, band);
        let fit = robust::fit::<SphereFit>(&near, &search.trim).ok()?;
        (centre, radius) = (fit.shape.centre_m, fit.shape.radius_m);
        if !radii.contains(&radius) {
            return None;
        }
    }
    let near = in_band(points_m, &centre, radius, 0.03);
    let fit = robust::fit::<SphereFit>(&near, &search.trim).ok()?;
    let used: Vec<Point3<f64>> =
        near.iter().zip(&fit.used).filter(|(_, used)| **used).map(|(p, _)| *p).collect();
    let cap_deg = cap_deg(&used, &fit.shape);
    let is_sphere = used.len() >= POINTS_MIN && cap_deg >= CAP_MIN_DEG;
    is_sphere.then_some(Found { fit, points_m: near, cap_deg })
}

/// Where the normals of two points meet: centre and radius of the sphere through both.
fn meeting(
    p: Point3<f64>,
    n: Vector3<f64>,
    q: Point3<f64>,
    m: Vector3<f64>,
) -> Option<(Point3<f64>, f64)> {
    let d = q - p;
    let (nm, nd, md) = (n.dot(&m), n.dot(&d), m.dot(&d));
    let determinant = 1.0 - nm * nm;
    // Normals that are nearly parallel meet nowhere in particular.
    if determinant < 0.02 {
        return None;
    }
    let s = (nd - nm * md) / determinant;
    let t = (nm * nd - md) / determinant;
    let (a, b) = (p + n * s, q + m * t);
    let radius = (s.abs() + t.abs()) / 2.0;
    let meets = (a - b).norm() < 0.08 * radius && (s.abs() - t.abs()).abs() < 0.08 * radius;
    meets.then(|| (nalgebra::center(&a, &b), radius))
}

fn on_sphere(p: &Point3<f64>, n: &Vector3<f64>, centre: &Point3<f64>, radius: f64) -> bool {
    let d = p - centre;
    let distance = d.norm();
    let near = (distance - radius).abs() < (0.02 * radius).max(3e-4);
    near && n.dot(&d).abs() > NORMAL_COS * distance
}

fn in_band(
    points_m: &[Point3<f64>],
    centre: &Point3<f64>,
    radius: f64,
    band: f64,
) -> Vec<Point3<f64>> {
    let width = (band * radius).max(5e-4);
    let near = |p: &&Point3<f64>| ((*p - centre).norm() - radius).abs() < width;
    points_m.iter().filter(near).copied().collect()
}

/// Opening angle of the cap that the points cover, strays of 1 % left out.
fn cap_deg(points_m: &[Point3<f64>], sphere: &SphereFit) -> f64 {
    let directions: Vec<Vector3<f64>> =
        points_m.iter().map(|p| (p - sphere.centre_m).normalize()).collect();
    let Some(middle) = directions.iter().sum::<Vector3<f64>>().try_normalize(1e-9) else {
        return 360.0;
    };
    let mut angles: Vec<f64> =
        directions.iter().map(|d| d.dot(&middle).clamp(-1.0, 1.0).acos()).collect();
    if angles.is_empty() {
        return 0.0;
    }
    let rank = (angles.len() - 1) * 99 / 100;
    2.0 * angles.select_nth_unstable_by(rank, f64::total_cmp).1.to_degrees()
}
