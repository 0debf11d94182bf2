//! The weighted mean of all views on a grid of small cells.
//!
//! Each point counts by its noise and by how squarely its surface was seen. A cell's mean is moved
//! along its normal to where it and the cells around it agree; cells that stand alone, and cells just
//! before or behind a much better surface of the same orientation, are errors and are removed.

use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;

use super::{FuseParams, ModelPoint, View};
use crate::register::thin::{CellMap, cell_key, thinned_by};

/// The fused points.
pub struct Fused {
    /// In the first view's frame.
    pub points: Vec<ModelPoint>,
    /// Cells removed.
    pub removed: usize,
}

/// Sums over the points of a cell, about the grid's origin.
#[derive(Clone, Copy)]
struct Cell {
    weight: f64,
    point: Vector3<f64>,
    normal: Vector3<f64>,
    intensity: f64,
    views: u64,
}

impl Cell {
    fn mean(&self) -> Point3<f64> {
        Point3::from(self.point / self.weight)
    }

    fn unit_normal(&self) -> Vector3<f64> {
        self.normal.try_normalize(1e-12).unwrap_or_else(|| -Vector3::z())
    }
}

/// Of the 26 cells around a cell of a surface about 8 are occupied.
const AROUND_MIN: usize = 4;
/// A surface that counts this many times more is the right one of two.
const BETTER: f64 = 3.0;

/// Fuses the good points of all views.
pub fn fuse(
    views: &[View],
    first_from_view: &[Isometry3<f64>],
    params: &FuseParams,
    progress: &mut dyn FnMut(String),
) -> Fused {
    let cells = accumulate(views, first_from_view, params);
    progress(format!("{} cells: removing strays and layers", cells.len()));
    let index: CellMap<u32> =
        cells.iter().enumerate().map(|(k, (key, _))| (*key, k as u32)).collect();
    let grid = Grid { cells: &cells, index: &index, cell_m: params.cell_m };
    let kept: Vec<Option<ModelPoint>> =
        (0..cells.len()).into_par_iter().map(|k| grid.point(k, params.layer_m)).collect();
    let found: Vec<ModelPoint> = kept.into_iter().flatten().collect();
    // Two cells of one surface may have moved to the same place.
    let places: Vec<Point3<f64>> = found.iter().map(|p| p.point_m).collect();
    let points = thinned_by(&places, params.cell_m).into_iter().map(|k| found[k]).collect();
    Fused { points, removed: cells.len() - found.len() }
}

fn accumulate(
    views: &[View],
    first_from_view: &[Isometry3<f64>],
    params: &FuseParams,
) -> Vec<(u64, Cell)> {
    let cos_min = params.incidence_max_deg.to_radians().cos() as f32;
    let mut entries: Vec<(u64, u32, u32)> = Vec::new();
    for (v, (view, pose)) in views.iter().zip(first_from_view).enumerate() {
        for (k, p) in view.points_m.iter().enumerate() {
            if view.sigma_m[k].is_finite() && view.incidence_cos[k] >= cos_min {
                entries.push((
                    cell_key(&(pose * p.cast::<f64>()), params.cell_m),
                    v as u32,
                    k as u32,
                ));
            }
        }
    }
    entries.par_sort_unstable();
    let chunks: Vec<&[(u64, u32, u32)]> = entries.chunk_by(|a, b| a.0 == b.0).collect();
    chunks
        .into_par_iter()
        .map(|chunk| {
            let zero = Vector3::zeros();
            let mut cell =
                Cell { weight: 0.0, point: zero, normal: zero, intensity: 0.0, views: 0 };
            for &(_, v, k) in chunk {
                let (view, pose, k) =
                    (&views[v as usize], &first_from_view[v as usize], k as usize);
                let sigma_mm = f64::from(view.sigma_m[k]) * 1e3;
                let cos = f64::from(view.incidence_cos[k]);
                let weight = cos * cos / (sigma_mm * sigma_mm);
                cell.weight += weight;
                cell.point += (pose * view.points_m[k].cast::<f64>()).coords * weight;
                cell.normal += pose * view.normals[k].cast::<f64>() * weight;
                cell.intensity += f64::from(view.intensity[k]) * weight;
                cell.views |= 1 << (v % 64);
            }
            (chunk[0].0, cell)
        })
        .collect()
}

struct Grid<'a> {
    cells: &'a [(u64, Cell)],
    index: &'a CellMap<u32>,
    cell_m: f64,
}

impl Grid<'_> {
    fn at(&self, point: &Point3<f64>) -> Option<usize> {
        self.index.get(&cell_key(point, self.cell_m)).map(|k| *k as usize)
    }

    /// The point of a cell; `None` when the cell is a stray or an error's layer.
    fn point(&self, k: usize, layer_m: f64) -> Option<ModelPoint> {
        let own = &self.cells[k].1;
        let (mean, normal) = (own.mean(), own.unit_normal());
        let (mut weight, mut shift, mut around) = (0.0, 0.0, 0);
        let mut views = 0_u64;
        for dx in -1..=1 {
            for dy in -1..=1 {
                for dz in -1..=1 {
                    let offset = Vector3::new(f64::from(dx), f64::from(dy), f64::from(dz));
                    let Some(j) = self.at(&(mean + offset * self.cell_m)) else { continue };
                    around += usize::from(j != k);
                    let other = &self.cells[j].1;
                    if other.unit_normal().dot(&normal) < 0.7 {
                        continue;
                    }
                    let d = other.mean() - mean;
                    let along = d.dot(&normal);
                    let across = (d - normal * along).norm_squared() / (self.cell_m * self.cell_m);
                    let counts = other.weight * (-across).exp();
                    weight += counts;
                    shift += counts * along;
                    views |= other.views;
                }
            }
        }
        if around < AROUND_MIN || self.is_layer(k, &mean, &normal, layer_m) {
            return None;
        }
        Some(ModelPoint {
            point_m: mean + normal * (shift / weight),
            normal: normal.cast(),
            noise_mm: (1.0 / weight.sqrt()) as f32,
            intensity: (own.intensity / own.weight) as u8,
            views: views.count_ones() as u8,
        })
    }

    /// Whether a much better surface of the same orientation is just before or behind.
    fn is_layer(&self, k: usize, mean: &Point3<f64>, normal: &Vector3<f64>, layer_m: f64) -> bool {
        let steps = (layer_m / self.cell_m).round() as i32;
        (2..=steps).flat_map(|s| [s, -s]).any(|s| {
            let there = mean + normal * (f64::from(s) * self.cell_m);
            self.at(&there).is_some_and(|j| {
                let other = &self.cells[j].1;
                other.weight > BETTER * self.cells[k].1.weight
                    && other.unit_normal().dot(normal) > 0.5
            })
        })
    }
}
