//! From a distance function to triangles (surface nets, Gibson 1998), with vertices moved onto the
//! surface afterwards.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::trimesh::{TriangleMesh, Triangles};

/// A solid as a function: negative inside, about the distance to the surface outside and in.
pub(crate) trait Solid: Sync {
    /// The function.
    fn distance(&self, p: &Vector3<f64>) -> f64;

    /// Direction and slope in which the distance grows.
    fn gradient(&self, p: &Vector3<f64>) -> Vector3<f64> {
        const STEP: f64 = 2e-4;
        // Four corners of a tetrahedron give the gradient with the fewest evaluations.
        [[1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, 1.0, 1.0]]
            .iter()
            .map(|k| Vector3::from(*k))
            .map(|k| k * self.distance(&(p + k * STEP)))
            .sum::<Vector3<f64>>()
            / (4.0 * STEP)
    }
}

/// Samples per side of the blocks that are skipped together.
const BLOCK: usize = 4;
/// How much faster than the true distance the function may grow.
const STEEPEST: f64 = 1.7;

/// Triangles of the solid's surface inside a box, on a grid of this pitch, with smooth normals.
/// The surface must not leave the box.
pub(crate) fn mesh(
    solid: &impl Solid,
    min: Vector3<f64>,
    max: Vector3<f64>,
    pitch: f64,
) -> TriangleMesh {
    let blocks = (max - min).map(|v| (v / (pitch * BLOCK as f64)).ceil() as usize + 1);
    let [nx, ny, nz] = [blocks.x * BLOCK, blocks.y * BLOCK, blocks.z * BLOCK];
    let at = |x: f64, y: f64, z: f64| min + Vector3::new(x, y, z) * pitch;
    let values = sample(solid, [nx, ny, nz], &at, pitch);
    let value = |x: usize, y: usize, z: usize| values[(z * ny + y) * nx + x];

    // Cells are named by their lowest corner; two layers of vertex numbers are enough.
    const NONE: u32 = u32::MAX;
    let mut below = vec![NONE; nx * ny];
    let mut triangles = Triangles::default();
    for z in 0..nz - 1 {
        let mut here = vec![NONE; nx * ny];
        for y in 0..ny - 1 {
            for x in 0..nx - 1 {
                let corner = |i: usize| value(x + (i & 1), y + (i >> 1 & 1), z + (i >> 2));
                let inside = (0..8).filter(|&i| corner(i) < 0.0).count();
                if inside == 0 || inside == 8 {
                    continue;
                }
                here[y * nx + x] = triangles.vertices.len() as u32;
                let offset = crossing(corner);
                let p = Vector3::new(x as f64, y as f64, z as f64) + offset;
                triangles.vertices.push(at(p.x, p.y, p.z));
                // Edges from this cell's lowest corner along each axis, each shared by four cells
                // that are all known by now.
                let inside = corner(0) < 0.0;
                let index = |dx: usize, dy: usize, dz: usize| {
                    let layer = if dz == 0 { &here } else { &below };
                    layer[(y - dy) * nx + x - dx]
                };
                let mut face = |axis: usize, ring: [u32; 4]| {
                    let crosses = inside != (corner(1 << axis) < 0.0);
                    if crosses && !ring.contains(&NONE) {
                        let [a, b, c, d] = ring;
                        let (b, d) = if inside { (d, b) } else { (b, d) };
                        triangles.indices.extend([[a, b, c], [a, c, d]]);
                    }
                };
                if y > 0 && z > 0 {
                    face(0, [index(0, 0, 0), index(0, 0, 1), index(0, 1, 1), index(0, 1, 0)]);
                }
                if x > 0 && z > 0 {
                    face(1, [index(0, 0, 0), index(1, 0, 0), index(1, 0, 1), index(0, 0, 1)]);
                }
                if x > 0 && y > 0 {
                    face(2, [index(0, 0, 0), index(0, 1, 0), index(1, 1, 0), index(1, 0, 0)]);
                }
            }
        }
        below = here;
    }
    let normals = settle(solid, &mut triangles.vertices, pitch);
    TriangleMesh::with_normals(triangles, &normals)
}

