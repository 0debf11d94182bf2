//! Surfaces of triangles.
//!
//! The hierarchy is searched in single precision, with boxes a little too large; the triangles
//! themselves are met in double precision, so that a depth is as exact as the mesh.

use std::sync::Arc;
use std::time::Duration;

use nalgebra::Vector3;
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb as Box32;
use obvhs::cwbvh::{CwBvh, builder::build_cwbvh};
use obvhs::ray::{Ray as Ray32, RayHit as Hit32};

use super::geometry::{Aabb, Hit, Ray};
use super::shapes::Shape;

/// Facets that meet at less than this angle are one smooth surface, for shading.
const CREASE_COS: f64 = 0.82;
/// Boxes are enlarged by this share of the mesh's size, against rounding in the search.
const BOX_MARGIN: f32 = 1e-6;

/// Vertices and triples of indices into them.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Triangles {
    pub vertices: Vec<Vector3<f64>>,
    pub indices: Vec<[u32; 3]>,
}

/// A mesh ready for rays.
pub(crate) struct TriangleMesh {
    triangles: Triangles,
    /// In the order of the hierarchy's leaves.
    facets: Vec<Facet>,
    bvh: CwBvh,
    bounds: Aabb,
}

struct Facet {
    corner: Vector3<f64>,
    edges: [Vector3<f64>; 2],
    normals: [[f32; 3]; 3],
}

impl TriangleMesh {
    /// A mesh with the given shading normals, one a vertex.
    pub fn with_normals(triangles: Triangles, normals: &[Vector3<f64>]) -> Self {
        let corner_normals =
            triangles.indices.iter().map(|t| t.map(|i| normals[i as usize])).collect::<Vec<_>>();
        Self::build(triangles, &corner_normals)
    }

    /// A mesh shaded smoothly except across creases.
    pub fn new(triangles: Triangles) -> Self {
        let Triangles { vertices, indices } = &triangles;
        let area_normals: Vec<Vector3<f64>> = indices
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|i| vertices[i as usize]);
                (b - a).cross(&(c - a))
            })
            .collect();
        let mut around = vec![Vec::new(); vertices.len()];
        for (f, t) in indices.iter().enumerate() {
            t.iter().for_each(|&i| around[i as usize].push(f as u32));
        }
        let corner_normals: Vec<[Vector3<f64>; 3]> = indices
            .iter()
            .zip(&area_normals)
            .map(|(t, own)| {
                t.map(|i| {
                    let smooth = around[i as usize]
                        .iter()
                        .map(|&f| area_normals[f as usize])
                        .filter(|n| n.dot(own) > CREASE_COS * n.norm() * own.norm())
                        .fold(Vector3::zeros(), |sum, n| sum + n);
                    smooth.try_normalize(0.0).unwrap_or_else(|| own.normalize())
                })
            })
            .collect();
        Self::build(triangles, &corner_normals)
    }

    fn build(triangles: Triangles, corner_normals: &[[Vector3<f64>; 3]]) -> Self {
        let Triangles { vertices, indices } = &triangles;
        let vec32 = |v: &Vector3<f64>| glam::Vec3A::new(v.x as f32, v.y as f32, v.z as f32);
        let mut size = 0.0_f32;
        let mut boxes: Vec<Box32> = indices
            .iter()
            .map(|t| {
                let mut b = Box32::empty();
                t.iter().for_each(|&i| {
                    let v = vec32(&vertices[i as usize]);
                    size = size.max(v.abs().max_element());
                    b.extend(v);
                });
                b
            })
            .collect();
        let margin = glam::Vec3A::splat(size * BOX_MARGIN);
        for b in &mut boxes {
            b.min -= margin;
            b.max += margin;
        }
        let mut time = Duration::ZERO;
        let bvh = build_cwbvh(&boxes, BvhBuildParams::fast_build(), &mut time);
        let facets = bvh
            .primitive_indices
            .iter()
            .map(|&i| {
                let [a, b, c] = indices[i as usize].map(|v| vertices[v as usize]);
                let normals =
                    corner_normals[i as usize].map(|n| [n.x as f32, n.y as f32, n.z as f32]);
                Facet { corner: a, edges: [b - a, c - a], normals }
            })
            .collect();
        let mut bounds = Aabb::EMPTY;
        triangles.vertices.iter().for_each(|v| bounds.include(v));
        let slack = Vector3::repeat(f64::from(size) * f64::from(BOX_MARGIN));
        bounds = Aabb { min: bounds.min - slack, max: bounds.max + slack };
        Self { triangles, facets, bvh, bounds }
    }

    /// Vertices and triples of indices into them.
    pub fn triangles(&self) -> &Triangles {
        &self.triangles
    }

    /// All corners.
    pub fn vertices(&self) -> &[Vector3<f64>] {
        &self.triangles.vertices
    }

    /// How many facets there are.
    pub fn facet_count(&self) -> usize {
        self.facets.len()
    }

    /// Each facet's corners as indices into the vertices.
    pub fn corners(&self) -> impl Iterator<Item = [u32; 3]> {
        self.bvh.primitive_indices.iter().map(|&i| self.triangles.indices[i as usize])
    }

    /// A box around all of it.
    pub fn bounds(&self) -> &Aabb {
        &self.bounds
    }

    /// Where a ray meets a facet before `max_m`.
    pub fn cross(&self, facet: usize, ray: &Ray, max_m: f64) -> Option<Crossing> {
        self.facets[facet].cross(ray, max_m)
    }

    /// The surface where a ray crosses a facet.
    pub fn hit(&self, facet: usize, crossing: &Crossing) -> Hit {
        let facet = &self.facets[facet];
        let facing = facet.edges[0].cross(&facet.edges[1]);
        let mut normal = facet.shading_normal(crossing.weights);
        // The interpolated normal must be on the side that is seen, as the facet's is.
        if normal.dot(&facing) < 0.0 {
            normal = -normal;
        }
        Hit { distance_m: crossing.distance_m, normal }
    }

    fn nearest(&self, ray: &Ray, max_m: f64) -> Option<(usize, Crossing)> {
        // Most rays of a camera miss; this finds out sooner than the hierarchy.
        if !self.bounds.is_crossed_by(ray, max_m) {
            return None;
        }
        let mut best: Option<(usize, Crossing)> = None;
        let mut found = Hit32::none();
        self.bvh.ray_traverse(ray32(ray, max_m), &mut found, |_, index| {
            let limit = best.as_ref().map_or(max_m, |(_, c)| c.distance_m);
            match self.facets[index].cross(ray, limit) {
                Some(crossing) => {
                    let distance = upper32(crossing.distance_m);
                    best = Some((index, crossing));
                    distance
                }
                None => f32::INFINITY,
            }
        });
        best
    }
}

