//! Normals of a cloud: the direction of least spread among a point's neighbours.

use super::tree::PointTree;
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
    tree: &PointTree,
    params: &Normals,
) -> Vec<Vector3<f64>> {
    let neighbours = NonZero::new(params.neighbours.max(3)).expect("at least 3");
    points_m
        .par_iter()
        .map(|point| {
            // Relative to the point itself: the squares of absolute coordinates would cancel.
            let (mut count, mut sum, mut squares) = (0.0, Vector3::zeros(), Matrix3::zeros());
            for (index, _) in tree.nearest_n(point, neighbours) {
                let offset = Vector3::from(points_m[index]) - Vector3::from(*point);
                count += 1.0;
                sum += offset;
                squares += offset * offset.transpose();
            }
            let eigen = SymmetricEigen::new(squares - sum * sum.transpose() / count);
            let least = eigen.eigenvalues.imin();
            eigen.eigenvectors.column(least).into_owned()
        })
        .collect()
}
