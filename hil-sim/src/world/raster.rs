//! Which triangles a camera's cells can see, found by projecting the triangles instead of searching
//! for each ray.
//!
//! A mesh of small triangles covers each cell with a handful of them. Projecting every triangle once
//! and testing its rays in the cells that it may cover takes a tenth of the time that a ray takes to
//! find its way through the hierarchy. The test is the hierarchy's own, in double precision, so that
//! the surface seen is the same one.

use nalgebra::Vector3;

use super::gbuffer::View;
use super::geometry::{Ray, Rigid};
use super::trimesh::{Crossing, TriangleMesh};

/// Cells that a triangle may cover beyond its edges: rounding, and samples within the cells.
const MARGIN: f64 = 0.45;
/// The same as a share of the triangle's extent: lens distortion bends its edges.
const BEND: f64 = 0.02;
/// A mesh whose triangles may cover the view more often than this is left to the hierarchy: a test takes
/// about a hundredth of a search.
const MOST_VIEWS: f64 = 60.0;

/// The cells of a view that the triangles of a mesh may cover, in bands of rows.
pub(crate) struct Footprints {
    band_rows: usize,
    bands: Vec<Vec<Footprint>>,
}

/// The cells that a triangle may cover.
#[derive(Clone, Copy)]
struct Footprint {
    facet: u32,
    /// First, and one past the last.
    columns: [u16; 2],
    rows: [u16; 2],
    /// Of each edge: slopes along columns and rows, and value in the first of both. None is negative
    /// in cells that the triangle may cover.
    edges: [[f32; 3]; 3],
}

/// The nearest triangle on a ray, and where the ray crosses it.
pub(crate) type Seen = Option<(u32, Crossing)>;

impl Footprints {
    /// Projects a mesh. `None` where the hierarchy is the better way: a mesh that is partly behind the
    /// camera or beyond the lens' field, or few large triangles.
    pub fn new(
        mesh: &TriangleMesh,
        view: &View<'_>,
        pose: &Rigid,
        band_rows: usize,
    ) -> Option<Self> {
        let (columns, rows) = (view.columns(), view.rows());
        if columns > usize::from(u16::MAX) || rows > usize::from(u16::MAX) {
            return None;
        }
        let corners: Vec<[f64; 2]> = mesh
            .vertices()
            .iter()
            .map(|v| {
                let left = pose.rotation * v + pose.translation;
                let camera = view.left_from_camera.inverse_point(&left);
                view.camera.project(&camera).map(|pixel| pixel.map(|c| view.cell(c)))
            })
            .collect::<Option<_>>()?;
        let mut bands = vec![Vec::new(); rows.div_ceil(band_rows)];
        let most = MOST_VIEWS * (columns * rows) as f64;
        let mut covered = 0.0;
        for (facet, t) in mesh.corners().enumerate() {
            let span = |axis: usize| {
                let c = t.map(|i| corners[i as usize][axis]);
                [c[0].min(c[1]).min(c[2]), c[0].max(c[1]).max(c[2])]
            };
            let (x, y) = (span(0), span(1));
            let margin = MARGIN + BEND * (x[1] - x[0]).max(y[1] - y[0]);
            // Saturating casts: what lies outside has no cells.
            let cells = |[low, high]: [f64; 2], limit: usize| {
                let first = ((low - margin).ceil().max(0.0) as usize).min(limit);
                let end = ((high + margin).floor() + 1.0).max(0.0) as usize;
                [first as u16, end.min(limit).max(first) as u16]
            };
            let (columns, rows) = (cells(x, columns), cells(y, rows));
            let [[left, right], [top, bottom]] = [columns, rows].map(|r| r.map(usize::from));
            if left == right || top == bottom {
                continue;
            }
            let points = t.map(|i| corners[i as usize]);
            let edges = edges(points, [left as f64, top as f64], margin);
            let footprint = Footprint { facet: facet as u32, columns, rows, edges };
            covered += ((right - left) * (bottom - top)) as f64;
            if covered > most {
                return None;
            }
            for band in &mut bands[top / band_rows..=(bottom - 1) / band_rows] {
                band.push(footprint);
            }
        }
        Some(Self { band_rows, bands })
    }

