//! Resampling of one camera's raw image onto its rectified canvas.
//!
//! The two-dimensional warp is done as two one-dimensional ones (Catmull and Smith, 1980): first along
//! the raw rows to the columns of the canvas, then along those columns to its rows. Each is exact for a
//! continuous picture, so that 8 + 8 taps do what 8 x 8 would. The picture between the two is kept
//! transposed, and both passes are the same loop over contiguous samples.

use std::sync::Arc;

use nalgebra::{Rotation3, Vector2, Vector3};
use rayon::prelude::*;
use stspp_matcher::{Image, Sample};

use super::dot;
use super::kernel::{PHASE_BITS, TAPS, TAPS_BEFORE, fixed_point};
use crate::raw::RawPixels;
use crate::{CameraIntrinsics, RawImage};

/// Fraction bits of the taps.
const TAP_BITS: u32 = 14;
/// Canvas rows (or raw rows) that a task handles, so that a band of the transposed picture stays in
/// the second-level cache.
const BAND: usize = 32;

/// Positions of first taps in a padded line, in 2^-10 pixels.
type Position = u32;

/// A virtual camera's view of a real one's image.
pub(super) struct Warp {
    /// Per canvas column and raw row: where in the (padded) raw row.
    along_rows: Vec<Position>,
    /// Per canvas row and column: where in the (padded) column of the picture between.
    along_columns: Vec<Position>,
    raw_px: [usize; 2],
    canvas_px: [usize; 2],
    /// Non-zero where the camera saw.
    pub mask: Image<u8>,
    exact_taps: Arc<[[f64; TAPS]]>,
    /// Taps of sum 2^14.
    taps: Vec<[i16; TAPS]>,
}

/// Working memory of a warp; any number of warps of any size can share one.
#[derive(Debug, Default)]
pub struct RectifyScratch {
    between: Vec<i16>,
}

/// A virtual camera: where canvas pixels are on the real one.
pub(super) struct Virtual {
    pub camera: CameraIntrinsics,
    pub rect_from_camera: Rotation3<f64>,
    pub focal_px: f64,
    pub cx_px: f64,
    pub cy_px: f64,
    pub canvas_px: [usize; 2],
    /// Largest distance from the optical axis, in undistorted normalised units, that the image shows.
    pub radius_max: f64,
}

impl Virtual {
    /// Raw position of canvas position (`u`, `v`); outside the image where the camera does not see.
    pub fn raw_px(&self, u: f64, v: f64) -> Vector2<f64> {
        let ray_rect =
            Vector3::new((u - self.cx_px) / self.focal_px, (v - self.cy_px) / self.focal_px, 1.0);
        let ray = self.rect_from_camera.inverse_transform_vector(&ray_rect);
        if ray.z <= 0.01 {
            return Vector2::repeat(f64::MAX);
        }
        // Beyond its border the polynomial may fold back into the image: it is followed only a little
        // way out, and what is farther stays there.
        let (p, radius_max) = (ray.xy() / ray.z, 1.05 * self.radius_max);
        let beyond = p.norm() / radius_max;
        self.camera.project_normalised(if beyond > 1.0 { p / beyond } else { p })
    }
}

/// First tap of the kernel around raw coordinate `at`, in a line padded by [`TAPS_BEFORE`] before and
/// as much as needed behind, clamped into it.
fn position(at: f64, size: usize) -> Position {
    let clamped = at.clamp(0.0, (size - 1) as f64);
    (clamped * f64::from(1 << PHASE_BITS)).round() as Position
}

