//! What a cloud can be laid on: anything that knows its closest point.

use super::RegisterError;
use super::normals::{Normals, estimate_normals};
use super::tree::PointTree;
use nalgebra::{Point3, Vector3};

/// The closest point of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Closest {
    /// The point on the surface, metres.
    pub point_m: Point3<f64>,
    /// Unit normal there; its sign carries no meaning.
    pub normal: Vector3<f64>,
    /// Distance from the query, metres.
    pub distance_m: f64,
}

/// A surface that finds its closest point.
pub trait Surface: Sync {
    /// The point of the surface closest to `query_m`, or `None` when there is none within
    /// `max_distance_m`.
    fn closest(&self, query_m: &Point3<f64>, max_distance_m: f64) -> Option<Closest>;

    /// Whether the surface is known at points only, so that the closest one is off by their spacing
    /// and distances are those along its normal.
    fn is_sampled(&self) -> bool {
        false
    }
}

/// A cloud of surface points with normals, searched by a k-d tree.
pub struct CloudSurface {
    points_m: Vec<[f64; 3]>,
    normals: Vec<Vector3<f64>>,
    tree: PointTree,
}

impl CloudSurface {
    /// Takes the finite points of a cloud and estimates their normals.
    ///
    /// # Errors
    /// [`RegisterError::TooFewPoints`].
    pub fn new(points_m: &[Point3<f64>]) -> Result<Self, RegisterError> {
        let points_m: Vec<[f64; 3]> = points_m
            .iter()
            .filter(|p| p.coords.iter().all(|c| c.is_finite()))
            .map(|p| [p.x, p.y, p.z])
            .collect();
        let needed = Normals::default().neighbours;
        let few =
            RegisterError::TooFewPoints { what: "the target cloud", got: points_m.len(), needed };
        if points_m.len() < needed {
            return Err(few);
        }
        let tree = PointTree::new(&points_m).ok_or(few)?;
        let normals = estimate_normals(&points_m, &tree, &Normals::default());
        Ok(Self { points_m, normals, tree })
    }

    /// The finite points, metres.
    pub fn points_m(&self) -> &[[f64; 3]] {
        &self.points_m
    }

    /// Unit normals of [`CloudSurface::points_m`], signs arbitrary.
    pub fn normals(&self) -> &[Vector3<f64>] {
        &self.normals
    }
}

impl Surface for CloudSurface {
    fn is_sampled(&self) -> bool {
        true
    }

    fn closest(&self, query_m: &Point3<f64>, max_distance_m: f64) -> Option<Closest> {
        let query = [query_m.x, query_m.y, query_m.z];
        let index = self.tree.nearest(&query);
        let point_m = Point3::from(self.points_m[index]);
        let distance_m = (query_m - point_m).norm();
        (distance_m <= max_distance_m).then(|| Closest {
            point_m,
            normal: self.normals[index],
            distance_m,
        })
    }
}
