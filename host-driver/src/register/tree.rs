//! Nearest points of a cloud, by a k-d tree in single precision.

use std::num::NonZero;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Vector3;

/// A cloud that finds the points nearest to a place.
///
/// Coordinates are rounded to single precision about the cloud's middle: of points that are equally
/// far to a ten-millionth of the cloud's size, either may be found. That is far below any noise, and
/// half of the memory and time of double precision.
pub(crate) struct PointTree {
    tree: ImmutableKdTree<f32, 3>,
    middle: Vector3<f64>,
}

impl PointTree {
    /// `None` without points. They must be finite.
    pub fn new(points_m: &[[f64; 3]]) -> Option<Self> {
        if points_m.is_empty() {
            return None;
        }
        let sum = points_m.iter().fold(Vector3::zeros(), |s, p| s + Vector3::from(*p));
        let middle = sum / points_m.len() as f64;
        let rounded: Vec<[f32; 3]> = points_m.iter().map(|p| about(&middle, p)).collect();
        let tree = ImmutableKdTree::new_from_slice(&rounded).ok()?;
        Some(Self { tree, middle })
    }

    /// Index of the point nearest to `query`.
    pub fn nearest(&self, query: &[f64; 3]) -> usize {
        let query = about(&self.middle, query);
        self.tree.query(&query).nearest_one::<SquaredEuclidean<f32>>().execute().item as usize
    }

    /// Indices and distances of the `count` points nearest to `query`, nearest first.
    pub fn nearest_n(
        &self,
        query: &[f64; 3],
        count: NonZero<usize>,
    ) -> impl Iterator<Item = (usize, f64)> {
        let query = about(&self.middle, query);
        let near = self.tree.query(&query).nearest_n::<SquaredEuclidean<f32>>(count).execute();
        near.into_iter().map(|n| (n.item as usize, f64::from(n.distance).sqrt()))
    }
}

fn about(middle: &Vector3<f64>, point: &[f64; 3]) -> [f32; 3] {
    [0, 1, 2].map(|k| (point[k] - middle[k]) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_finds_what_looking_at_every_point_finds() {
        let mut state = 5_u64;
        let mut draw = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            // Far from the origin, where single precision alone would be too coarse.
            1000.0 + (state >> 33) as f64 / f64::from(1_u32 << 31)
        };
        let points: Vec<[f64; 3]> = (0..2000).map(|_| [draw(), draw(), draw()]).collect();
        let tree = PointTree::new(&points).expect("points");
        let distance = |a: &[f64; 3], b: &[f64; 3]| (Vector3::from(*a) - Vector3::from(*b)).norm();
        for _ in 0..100 {
            let query = [draw(), draw(), draw()];
            let mut slow: Vec<f64> = points.iter().map(|p| distance(p, &query)).collect();
            let found = distance(&points[tree.nearest(&query)], &query);
            slow.sort_by(f64::total_cmp);
            assert!((found - slow[0]).abs() < 1e-6);
            let near: Vec<_> = tree.nearest_n(&query, NonZero::new(7).expect("not 0")).collect();
            assert_eq!(near.len(), 7);
            for ((index, far), slow) in near.iter().zip(&slow) {
                assert!((far - slow).abs() < 1e-6);
                assert!((distance(&points[*index], &query) - slow).abs() < 1e-6);
            }
        }
        assert!(PointTree::new(&[]).is_none());
    }
}