impl Warp {
    pub fn new(view: &Virtual, exact_taps: &Arc<[[f64; TAPS]]>) -> Self {
        let raw_px = view.camera.resolution_px;
        let canvas_px = view.canvas_px;
        let ([raw_w, raw_h], [w, h]) = (raw_px, canvas_px);
        // Where the canvas columns are on the raw image; the taps of the border rows reach beyond.
        let beyond = TAPS as i64;
        let rows = (h as i64 + 2 * beyond) as usize;
        let mut along_rows = vec![0; w * raw_h];
        let mut columns = vec![0 as Position; w * h];
        let mut seen = vec![0_u8; w * h];
        along_rows
            .par_chunks_mut(raw_h)
            .zip(columns.par_chunks_mut(h))
            .zip(seen.par_chunks_mut(h))
            .enumerate()
            .for_each(|(u, ((x_of_row, y_of_v), seen))| {
                let path: Vec<Vector2<f64>> =
                    (0..rows as i64).map(|k| view.raw_px(u as f64, (k - beyond) as f64)).collect();
                for v in 0..h {
                    let p = path[v + beyond as usize];
                    y_of_v[v] = position(p.y, raw_h);
                    let inside = (0.0..=(raw_w - 1) as f64).contains(&p.x)
                        && (0.0..=(raw_h - 1) as f64).contains(&p.y);
                    seen[v] = u8::from(inside);
                }
                x_of_rows(&path, raw_w, x_of_row);
            });
        let (along_columns, seen) = (transposed(&columns, h), transposed(&seen, h));
        let mask = Image::from_vec(w, h, seen).unwrap_or_else(|| Image::new(w, h, 0));
        let (exact_taps, taps) = (Arc::clone(exact_taps), fixed_point(exact_taps, 1.0));
        Self { along_rows, along_columns, raw_px, canvas_px, mask, exact_taps, taps }
    }

    /// Resamples `raw`, whose size must be the calibration's, into `out`, whose size must be the
    /// canvas's.
    pub fn apply(&self, raw: &RawImage, out: &mut Image<Sample>, scratch: &mut RectifyScratch) {
        let ([raw_w, raw_h], [w, _]) = (self.raw_px, self.canvas_px);
        let padded_h = raw_h + TAPS;
        scratch.between.resize(w * padded_h, 0);
        // Full scale is 255 * 64 whatever the camera's bits. 16 bits are halved to fit the taps' i16.
        let bits = u32::from(raw.bits.clamp(1, 16));
        let used_bits = bits.min(15);
        let full = f64::from((1_u32 << bits) - 1) / f64::from(1_u32 << (bits - used_bits));
        let scale = 255.0 * 64.0 / full / 2_f64.powi(14 - used_bits as i32);
        let table;
        let taps = if bits == 8 {
            &self.taps
        } else {
            table = fixed_point(&self.exact_taps, scale);
            &table
        };
        let shift = if bits == 8 { TAP_BITS - 6 } else { used_bits };
        let lines = Lines { raw, width: raw_w, halve: bits > used_bits };
        self.to_columns(&lines, taps, shift, &mut scratch.between);
        self.to_rows(&scratch.between, out);
    }

    /// First pass: raw rows to canvas columns, transposed.
    fn to_columns(&self, lines: &Lines<'_>, taps: &[[i16; TAPS]], shift: u32, between: &mut [i16]) {
        let ([raw_w, raw_h], padded_h) = (self.raw_px, self.raw_px[1] + TAPS);
        // All raw rows, padded and as i16, once; the tasks share them.
        let stride = raw_w + TAPS;
        let mut padded = vec![0_i16; stride * raw_h];
        padded.par_chunks_mut(stride * BAND).enumerate().for_each(|(band, rows)| {
            for (k, row) in rows.chunks_mut(stride).enumerate() {
                lines.read(band * BAND + k, row);
            }
        });
        between.par_chunks_mut(padded_h * BAND).enumerate().for_each(|(band, columns)| {
            let along = &self.along_rows[band * BAND * raw_h..];
            for (column, x_of_row) in columns.chunks_mut(padded_h).zip(along.chunks(raw_h)) {
                let inner = &mut column[TAPS_BEFORE..TAPS_BEFORE + raw_h];
                interpolate_all(&padded, stride, x_of_row, taps, shift, inner);
                let (first, last) = (column[TAPS_BEFORE], column[TAPS_BEFORE + raw_h - 1]);
                column[..TAPS_BEFORE].fill(first);
                column[TAPS_BEFORE + raw_h..].fill(last);
            }
        });
    }