    /// Calls `visit` with each triangle and each cell of the band that it may cover: triangle, column,
    /// row within the band.
    fn each(&self, band: usize, rows: usize, mut visit: impl FnMut(u32, usize, usize)) {
        let top = band * self.band_rows;
        for footprint in &self.bands[band] {
            let [first, end] = footprint.rows.map(usize::from);
            let [left, right] = footprint.columns.map(usize::from);
            for row in first.max(top)..end.min(top + rows) {
                let values =
                    footprint.edges.map(|[_, down, start]| start + down * (row - first) as f32);
                for column in left..right {
                    let across = (column - left) as f32;
                    let least = (0..3)
                        .map(|k| values[k] + footprint.edges[k][0] * across)
                        .fold(f32::INFINITY, f32::min);
                    if least >= 0.0 {
                        visit(footprint.facet, column, row - top);
                    }
                }
            }
        }
    }

    /// The nearest triangle in each cell of a band, row by row; `directions` are the band's, and `ray`
    /// makes a ray of the view of one.
    pub fn band(
        &self,
        mesh: &TriangleMesh,
        pose: &Rigid,
        band: usize,
        columns: usize,
        directions: &[[f32; 2]],
        ray: impl Fn([f32; 2]) -> Ray,
    ) -> Vec<Seen> {
        let rows = directions.len() / columns;
        let mut seen: Vec<Seen> = vec![None; directions.len()];
        if self.bands[band].is_empty() {
            return seen;
        }
        // Rays where there is anything to meet.
        let [mut left, mut right] = [columns, 0];
        for footprint in &self.bands[band] {
            left = left.min(usize::from(footprint.columns[0]));
            right = right.max(usize::from(footprint.columns[1]));
        }
        let width = right - left;
        let mut rays = Vec::with_capacity(width * rows);
        for row in 0..rows {
            let line = &directions[row * columns..][left..right];
            rays.extend(line.iter().map(|d| pose.inverse_ray(&ray(*d))));
        }
        self.each(band, rows, |facet, column, row| {
            let ray = &rays[row * width + column - left];
            nearer(mesh, facet, ray, &mut seen[row * columns + column]);
        });
        seen
    }

    /// The nearest triangle on each of the rays through the samples of some cells of a band.
    /// `slot_of` says which of them a cell is, row by row, `u32::MAX` for none; `rays` are in the
    /// mesh's frame, `rays_per_cell` for each.
    pub fn samples(
        &self,
        mesh: &TriangleMesh,
        band: usize,
        columns: usize,
        slot_of: &[u32],
        rays: &[Ray],
        rays_per_cell: usize,
    ) -> Vec<Seen> {
        let mut seen: Vec<Seen> = vec![None; rays.len()];
        self.each(band, slot_of.len() / columns, |facet, column, row| {
            let slot = slot_of[row * columns + column];
            if slot != u32::MAX {
                let first = slot as usize * rays_per_cell;
                for k in first..first + rays_per_cell {
                    nearer(mesh, facet, &rays[k], &mut seen[k]);
                }
            }
        });
        seen
    }
}

/// Lines along the edges of a triangle, moved outwards by `margin`: slopes and value at `first`, none of
/// which is negative within.
fn edges(points: [[f64; 2]; 3], first: [f64; 2], margin: f64) -> [[f32; 3]; 3] {
    let [a, b, c] = points;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    let side = if area < 0.0 { -1.0 } else { 1.0 };
    [(a, b), (b, c), (c, a)].map(|(from, to)| {
        let slopes = [side * (from[1] - to[1]), side * (to[0] - from[0])];
        let at_first = slopes[0] * (first[0] - from[0]) + slopes[1] * (first[1] - from[1]);
        // A square of cells around the edge, and what single precision rounds away.
        let outwards = margin * (slopes[0].abs() + slopes[1].abs());
        let rounding = 1e-5 * (at_first.abs() + outwards) + 1e-9;
        [slopes[0] as f32, slopes[1] as f32, (at_first + outwards + rounding) as f32]
    })
}

/// Keeps a triangle if the ray meets it before what it met so far.
fn nearer(mesh: &TriangleMesh, facet: u32, ray: &Ray, seen: &mut Seen) {
    let limit = seen.as_ref().map_or(f64::INFINITY, |(_, c)| c.distance_m);
    if let Some(crossing) = mesh.cross(facet as usize, ray, limit) {
        *seen = Some((facet, crossing));
    }
}