impl Facet {
    /// Moeller-Trumbore; both sides count.
    fn cross(&self, ray: &Ray, max_m: f64) -> Option<Crossing> {
        /// Neighbours overlap by this share of their size, so that no ray slips between them.
        const OVERLAP: f64 = 1e-9;
        let [e1, e2] = &self.edges;
        let p = ray.direction.cross(e2);
        let determinant = e1.dot(&p);
        if determinant == 0.0 {
            return None;
        }
        let inverse = 1.0 / determinant;
        let s = ray.origin - self.corner;
        let u = s.dot(&p) * inverse;
        if !(-OVERLAP..=1.0 + OVERLAP).contains(&u) {
            return None;
        }
        let q = s.cross(e1);
        let v = ray.direction.dot(&q) * inverse;
        if v < -OVERLAP || u + v > 1.0 + OVERLAP {
            return None;
        }
        let distance_m = e2.dot(&q) * inverse;
        (distance_m > 0.0 && distance_m < max_m).then_some(Crossing { distance_m, weights: [u, v] })
    }

    fn shading_normal(&self, [u, v]: [f64; 2]) -> Vector3<f64> {
        let [a, b, c] = self.normals.map(|n| Vector3::from(n.map(f64::from)));
        let normal = a * (1.0 - u - v) + b * u + c * v;
        normal.try_normalize(1e-9).unwrap_or(a)
    }
}

/// Where a ray crosses a facet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crossing {
    /// Distance along the ray.
    pub distance_m: f64,
    /// Weights of the second and third corner.
    weights: [f64; 2],
}

fn ray32(ray: &Ray, max_m: f64) -> Ray32 {
    let v = |v: &Vector3<f64>| glam::Vec3A::new(v.x as f32, v.y as f32, v.z as f32);
    Ray32::new(v(&ray.origin), v(&ray.direction), 0.0, upper32(max_m))
}