    /// Second pass: canvas columns to canvas rows.
    fn to_rows(&self, between: &[i16], out: &mut Image<Sample>) {
        let (w, padded_h) = (self.canvas_px[0], self.raw_px[1] + TAPS);
        out.as_mut_slice().par_chunks_mut(w * BAND).enumerate().for_each(|(band, rows)| {
            let along = &self.along_columns[band * BAND * w..];
            for (row, y_of_u) in rows.chunks_mut(w).zip(along.chunks(w)) {
                interpolate_all(between, padded_h, y_of_u, &self.taps, TAP_BITS, row);
            }
        });
    }
}

/// Value k of `out` from line k of `lines` (each `stride` long) at position k.
fn interpolate_all(
    lines: &[i16],
    stride: usize,
    positions: &[Position],
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    let at = |k: usize| {
        let first = k * stride + (positions[k] >> PHASE_BITS) as usize;
        let phase = (positions[k] & ((1 << PHASE_BITS) - 1)) as usize;
        let samples = lines[first..].first_chunk().expect("lines are padded by the taps");
        (samples, &taps[phase])
    };
    let (fours, rest) = out.as_chunks_mut::<4>();
    for (k, four) in fours.iter_mut().enumerate() {
        *four = dot::four([at(4 * k), at(4 * k + 1), at(4 * k + 2), at(4 * k + 3)], shift);
    }
    for (k, out) in rest.iter_mut().enumerate() {
        *out = dot::one(at(4 * fours.len() + k), shift);
    }
}

/// Raw rows as padded i16 lines.
struct Lines<'a> {
    raw: &'a RawImage,
    width: usize,
    halve: bool,
}

impl Lines<'_> {
    fn read(&self, y: usize, line: &mut [i16]) {
        let inner = &mut line[TAPS_BEFORE..TAPS_BEFORE + self.width];
        match &self.raw.pixels {
            RawPixels::Gray8(image) => {
                for (out, &value) in inner.iter_mut().zip(image.row(y)) {
                    *out = i16::from(value);
                }
            }
            RawPixels::Gray16(image) => {
                let (shift, full) = (u32::from(self.halve), self.raw.full_scale());
                for (out, &value) in inner.iter_mut().zip(image.row(y)) {
                    *out = (value.min(full) >> shift) as i16;
                }
            }
        }
        let (first, last) = (line[TAPS_BEFORE], line[TAPS_BEFORE + self.width - 1]);
        line[..TAPS_BEFORE].fill(first);
        line[TAPS_BEFORE + self.width..].fill(last);
    }
}

/// Raw x at which a canvas column crosses each raw row, from the column's path over the raw image.
/// Between two canvas rows the path is straight to far less than a step of [`Position`].
fn x_of_rows(path: &[Vector2<f64>], raw_w: usize, x_of_row: &mut [Position]) {
    let mut k = 0;
    for (y, out) in x_of_row.iter_mut().enumerate() {
        let y = y as f64;
        while k + 2 < path.len() && path[k + 1].y < y {
            k += 1;
        }
        let (a, b) = (path[k], path[k + 1]);
        let slope = (b.x - a.x) / (b.y - a.y);
        let x = if slope.is_finite() { a.x + slope * (y - a.y) } else { a.x };
        *out = position(x, raw_w);
    }
}

/// `columns` of `height` values each, as rows.
fn transposed<T: Copy>(columns: &[T], height: usize) -> Vec<T> {
    let width = columns.len() / height;
    (0..width * height).map(|i| columns[(i % width) * height + i / width]).collect()
}
