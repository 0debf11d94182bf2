//! A triangle mesh as a surface: closest points by a tree of bounding boxes.

use super::RegisterError;
use super::surface::{Closest, Surface};
use nalgebra::{Point3, Vector3};

/// Triangles in a tree of axis-aligned boxes; need not be watertight.
pub struct MeshSurface {
    triangles: Vec<[Point3<f64>; 3]>,
    nodes: Vec<Node>,
}

/// A node of the tree: children of an inner node follow each other at `first`.
struct Node {
    low: Vector3<f64>,
    high: Vector3<f64>,
    /// First triangle of a leaf, or first child.
    first: usize,
    /// Triangles of a leaf; 0 for an inner node.
    count: usize,
}

const LEAF: usize = 4;

impl MeshSurface {
    /// Takes the triangles with finite corners and an area.
    ///
    /// # Errors
    /// [`RegisterError::EmptyMesh`].
    pub fn new(
        triangles: impl IntoIterator<Item = [Point3<f64>; 3]>,
    ) -> Result<Self, RegisterError> {
        let mut triangles: Vec<_> = triangles
            .into_iter()
            .filter(|t| t.iter().all(|p| p.coords.iter().all(|c| c.is_finite())))
            .filter(|[a, b, c]| (b - a).cross(&(c - a)).norm() > 0.0)
            .collect();
        if triangles.is_empty() {
            return Err(RegisterError::EmptyMesh);
        }
        let count = triangles.len();
        let mut nodes = vec![bounds(&triangles, 0, count)];
        let mut pending = vec![0];
        while let Some(index) = pending.pop() {
            let (first, count) = (nodes[index].first, nodes[index].count);
            if count <= LEAF {
                continue;
            }
            let axis = (nodes[index].high - nodes[index].low).imax();
            let half = count / 2;
            triangles[first..first + count].select_nth_unstable_by(half, |a, b| {
                let middle = |t: &[Point3<f64>; 3]| t.iter().map(|p| p[axis]).sum::<f64>();
                middle(a).total_cmp(&middle(b))
            });
            let children = nodes.len();
            nodes.push(bounds(&triangles, first, half));
            nodes.push(bounds(&triangles, first + half, count - half));
            nodes[index].first = children;
            nodes[index].count = 0;
            pending.extend([children, children + 1]);
        }
        Ok(Self { triangles, nodes })
    }

    /// The triangles, in the tree's order.
    pub fn triangles(&self) -> &[[Point3<f64>; 3]] {
        &self.triangles
    }
}

impl Surface for MeshSurface {
    fn closest(&self, query_m: &Point3<f64>, max_distance_m: f64) -> Option<Closest> {
        let mut best = max_distance_m * max_distance_m;
        let mut found = None;
        // Depth of the tree is at most log2 of the triangles: halves are even.
        let mut pending = Vec::with_capacity(64);
        pending.push((distance_squared(&self.nodes[0], query_m), 0));
        while let Some((distance, index)) = pending.pop() {
            if distance > best {
                continue;
            }
            let node = &self.nodes[index];
            if node.count > 0 {
                for (i, triangle) in self.triangles[node.first..][..node.count].iter().enumerate() {
                    let point = closest_on_triangle(query_m, triangle);
                    let squared = (query_m - point).norm_squared();
                    if squared <= best {
                        best = squared;
                        found = Some((point, node.first + i));
                    }
                }
            } else {
                let mut children = [node.first, node.first + 1]
                    .map(|child| (distance_squared(&self.nodes[child], query_m), child));
                // The nearer child last, so that it is taken first and narrows the search.
                if children[0].0 < children[1].0 {
                    children.swap(0, 1);
                }
                pending.extend(children);
            }
        }
        found.map(|(point_m, triangle)| {
            let [a, b, c] = &self.triangles[triangle];
            let normal = (b - a).cross(&(c - a)).normalize();
            Closest { point_m, normal, distance_m: best.sqrt() }
        })
    }
}

fn bounds(triangles: &[[Point3<f64>; 3]], first: usize, count: usize) -> Node {
    let mut low = Vector3::repeat(f64::INFINITY);
    let mut high = Vector3::repeat(f64::NEG_INFINITY);
    for point in triangles[first..first + count].iter().flatten() {
        low = low.inf(&point.coords);
        high = high.sup(&point.coords);
    }
    Node { low, high, first, count }
}

fn distance_squared(node: &Node, query: &Point3<f64>) -> f64 {
    let outside = (node.low - query.coords).sup(&(query.coords - node.high)).sup(&Vector3::zeros());
    outside.norm_squared()
}

/// The point of a triangle closest to `p`, by the region of the triangle's plane that `p` is over
/// (Ericson, Real-Time Collision Detection, section 5.1.5).
fn closest_on_triangle(p: &Point3<f64>, [a, b, c]: &[Point3<f64>; 3]) -> Point3<f64> {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return *a;
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return *b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return *c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let sum = va + vb + vc;
    a + ab * (vb / sum) + ac * (vc / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Closest point by a fine sampling of the triangle: slow and obvious.
    fn sampled(p: &Point3<f64>, [a, b, c]: &[Point3<f64>; 3]) -> f64 {
        let n = 200;
        (0..=n)
            .flat_map(|i| (0..=n - i).map(move |j| (i as f64 / n as f64, j as f64 / n as f64)))
            .map(|(u, v)| (p - (a + (b - a) * u + (c - a) * v)).norm())
            .fold(f64::INFINITY, f64::min)
    }

    /// A small generator, so that the test needs no dependency.
    fn noise(state: &mut u64) -> f64 {
        *state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (*state >> 33) as f64 / f64::from(1u32 << 30) - 1.0
    }

    #[test]
    fn closest_agrees_with_sampling_over_all_triangles() {
        let mut state = 7;
        let mut point = || Point3::from(Vector3::from_fn(|_, _| noise(&mut state)));
        let triangles: Vec<_> = (0..40).map(|_| [point(), point(), point()]).collect();
        let mesh = MeshSurface::new(triangles.clone()).unwrap();
        for _ in 0..50 {
            let query = point();
            let found = mesh.closest(&query, f64::INFINITY).unwrap();
            let slow = triangles.iter().map(|t| sampled(&query, t)).fold(f64::INFINITY, f64::min);
            assert!(found.distance_m <= slow + 1e-12, "{} > {slow}", found.distance_m);
            assert!(slow - found.distance_m < 0.02, "{} < {slow}", found.distance_m);
            assert!(((query - found.point_m).norm() - found.distance_m).abs() < 1e-12);
        }
    }

    #[test]
    fn meshes_without_area_are_refused() {
        let line = [Point3::origin(), Point3::new(1.0, 0.0, 0.0), Point3::new(2.0, 0.0, 0.0)];
        assert_eq!(MeshSurface::new([line]).err(), Some(RegisterError::EmptyMesh));
        let nan = [Point3::new(f64::NAN, 0.0, 0.0), line[1], Point3::new(0.0, 1.0, 0.0)];
        assert_eq!(MeshSurface::new([nan]).err(), Some(RegisterError::EmptyMesh));
    }
}