/// The next single-precision number above.
fn upper32(v: f64) -> f32 {
    (v as f32).next_up()
}

impl Shape for Arc<TriangleMesh> {
    fn intersect(&self, ray: &Ray, max_m: f64) -> Option<Hit> {
        let (index, crossing) = self.nearest(ray, max_m)?;
        Some(self.hit(index, &crossing))
    }

    fn occludes(&self, ray: &Ray, max_m: f64) -> bool {
        self.bounds.is_crossed_by(ray, max_m)
            && !self.bvh.ray_traverse_miss(ray32(ray, max_m), |_, index| {
                match self.facets[index].cross(ray, max_m) {
                    Some(_) => 0.0,
                    None => f32::INFINITY,
                }
            })
    }

    fn mesh(&self) -> Option<&TriangleMesh> {
        Some(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::noise::KeyedRng;

    /// Small triangles all over a cube.
    fn soup(count: usize) -> Triangles {
        let mut rng = KeyedRng::new(11);
        let mut triangles = Triangles::default();
        for i in 0..count as u32 {
            let centre = Vector3::from_fn(|_, _| rng.symmetric());
            for _ in 0..3 {
                let offset = Vector3::from_fn(|_, _| 0.1 * rng.symmetric());
                triangles.vertices.push(centre + offset);
            }
            triangles.indices.push([3 * i, 3 * i + 1, 3 * i + 2]);
        }
        triangles
    }

    #[test]
    fn the_hierarchy_finds_what_testing_every_triangle_finds() {
        let mesh = Arc::new(TriangleMesh::new(soup(500)));
        let mut rng = KeyedRng::new(12);
        let mut hits = 0;
        for _ in 0..2000 {
            let origin = Vector3::from_fn(|_, _| 2.0 * rng.symmetric());
            let direction = Vector3::from_fn(|_, _| rng.symmetric()).normalize();
            let ray = Ray { origin, direction };
            let plain = mesh
                .facets
                .iter()
                .filter_map(|f| f.cross(&ray, 10.0))
                .map(|c| c.distance_m)
                .fold(f64::INFINITY, f64::min);
            match mesh.intersect(&ray, 10.0) {
                Some(hit) => {
                    hits += 1;
                    assert_eq!(hit.distance_m, plain);
                    assert!(mesh.occludes(&ray, hit.distance_m + 1e-9));
                    assert!(!mesh.occludes(&ray, hit.distance_m - 1e-9));
                }
                None => assert_eq!(plain, f64::INFINITY),
            }
        }
        assert!(hits > 50, "{hits}");
    }

    #[test]
    fn no_ray_slips_through_a_closed_surface() {
        // A bumpy sphere of latitude and longitude.
        let (n, m) = (40_u32, 60_u32);
        let mut t = Triangles::default();
        for i in 0..=n {
            for j in 0..m {
                let (a, b) = (
                    std::f64::consts::PI * f64::from(i) / f64::from(n),
                    std::f64::consts::TAU * f64::from(j) / f64::from(m),
                );
                let r = 0.5 + 0.02 * (7.0 * b).sin() * a.sin();
                t.vertices.push(Vector3::new(a.sin() * b.cos(), a.sin() * b.sin(), a.cos()) * r);
            }
        }
        for i in 0..n {
            for j in 0..m {
                let [a, b] = [i * m + j, i * m + (j + 1) % m];
                t.indices.push([a, b, a + m]);
                t.indices.push([b, b + m, a + m]);
            }
        }
        let corners = t.vertices.clone();
        let mesh = Arc::new(TriangleMesh::new(t));
        let mut rng = KeyedRng::new(3);
        let inside = Vector3::new(0.01, 0.02, 0.03);
        let random = (0..20_000).map(|_| Vector3::from_fn(|_, _| rng.symmetric()));
        // Also exactly at vertices and edge middles, where neighbours must overlap.
        let edges = corners.windows(2).map(|w| (w[0] + w[1]) / 2.0 - inside);
        for direction in random.chain(corners.iter().map(|c| c - inside)).chain(edges) {
            let ray = Ray { origin: inside, direction: direction.normalize() };
            assert!(mesh.intersect(&ray, 2.0).is_some(), "{direction:?}");
        }
    }
}