/// The triangles of a mesh by their direction from a point light, to find what is between the light
/// and a point.
///
/// All of a shadow ray lies in one direction from the light: only the triangles of that direction's
/// cell can be in its way.
pub(crate) struct ShadowGrid {
    /// Rows of the rotation into a frame at the light whose z points to the mesh.
    axes: [Vector3<f64>; 3],
    light: Vector3<f64>,
    low: [f64; 2],
    cells_per_unit: f64,
    size: [usize; 2],
    /// Start of each cell's entries, row by row, and one more.
    starts: Vec<u32>,
    /// Least distance of a triangle from the light along z, and the triangle.
    entries: Vec<(f32, u32)>,
}

/// Cells are this much larger on each side than they are, against rounding.
const SLACK: f64 = 1e-3;
/// A mesh whose triangles lie in more cells than this on average is left to the hierarchy.
const MOST_ENTRIES: usize = 32;

impl ShadowGrid {
    /// Sorts a mesh by direction from a light in its own frame. `None` where the hierarchy is the
    /// better way: a light close to the mesh or within it.
    pub fn new(mesh: &TriangleMesh, light: &Vector3<f64>) -> Option<Self> {
        let bounds = mesh.bounds();
        let middle = (bounds.min + bounds.max) / 2.0;
        let reach = (bounds.max - bounds.min).norm() / 2.0;
        let z = middle - light;
        if z.norm() < 1.2 * reach {
            return None;
        }
        let z = z.normalize();
        let helper = if z.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
        let x = z.cross(&helper).normalize();
        let axes = [x, z.cross(&x), z];
        let corners: Vec<[f64; 3]> = mesh
            .vertices()
            .iter()
            .map(|v| {
                let d = v - light;
                let depth = axes[2].dot(&d);
                [axes[0].dot(&d) / depth, axes[1].dot(&d) / depth, depth]
            })
            .collect();
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        for c in &corners {
            for axis in 0..2 {
                low[axis] = low[axis].min(c[axis]);
                high[axis] = high[axis].max(c[axis]);
            }
        }
        let extent = [high[0] - low[0], high[1] - low[1]];
        // About as many cells as there are triangles on the side that the light sees.
        let count = mesh.facet_count();
        let cells_per_unit = (count as f64 / 2.0 / (extent[0] * extent[1]).max(1e-12)).sqrt();
        let size = extent.map(|e| (e * cells_per_unit) as usize + 1);
        if !cells_per_unit.is_finite() || size[0].saturating_mul(size[1]) > 4 * count + 64 {
            return None;
        }
        let grid = Self {
            axes,
            light: *light,
            low,
            cells_per_unit,
            size,
            starts: Vec::new(),
            entries: Vec::new(),
        };
        grid.filled(mesh, &corners)
    }

    /// Counts the triangles of each cell, then puts them there.
    fn filled(mut self, mesh: &TriangleMesh, corners: &[[f64; 3]]) -> Option<Self> {
        let [width, height] = self.size;
        let span = |t: &[u32; 3], axis: usize| {
            let c = t.map(|i| (corners[i as usize][axis] - self.low[axis]) * self.cells_per_unit);
            let low = c[0].min(c[1]).min(c[2]) - SLACK;
            let high = c[0].max(c[1]).max(c[2]) + SLACK;
            let last = self.size[axis] - 1;
            [(low.max(0.0) as usize).min(last), (high.max(0.0) as usize).min(last)]
        };
        let mut starts = vec![0_u32; width * height + 1];
        let mut total = 0;
        for t in mesh.corners() {
            let ([x0, x1], [y0, y1]) = (span(&t, 0), span(&t, 1));
            total += (x1 - x0 + 1) * (y1 - y0 + 1);
            if total > MOST_ENTRIES * mesh.facet_count() {
                return None;
            }
            for y in y0..=y1 {
                starts[y * width + x0 + 1..=y * width + x1 + 1].iter_mut().for_each(|n| *n += 1);
            }
        }
        for i in 0..width * height {
            starts[i + 1] += starts[i];
        }
        let mut next = starts.clone();
        let mut entries = vec![(0.0_f32, 0_u32); starts[width * height] as usize];
        for (facet, t) in mesh.corners().enumerate() {
            let ([x0, x1], [y0, y1]) = (span(&t, 0), span(&t, 1));
            let depth = t.map(|i| corners[i as usize][2]);
            let depth = (depth[0].min(depth[1]).min(depth[2]) as f32).next_down();
            for y in y0..=y1 {
                for slot in &mut next[y * width + x0..=y * width + x1] {
                    entries[*slot as usize] = (depth, facet as u32);
                    *slot += 1;
                }
            }
        }
        self.starts = starts;
        self.entries = entries;
        Some(self)
    }