/// The distance on the grid where the surface is near, and a number of the right sign elsewhere.
fn sample(
    solid: &impl Solid,
    [nx, ny, nz]: [usize; 3],
    at: &(impl Fn(f64, f64, f64) -> Vector3<f64> + Sync),
    pitch: f64,
) -> Vec<f32> {
    let mut values = vec![0.0_f32; nx * ny * nz];
    values.par_chunks_mut(nx * ny * BLOCK).enumerate().for_each(|(bz, slab)| {
        let middle = (BLOCK as f64 - 1.0) / 2.0;
        // One sample beyond the block, where a neighbouring block's edge ends.
        let reach = (middle + 1.0) * 3.0_f64.sqrt() * pitch * STEEPEST;
        for by in 0..ny / BLOCK {
            for bx in 0..nx / BLOCK {
                let [cx, cy, cz] = [bx, by, bz].map(|b| (b * BLOCK) as f64 + middle);
                let centre = solid.distance(&at(cx, cy, cz));
                for dz in 0..BLOCK {
                    for dy in 0..BLOCK {
                        for dx in 0..BLOCK {
                            let (x, y) = (bx * BLOCK + dx, by * BLOCK + dy);
                            slab[(dz * ny + y) * nx + x] = if centre.abs() > reach {
                                centre as f32
                            } else {
                                let z = bz * BLOCK + dz;
                                solid.distance(&at(x as f64, y as f64, z as f64)) as f32
                            };
                        }
                    }
                }
            }
        }
    });
    values
}

/// Mean of the points where the surface crosses a cell's edges, in cells.
fn crossing(corner: impl Fn(usize) -> f32) -> Vector3<f64> {
    let mut sum = Vector3::zeros();
    let mut count = 0.0;
    for axis in 0..3 {
        for i in (0..8_usize).filter(|i| i & (1 << axis) == 0) {
            let (a, b) = (f64::from(corner(i)), f64::from(corner(i | 1 << axis)));
            if (a < 0.0) != (b < 0.0) {
                let mut p = Vector3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64);
                p[axis] += a / (a - b);
                sum += p;
                count += 1.0;
            }
        }
    }
    sum / f64::max(count, 1.0)
}

/// Moves vertices onto the surface and returns its normals there.
fn settle(solid: &impl Solid, vertices: &mut [Vector3<f64>], pitch: f64) -> Vec<Vector3<f64>> {
    vertices
        .par_iter_mut()
        .map(|p| {
            let gradient = solid.gradient(p);
            let per_metre = gradient / gradient.norm_squared().max(0.1);
            // The second step corrects the first along the same line, for a fifth of its price.
            for _ in 0..2 {
                let step = per_metre * solid.distance(p);
                // At creases the gradient misleads; no vertex may leave its neighbourhood.
                *p -= step.cap_magnitude(0.4 * pitch);
            }
            solid.gradient(p).try_normalize(1e-9).unwrap_or_else(Vector3::z)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::world::geometry::Ray;
    use crate::world::noise::KeyedRng;
    use crate::world::shapes::Shape;

    struct Ball;

    impl Solid for Ball {
        fn distance(&self, p: &Vector3<f64>) -> f64 {
            p.norm() - 0.1
        }
    }

    #[test]
    fn a_ball_comes_out_round_closed_and_outwards() {
        let half = Vector3::repeat(0.12);
        let mesh = Arc::new(mesh(&Ball, -half, half, 0.004));
        let triangles = mesh.triangles().expect("a mesh");
        assert!(triangles.vertices.iter().all(|v| (v.norm() - 0.1).abs() < 1e-9));
        for t in &triangles.indices {
            let [a, b, c] = t.map(|i| triangles.vertices[i as usize]);
            assert!((b - a).cross(&(c - a)).dot(&a) > 0.0, "facet faces inwards");
        }
        // Euler's formula for a closed surface without handles, at three edges per two facets.
        let (v, f) = (triangles.vertices.len(), triangles.indices.len());
        assert_eq!(v + f - 3 * f / 2, 2);
        let mut rng = KeyedRng::new(9);
        for _ in 0..2000 {
            let direction = Vector3::from_fn(|_, _| rng.symmetric()).normalize();
            let ray = Ray { origin: Vector3::zeros(), direction };
            let hit = mesh.intersect(&ray, 1.0).expect("closed");
            assert!((hit.distance_m - 0.1).abs() < 6e-5, "{}", hit.distance_m);
        }
    }
}
