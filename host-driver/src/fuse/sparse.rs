//! What a view is registered by: points spread evenly, averaged over small cells, without its rims.
//!
//! Where a view ends, and where it jumps in depth, a subset sees two things at once: points there are off
//! by tenths of a millimetre, and to another side in each view. They make a model's rims, and other
//! views cover them, but they must not tell where the views are.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::num::NonZero;

use super::{FuseError, FuseParams, View};
use crate::register::RegisterError;
use crate::register::surface::CloudSurface;
use crate::register::thin::{CellMap, cell_key, thinned_by};
use crate::register::tree::PointTree;

/// A point of a view's surface.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Position in the view's own frame, metres.
    pub point_m: Point3<f64>,
    /// Unit normal towards the sensor.
    pub normal: Vector3<f64>,
    /// Noise along the normal by the noise model, metres.
    pub sigma_m: f64,
}

/// The good points of a view, spread evenly, ready to be searched.
pub struct Sparse {
    /// Points in the view's own frame, metres: all good ones, rims included.
    pub points_m: Vec<Point3<f64>>,
    /// Points that are registered: without rims.
    pub samples: Vec<Sample>,
    /// What other views' samples are laid on: without rims, far denser.
    pub field: Option<Field>,
    surface: Option<CloudSurface>,
}

/// Samples that the nearest one can be found of.
pub struct Field {
    /// The samples.
    pub samples: Vec<Sample>,
    /// Their distance from each other, metres.
    pub spacing_m: f64,
    tree: PointTree,
}

/// Most samples of a view: errors are those of whole subsets and folds, more points would not help.
const SAMPLES: usize = 8000;
/// Points seen at a more grazing angle than this do not tell where a view is, degrees: subsets are too
/// long on them, and their bias grows faster than their noise.
const INCIDENCE_DEG: f64 = 62.0;
/// Neighbours by which a rim is told: those of a full disc have no wide gap between their directions.
const AROUND: usize = 25;
/// A gap between the directions of neighbours that makes a rim, degrees.
const GAP_DEG: f64 = 100.0;
/// Width of a rim in the view's own pixels (points): half a subset, and what moves or blurs there.
const RIM_POINTS: f64 = 6.0;
/// A view keeps its rims when less than this share of its points would be left.
const INNER_MIN: f64 = 0.3;

impl Sparse {
    /// The sparse clouds of all views.
    ///
    /// # Errors
    /// [`FuseError::View`].
    pub fn of_all(
        views: &[View],
        params: &FuseParams,
        progress: &mut dyn FnMut(String),
    ) -> Result<Vec<Self>, FuseError> {
        views
            .iter()
            .map(|view| {
                progress(format!("{}: spreading points", view.name));
                Self::of(view, params).map_err(|_| FuseError::View { name: view.name.clone() })
            })
            .collect()
    }

    fn of(view: &View, params: &FuseParams) -> Result<Self, RegisterError> {
        let dense_cell_m = (params.icp_cell_m / 2.0).max(params.cell_m);
        let all = averaged(view, params.incidence_max_deg, dense_cell_m);
        let places: Vec<_> = all.iter().map(|s| s.point_m).collect();
        let coarse = thinned_by(&places, params.icp_cell_m);
        let points_m: Vec<_> = coarse.iter().map(|&k| places[k]).collect();
        let surface = Some(CloudSurface::new(&places)?);
        let inner = without_rims(&all, RIM_POINTS * view.spacing_m);
        let places: Vec<_> = inner.iter().map(|s| s.point_m).collect();
        let spread = thinned_by(&places, params.icp_cell_m);
        let step = spread.len().div_ceil(SAMPLES).max(1);
        let samples = spread.into_iter().step_by(step).map(|k| inner[k]).collect();
        Ok(Self { points_m, samples, field: Field::new(inner), surface })
    }

    /// What coarse registration lays other views on: all good points.
    pub fn surface(&self) -> Option<&CloudSurface> {
        self.surface.as_ref()
    }

    /// Middle of its points.
    pub fn centroid(&self) -> Point3<f64> {
        let sum = self.points_m.iter().fold(Vector3::zeros(), |s, p| s + p.coords);
        Point3::from(sum / self.points_m.len().max(1) as f64)
    }

    #[cfg(test)]
    pub(super) fn for_test(points_m: Vec<Point3<f64>>) -> Self {
        Self { points_m, samples: Vec::new(), field: None, surface: None }
    }
}

impl Field {
    /// `None` without samples.
    pub fn new(samples: Vec<Sample>) -> Option<Self> {
        let points: Vec<[f64; 3]> = samples.iter().map(|s| s.point_m.coords.into()).collect();
        let tree = PointTree::new(&points)?;
        // The fifth nearest (the point itself is the first) is one spacing away on a square grid.
        let fifth = NonZero::new(5)?;
        let step = points.len().div_ceil(2000).max(1);
        let mut far: Vec<f64> = points
            .iter()
            .step_by(step)
            .map(|p| tree.nearest_n(p, fifth).map(|(_, far)| far).fold(0.0, f64::max))
            .collect();
        let middle = far.len() / 2;
        let spacing_m = *far.select_nth_unstable_by(middle, f64::total_cmp).1;
        Some(Self { samples, spacing_m, tree })
    }