    /// Whether a triangle is between the light and the start of `ray`, which points at the light,
    /// `distance_m` away.
    pub fn is_shadowed(&self, mesh: &TriangleMesh, ray: &Ray, distance_m: f64) -> bool {
        let d = ray.origin - self.light;
        let depth = self.axes[2].dot(&d);
        if depth <= 0.0 {
            // Behind the light's mesh side: nothing of the mesh is there.
            return false;
        }
        let cell = |axis: usize| {
            let at = (self.axes[axis].dot(&d) / depth - self.low[axis]) * self.cells_per_unit;
            // Within the slack of the border the outermost cells hold what there is.
            let last = self.size[axis] as f64;
            (at > -SLACK && at < last + SLACK)
                .then(|| (at.max(0.0) as usize).min(self.size[axis] - 1))
        };
        let (Some(x), Some(y)) = (cell(0), cell(1)) else { return false };
        let index = y * self.size[0] + x;
        let range = self.starts[index] as usize..self.starts[index + 1] as usize;
        self.entries[range].iter().any(|(nearest, facet)| {
            f64::from(*nearest) < depth && mesh.cross(*facet as usize, ray, distance_m).is_some()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::noise::KeyedRng;
    use crate::world::shapes::Shape;
    use crate::world::{SensorModel, statue};
    use nalgebra::Isometry3;

    const BAND: usize = 16;

    fn pose() -> Rigid {
        let axis_angle = Vector3::new(3.0, 0.2, 0.3);
        Rigid::from(&Isometry3::new(Vector3::new(0.02, -0.01, 1.1), axis_angle))
    }

    #[test]
    fn projecting_sees_what_searching_sees() {
        let mesh = statue::statue();
        let camera = SensorModel::default().scaled_down(8).left;
        let left = Rigid::from(&Isometry3::identity());
        let view = View { camera: &camera, left_from_camera: left, margin: 5 };
        let directions = view.directions();
        let (columns, pose) = (view.columns(), pose());
        let footprints = Footprints::new(&mesh, &view, &pose, BAND).expect("in view");
        let ray = |d: [f32; 2]| view.ray(d.map(f64::from));
        let mut met = 0;
        for (band, directions) in directions.chunks(columns * BAND).enumerate() {
            let seen = footprints.band(&mesh, &pose, band, columns, directions, ray);
            for (seen, direction) in seen.iter().zip(directions) {
                let searched = mesh.intersect(&pose.inverse_ray(&ray(*direction)), 50.0);
                let seen = seen.as_ref().map(|(_, crossing)| crossing.distance_m);
                met += usize::from(seen.is_some());
                assert_eq!(seen, searched.map(|hit| hit.distance_m), "towards {direction:?}");
            }
        }
        assert!(met > 5000, "{met}");
    }

    #[test]
    fn what_the_hierarchy_shadows_the_grid_shadows() {
        let mesh = statue::statue();
        let mut rng = KeyedRng::new(2);
        let count = mesh.facet_count();
        let mut shadowed = 0;
        for light in [Vector3::new(0.3, 0.1, 1.2), Vector3::new(-0.9, 0.5, -0.4)] {
            let grid = ShadowGrid::new(&mesh, &light).expect("far enough");
            for (vertex, _) in mesh.vertices().iter().zip(0..count).step_by(37) {
                let origin = vertex + Vector3::from_fn(|_, _| 2e-3 * rng.symmetric());
                let to_light = light - origin;
                let distance = to_light.norm();
                let ray = Ray { origin, direction: to_light / distance };
                let expected = mesh.occludes(&ray, distance);
                shadowed += usize::from(expected);
                if grid.is_shadowed(&mesh, &ray, distance) != expected {
                    // The hierarchy does not look at the first 0.1 mm of a ray.
                    let nearest = (0..count)
                        .filter_map(|facet| mesh.cross(facet, &ray, distance))
                        .map(|crossing| crossing.distance_m)
                        .fold(f64::INFINITY, f64::min);
                    assert!(!expected && nearest < 1e-4, "{origin:?}: {expected} {nearest}");
                }
            }
        }
        assert!(shadowed > 1000 && shadowed < 2 * count / 37, "{shadowed}");
        assert!(ShadowGrid::new(&mesh, &Vector3::new(0.1, 0.0, 0.1)).is_none());
    }
}
