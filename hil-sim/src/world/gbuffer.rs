//! What each camera sees, before any light: the surface behind every half pixel.
//!
//! The image plane is sampled on a grid of cells of half a pixel. The finest dots that the camera
//! resolves are band limited far below this grid, so summing cells with the lens' and pixel's
//! response (see [`super::psf`]) gives the irradiance without aliasing. Where the grid would alias, at
//! edges of objects and prints, the cell is sampled up to 16 times more finely.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::camera::CameraModel;
use super::geometry::{Ray, Rigid};
use super::raster::{Footprints, Seen};
use super::scene::PosedScene;

/// Cells per pixel in each direction.
pub(crate) const CELLS_PER_PIXEL: usize = 2;
/// Samples along one side of a refined cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Refinement {
    /// 4: an edge is placed to 1/8 px, and to much less on average along its length.
    Sharp = 4,
    /// 2: enough for a view that is blurred by motion.
    Coarse = 2,
}
/// Rows that are looked at together.
const BAND: usize = 16;
/// Nothing is looked for beyond this distance.
const FARTHEST_M: f64 = 50.0;

/// A camera in the scene.
pub(crate) struct View<'a> {
    pub camera: &'a CameraModel,
    pub left_from_camera: Rigid,
    /// Cells around the image, from which the lens blurs light into it.
    pub margin: usize,
}

impl View<'_> {
    pub fn columns(&self) -> usize {
        CELLS_PER_PIXEL * self.camera.width + 2 * self.margin
    }

    pub fn rows(&self) -> usize {
        CELLS_PER_PIXEL * self.camera.height + 2 * self.margin
    }

    /// Pixel coordinate of a cell's centre, given the cell's index along the same axis.
    fn pixel(&self, cell: f64) -> f64 {
        (cell - self.margin as f64 + 0.5) / CELLS_PER_PIXEL as f64 - 0.5
    }

    /// The inverse of [`Self::pixel`].
    pub fn cell(&self, pixel: f64) -> f64 {
        (pixel + 0.5) * CELLS_PER_PIXEL as f64 - 0.5 + self.margin as f64
    }

    /// Normalised coordinates (x/z, y/z) of the ray through each cell's centre. In single precision:
    /// that moves a ray by less than 0.0001 px.
    pub fn directions(&self) -> Vec<[f32; 2]> {
        let columns = self.columns();
        let mut directions = vec![[0.0_f32; 2]; columns * self.rows()];
        directions.par_chunks_mut(columns).enumerate().for_each(|(row, line)| {
            let v = self.pixel(row as f64);
            let mut near = self.camera.unproject([self.pixel(0.0), v]);
            for (column, direction) in line.iter_mut().enumerate() {
                near = self.camera.unproject_from([self.pixel(column as f64), v], near);
                *direction = near.map(|c| c as f32);
            }
        });
        directions
    }

    pub fn ray(&self, normalised: [f64; 2]) -> Ray {
        let direction = Vector3::new(normalised[0], normalised[1], 1.0).normalize();
        Ray {
            origin: self.left_from_camera.translation,
            direction: self.left_from_camera.vector(&direction),
        }
    }
}

/// The surface seen at one sample. Kept small: a full-resolution view has five million.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sample {
    /// In the left camera's frame. Rounding to f32 moves a point by at most 0.12 micrometres at 2 m,
    /// less than 0.0002 px.
    point: [f32; 3],
    normal: [i16; 3],
    albedo: u16,
    object: u16,
    is_edge: bool,
}

const NO_OBJECT: u16 = u16::MAX;

impl Sample {
    const NOTHING: Self =
        Self { point: [0.0; 3], normal: [0; 3], albedo: 0, object: NO_OBJECT, is_edge: false };

    pub fn is_surface(&self) -> bool {
        self.object != NO_OBJECT
    }

    pub fn object(&self) -> usize {
        usize::from(self.object)
    }

    pub fn point(&self) -> Vector3<f64> {
        Vector3::new(f64::from(self.point[0]), f64::from(self.point[1]), f64::from(self.point[2]))
    }

    pub fn normal(&self) -> Vector3<f64> {
        let n = self.normal.map(|v| f64::from(v) * (1.0 / 32767.0));
        Vector3::new(n[0], n[1], n[2])
    }

    pub fn albedo(&self) -> f64 {
        f64::from(self.albedo) * (1.0 / 65535.0)
    }

    /// Whether a neighbouring cell shows another piece of surface.
    pub fn is_edge(&self) -> bool {
        self.is_edge
    }

