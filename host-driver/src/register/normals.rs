//! Normals of a cloud: the direction of least spread among a point's neighbours.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::{Matrix3, SymmetricEigen, Vector3};
use rayon::prelude::*;
use std::num::NonZero;

/// How normals are estimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Normals {
    /// Neighbours that the plane is fitted through, the point itself included.
    pub neighbours: usize,
}

impl Default for Normals {
    fn default() -> Self {
        // Fewer follow the noise of a speckle cloud, more round off edges.
        Self { neighbours: 16 }
    }
}

/// Unit normals of `points_m`, signs arbitrary, by principal components of the nearest neighbours.
pub(crate) fn estimate_normals(
    points_m: &[[f64; 3]],
    tree: &ImmutableKdTree<f64, 3>,
    params: &Normals,
) -> Vec<Vector3<f64>> {
    let neighbours = NonZero::new(params.neighbours.max(3)).expect("at least 3");
    points_m
        .par_iter()
        .map(|point| {
            let near = tree.query(point).nearest_n::<SquaredEuclidean<f64>>(neighbours).execute();
            // Relative to the point itself: the squares of absolute coordinates would cancel.
            let offsets: Vec<Vector3<f64>> = near
                .iter()
                .map(|n| Vector3::from(points_m[n.item as usize]) - Vector3::from(*point))
                .collect();
            let mean = offsets.iter().sum::<Vector3<f64>>() / offsets.len() as f64;
            let spread: Matrix3<f64> =
                offsets.iter().map(|o| (o - mean) * (o - mean).transpose()).sum();
            let eigen = SymmetricEigen::new(spread);
            let least = eigen.eigenvalues.imin();
            eigen.eigenvectors.column(least).into_owned()
        })
        .collect()
}
