//! A view: points, how the sensor saw them, and how much they count.

use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;

use super::noise;
use crate::PointCloud;
use crate::register::normals::{Normals, estimate_normals};
use crate::register::tree::PointTree;

/// A cloud in its own sensor frame (sensor at the origin), with what fusion needs of each point.
#[derive(Debug, Clone)]
pub struct View {
    /// Its name, for messages.
    pub name: String,
    /// Finite points, metres.
    pub points_m: Vec<Point3<f32>>,
    /// Unit normals towards the sensor.
    pub normals: Vec<Vector3<f32>>,
    /// Cosine of the incidence.
    pub incidence_cos: Vec<f32>,
    /// Noise along the normal, metres; infinite for points that stand alone.
    pub sigma_m: Vec<f32>,
    /// Brightness.
    pub intensity: Vec<u8>,
    /// Distance from a point to the next one, metres (median).
    pub spacing_m: f64,
}

/// A point whose tenth neighbour is farther than so many times the median is alone.
const ALONE: f64 = 4.0;

impl View {
    /// Prepares a cloud: normals, incidence, noise, and which points stand alone.
    ///
    /// # Errors
    /// `None` when it has fewer than 100 finite points.
    pub fn new(name: impl Into<String>, cloud: &PointCloud) -> Option<Self> {
        let chosen: Vec<usize> = (0..cloud.len())
            .filter(|&k| cloud.points_left_m[k].coords.iter().all(|c| c.is_finite()))
            .collect();
        if chosen.len() < 100 {
            return None;
        }
        let points: Vec<[f64; 3]> =
            chosen.iter().map(|&k| cloud.points_left_m[k].cast::<f64>().coords.into()).collect();
        let tree = PointTree::new(&points)?;
        let tenth = std::num::NonZero::new(10)?;
        let reach: Vec<f32> = points
            .par_iter()
            .map(|p| tree.nearest_n(p, tenth).map(|(_, far)| far).fold(0.0, f64::max) as f32)
            .collect();
        let mut sorted = reach.clone();
        let middle = sorted.len() / 2;
        let median = *sorted.select_nth_unstable_by(middle, f32::total_cmp).1;
        let limit = median * ALONE as f32;
        let normals = estimate_normals(&points, &tree, &Normals::default());
        let mut view = Self {
            name: name.into(),
            points_m: chosen.iter().map(|&k| cloud.points_left_m[k]).collect(),
            normals: Vec::with_capacity(points.len()),
            incidence_cos: Vec::with_capacity(points.len()),
            sigma_m: Vec::with_capacity(points.len()),
            intensity: chosen.iter().map(|&k| cloud.intensity[k]).collect(),
            // Of a surface, pi r^2 holds ten points when they are r / 1.78 apart.
            spacing_m: f64::from(median) / (10.0 / std::f64::consts::PI).sqrt(),
        };
        for (((point, normal), reach), &k) in points.iter().zip(normals).zip(reach).zip(&chosen) {
            let point = Point3::from(*point);
            let normal = if normal.dot(&point.coords) > 0.0 { -normal } else { normal };
            let cos = noise::incidence_cos(&point, &normal);
            let sigma = noise::sigma_m(&point, cos, cloud.zncc[k]);
            view.normals.push(normal.cast());
            view.incidence_cos.push(cos as f32);
            view.sigma_m.push(if reach > limit { f32::INFINITY } else { sigma as f32 });
        }
        Some(view)
    }

    /// Points in the first view's frame.
    pub fn moved<'a>(
        &'a self,
        first_from_view: &'a Isometry3<f64>,
    ) -> impl Iterator<Item = Point3<f64>> + 'a {
        self.points_m.iter().map(move |p| first_from_view * p.cast::<f64>())
    }
}