    /// Whether the surface between two neighbouring samples is one smooth piece.
    fn continues_to(&self, other: &Self) -> bool {
        if self.object != other.object || self.albedo.abs_diff(other.albedo) >= 2000 {
            return false;
        }
        if !self.is_surface() {
            return true;
        }
        let step = [0, 1, 2].map(|k| other.point[k] - self.point[k]);
        let [n, m] = [self, other].map(|s| s.normal.map(|v| f32::from(v) * (1.0 / 32767.0)));
        let dot = |a: &[f32; 3], b: &[f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        // A smooth surface stays near the tangent planes, even one seen at 80 degrees (where
        // neighbours are six cells' widths apart); a step leaves both.
        let rise = dot(&step, &n).abs().min(dot(&step, &m).abs());
        let allowed2 = 0.1225 * dot(&step, &step) + 1e-12;
        rise * rise <= allowed2 && dot(&n, &m) > 0.75
    }
}

/// All samples of a view.
pub(crate) struct GBuffer {
    pub columns: usize,
    pub cells: Vec<Sample>,
    /// Indices of the refined cells, ascending.
    pub refined: Vec<u32>,
    /// `fine_per_cell` samples for each refined cell.
    pub fine: Vec<Sample>,
    pub fine_per_cell: usize,
}

impl GBuffer {
    /// Looks along `directions`, which are the view's own.
    pub fn new(
        view: &View<'_>,
        directions: &[[f32; 2]],
        scene: &PosedScene<'_>,
        refinement: Refinement,
    ) -> Self {
        let side = refinement as usize;
        let fine_per_cell = side * side;
        let (columns, rows) = (view.columns(), view.rows());
        let footprints: Vec<Option<Footprints>> = scene
            .parts()
            .map(|(shape, pose)| Footprints::new(shape.mesh()?, view, pose, BAND))
            .collect();
        let ray = |direction: [f32; 2]| view.ray(direction.map(f64::from));
        let mut cells = vec![Sample::NOTHING; columns * rows];
        cells
            .par_chunks_mut(columns * BAND)
            .zip(directions.par_chunks(columns * BAND))
            .enumerate()
            .for_each(|(band, (cells, directions))| {
                let seen: Vec<Option<Vec<Seen>>> = scene
                    .parts()
                    .zip(&footprints)
                    .map(|((shape, pose), footprints)| {
                        let mesh = shape.mesh()?;
                        Some(footprints.as_ref()?.band(mesh, pose, band, columns, directions, ray))
                    })
                    .collect();
                for (k, (cell, direction)) in cells.iter_mut().zip(directions).enumerate() {
                    let known = |object: usize| seen[object].as_ref().map(|seen| seen[k]);
                    *cell = look(scene, &ray(*direction), known);
                }
            });
        // Which cells do not continue to the right (1) or down (2): both sides are edges.
        let breaks: Vec<u8> = (0..rows)
            .into_par_iter()
            .flat_map_iter(|row| {
                let cells = &cells;
                (0..columns).map(move |column| {
                    let cell = &cells[row * columns + column];
                    let right = column + 1 < columns
                        && !cell.continues_to(&cells[row * columns + column + 1]);
                    let down =
                        row + 1 < rows && !cell.continues_to(&cells[(row + 1) * columns + column]);
                    u8::from(right) | u8::from(down) << 1
                })
            })
            .collect();
        let is_edge = |index: usize| {
            breaks[index] != 0
                || (!index.is_multiple_of(columns) && breaks[index - 1] & 1 != 0)
                || (index >= columns && breaks[index - columns] & 2 != 0)
        };
        let refined: Vec<u32> =
            (0..cells.len()).filter(|&index| is_edge(index)).map(|index| index as u32).collect();
        for &index in &refined {
            cells[index as usize].is_edge = true;
        }
        let fine = (0..rows.div_ceil(BAND))
            .into_par_iter()
            .flat_map_iter(|band| fine_of_band(view, scene, &footprints, &refined, side, band))
            .collect();
        Self { columns, cells, refined, fine, fine_per_cell }
    }
}

/// The samples of the refined cells in one band of rows, `side` along each side of a cell.
fn fine_of_band(
    view: &View<'_>,
    scene: &PosedScene<'_>,
    footprints: &[Option<Footprints>],
    refined: &[u32],
    side: usize,
    band: usize,
) -> Vec<Sample> {
    let columns = view.columns();
    let first_cell = band * BAND * columns;
    let end_cell = (first_cell + BAND * columns).min(columns * view.rows());
    let at = |cell: usize| refined.partition_point(|&index| (index as usize) < cell);
    let refined = &refined[at(first_cell)..at(end_cell)];
    if refined.is_empty() {
        return Vec::new();
    }
    let offset = |k: usize| (k as f64 + 0.5) / side as f64 - 0.5;
    let mut rays = Vec::with_capacity(refined.len() * side * side);
    let mut slot_of = vec![u32::MAX; end_cell - first_cell];
    for (slot, &index) in refined.iter().enumerate() {
        slot_of[index as usize - first_cell] = slot as u32;
        let (row, column) = (index as usize / columns, index as usize % columns);
        let near = view.camera.unproject([view.pixel(column as f64), view.pixel(row as f64)]);
        rays.extend((0..side * side).map(|k| {
            let pixel = [
                view.pixel(column as f64 + offset(k % side)),
                view.pixel(row as f64 + offset(k / side)),
            ];
            view.ray(view.camera.unproject_from(pixel, near))
        }));
    }
    let seen: Vec<Option<Vec<Seen>>> = scene
        .parts()
        .zip(footprints)
        .map(|((shape, pose), footprints)| {
            let rays: Vec<Ray> = rays.iter().map(|ray| pose.inverse_ray(ray)).collect();
            let (mesh, footprints) = (shape.mesh()?, footprints.as_ref()?);
            Some(footprints.samples(mesh, band, columns, &slot_of, &rays, side * side))
        })
        .collect();
    let known = |k: usize, object: usize| seen[object].as_ref().map(|seen| seen[k]);
    rays.iter().enumerate().map(|(k, ray)| look(scene, ray, |object| known(k, object))).collect()
}

fn look(scene: &PosedScene<'_>, ray: &Ray, known: impl Fn(usize) -> Option<Seen>) -> Sample {
    let Some((object, hit)) = scene.nearest_with(ray, FARTHEST_M, known) else {
        return Sample::NOTHING;
    };
    let point = ray.at(hit.distance_m);
    let albedo = scene.albedo(object, &point).clamp(0.0, 1.0);
    Sample {
        point: [point.x as f32, point.y as f32, point.z as f32],
        // Rounding by truncation of positive numbers: a library call would take as long as the ray.
        normal: [hit.normal.x, hit.normal.y, hit.normal.z]
            .map(|v| ((v * 32767.0 + 32768.5) as i32 - 32768) as i16),
        albedo: (albedo * 65535.0 + 0.5) as u16,
        object: object as u16,
        is_edge: false,
    }
}