    /// The sample nearest to a point.
    pub fn nearest(&self, point_m: &Point3<f64>) -> &Sample {
        &self.samples[self.tree.nearest(&[point_m.x, point_m.y, point_m.z])]
    }
}

/// Means of a view's good points over cells.
fn averaged(view: &View, incidence_max_deg: f64, cell_m: f64) -> Vec<Sample> {
    let cos_min = incidence_max_deg.min(INCIDENCE_DEG).to_radians().cos() as f32;
    let mut cells: CellMap<u32> = CellMap::default();
    // Sums of points, normals and sigma, and how many they are of.
    let mut sums: Vec<(Vector3<f64>, Vector3<f64>, f64, f64)> = Vec::new();
    for k in 0..view.points_m.len() {
        if !view.sigma_m[k].is_finite() || view.incidence_cos[k] < cos_min {
            continue;
        }
        let point: Point3<f64> = view.points_m[k].cast();
        let index = *cells.entry(cell_key(&point, cell_m)).or_insert_with(|| {
            sums.push((Vector3::zeros(), Vector3::zeros(), 0.0, 0.0));
            sums.len() as u32 - 1
        });
        let sum = &mut sums[index as usize];
        sum.0 += point.coords;
        sum.1 += view.normals[k].cast::<f64>();
        sum.2 += f64::from(view.sigma_m[k]);
        sum.3 += 1.0;
    }
    sums.into_iter()
        .filter_map(|(point, normal, sigma, n)| {
            // Two sides of a fold in one cell have no normal.
            let length = normal.norm();
            (length > 0.8 * n).then(|| Sample {
                point_m: Point3::from(point / n),
                normal: normal / length,
                sigma_m: sigma / n,
            })
        })
        .collect()
}

/// Samples farther than `rim_m` from where the surface ends; all when hardly any are.
fn without_rims(samples: &[Sample], rim_m: f64) -> Vec<Sample> {
    let points: Vec<[f64; 3]> = samples.iter().map(|s| s.point_m.coords.into()).collect();
    let (Some(tree), Some(around)) = (PointTree::new(&points), NonZero::new(AROUND)) else {
        return samples.to_vec();
    };
    let rims: Vec<[f64; 3]> = samples
        .par_iter()
        .zip(&points)
        .filter(|(sample, point)| {
            let near = tree.nearest_n(point, around).map(|(k, _)| samples[k].point_m);
            is_rim(sample, near)
        })
        .map(|(_, point)| *point)
        .collect();
    let Some(rim_tree) = PointTree::new(&rims) else { return samples.to_vec() };
    let inner: Vec<Sample> = samples
        .par_iter()
        .zip(&points)
        .filter(|(sample, point)| {
            let rim = Point3::from(rims[rim_tree.nearest(point)]);
            (sample.point_m - rim).norm() > rim_m
        })
        .map(|(sample, _)| *sample)
        .collect();
    if (inner.len() as f64) < INNER_MIN * samples.len() as f64 { samples.to_vec() } else { inner }
}

/// Whether the neighbours of a sample leave a wide gap around it.
fn is_rim(sample: &Sample, near: impl Iterator<Item = Point3<f64>>) -> bool {
    let normal = &sample.normal;
    let helper = if normal.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let u = normal.cross(&helper).normalize();
    let v = normal.cross(&u);
    let mut directions: Vec<f64> = near
        .map(|p| p - sample.point_m)
        .filter(|d| d.norm() > 1e-9)
        .map(|d| d.dot(&v).atan2(d.dot(&u)))
        .collect();
    directions.sort_unstable_by(f64::total_cmp);
    let Some((first, last)) = directions.first().zip(directions.last()) else { return true };
    let around = first + std::f64::consts::TAU - last;
    let widest = directions.windows(2).map(|w| w[1] - w[0]).fold(around, f64::max);
    widest > GAP_DEG.to_radians()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plate_loses_its_rim_and_the_rim_of_its_hole() {
        let samples: Vec<Sample> = (0..100 * 100)
            .map(|k| (f64::from(k % 100) * 1e-3, f64::from(k / 100) * 1e-3))
            .filter(|(x, y)| (x - 0.05).hypot(y - 0.05) > 0.01)
            .map(|(x, y)| Sample {
                point_m: Point3::new(x, y, 1.0),
                normal: -Vector3::z(),
                sigma_m: 1e-5,
            })
            .collect();
        let inner = without_rims(&samples, 4e-3);
        let distance = |s: &Sample| {
            let p = &s.point_m;
            let edge = p.x.min(p.y).min(0.099 - p.x).min(0.099 - p.y);
            edge.min((p.x - 0.05).hypot(p.y - 0.05) - 0.01)
        };
        let nearest = inner.iter().map(distance).fold(f64::INFINITY, f64::min);
        assert!((3e-3..6e-3).contains(&nearest), "{nearest}");
        // Nothing else goes.
        let far = samples.iter().filter(|s| distance(s) > 6.5e-3).count();
        let kept = inner.iter().filter(|s| distance(s) > 6.5e-3).count();
        assert_eq!(far, kept);
        // What is all rim is kept.
        let strip: Vec<Sample> = samples.into_iter().filter(|s| s.point_m.x < 3e-3).collect();
        assert_eq!(without_rims(&strip, 4e-3).len(), strip.len());
    }
}
