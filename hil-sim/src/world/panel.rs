//! A large curved panel of 0.87 x 0.63 m like a car door's skin (paper, Figure 8): gentle curvature,
//! crease lines, a handle's recess, a window's edge.

use std::sync::{Arc, OnceLock};

use nalgebra::Vector3;

use super::trimesh::{TriangleMesh, Triangles};

const WIDTH_M: f64 = 0.87;
const HEIGHT_M: f64 = 0.63;
/// Distance of neighbouring vertices, about.
const PITCH_M: f64 = 0.002;

/// The panel: x to the right, y down, z away from the viewer. Made once and shared.
pub(crate) fn panel() -> Arc<TriangleMesh> {
    static PANEL: OnceLock<Arc<TriangleMesh>> = OnceLock::new();
    PANEL.get_or_init(|| Arc::new(build())).clone()
}

fn build() -> TriangleMesh {
    let columns = (WIDTH_M / PITCH_M) as usize + 1;
    let rows = (HEIGHT_M / PITCH_M) as usize + 1;
    let mut triangles = Triangles::default();
    let mut normals = Vec::with_capacity(columns * rows);
    for row in 0..rows {
        for column in 0..columns {
            let s = column as f64 / (columns - 1) as f64;
            let t = row as f64 / (rows - 1) as f64;
            let x = (s - 0.5) * WIDTH_M;
            // Lines of vertices follow the window's edge, so that it is smooth.
            let y = top(x) + t * (HEIGHT_M / 2.0 - top(x));
            triangles.vertices.push(Vector3::new(x, y, depth(x, y)));
            const STEP: f64 = 1e-5;
            let slope_x = (depth(x + STEP, y) - depth(x - STEP, y)) / (2.0 * STEP);
            let slope_y = (depth(x, y + STEP) - depth(x, y - STEP)) / (2.0 * STEP);
            normals.push(Vector3::new(slope_x, slope_y, -1.0).normalize());
        }
    }
    for row in 0..rows - 1 {
        for column in 0..columns - 1 {
            let a = (row * columns + column) as u32;
            let [b, c, d] = [a + 1, a + columns as u32, a + columns as u32 + 1];
            triangles.indices.extend([[a, b, c], [b, d, c]]);
        }
    }
    TriangleMesh::with_normals(triangles, &normals)
}

/// The upper edge: the window's sill, dropping to the right where the mirror sits.
fn top(x: f64) -> f64 {
    -HEIGHT_M / 2.0 + 0.015 + 0.03 * (x / 0.4).powi(2) + 0.10 * rise((x - 0.33) / 0.05)
}

/// 0 to 1 smoothly around 0.
fn rise(v: f64) -> f64 {
    0.5 * (1.0 + v.tanh())
}

/// A fold along the line where `distance` is 0, rounded over `radius`.
fn fold(distance: f64, radius: f64) -> f64 {
    distance.hypot(radius) - radius
}

fn depth(x: f64, y: f64) -> f64 {
    // Barrel shape, stronger from sill to bottom than along the car.
    let mut z = x * x / (2.0 * 3.0) + (y - 0.05).powi(2) / (2.0 * 1.1);
    // Two crease lines, the lower one fading out to the front.
    z += 0.10 * fold(y + 0.085 - 0.06 * x - 0.05 * x * x, 0.004);
    let fading = rise((0.25 - x) / 0.08);
    z -= 0.14 * fading * (fold(y - 0.165 + 0.05 * x, 0.003) - fold(y - 0.205 + 0.05 * x, 0.003));
    // The handle's recess: a pocket with steep flanks and a bowl-shaped floor.
    let (hx, hy) = ((x + 0.24) / 0.062, (y + 0.035) / 0.026);
    let inside = 1.0 - (hx.powi(4) + hy.powi(4)).powf(0.25);
    z += 0.019 * rise(inside / 0.06) * (1.0 - 0.25 * (hx * hx + hy * hy).min(1.0));
    // The lip under the window turns inwards.
    let from_sill = y - top(x);
    z += 0.012 * (-(from_sill / 0.006)).exp().min(1.0);
    // A keyhole's cover: a low disc with a small flank.
    let disc = 0.011 - (x + 0.345).hypot(y + 0.035);
    z - 0.0025 * rise(disc / 0.0006)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::geometry::Ray;
    use crate::world::shapes::Shape;

    #[test]
    fn the_panel_has_its_size_and_its_mesh_follows_the_formula() {
        let panel = panel();
        let t = panel.triangles().expect("a mesh");
        let width = |k: usize| {
            let of = |f: fn(f64, f64) -> f64, start| t.vertices.iter().map(|v| v[k]).fold(start, f);
            of(f64::max, f64::MIN) - of(f64::min, f64::MAX)
        };
        assert!((width(0) - 0.87).abs() < 1e-9 && (width(1) - 0.615).abs() < 0.02);
        let mut worst = 0.0_f64;
        for i in 0..200 {
            let x = -0.42 + 0.0042 * f64::from(i);
            let y = 0.25 * (f64::from(i) * 0.7).sin() + 0.05;
            let ray = Ray { origin: Vector3::new(x, y, -1.0), direction: Vector3::z() };
            if let Some(hit) = panel.intersect(&ray, 3.0) {
                worst = worst.max((hit.distance_m - 1.0 - depth(x, y)).abs());
            }
        }
        assert!(worst < 5e-4, "{worst}");
    }
}
