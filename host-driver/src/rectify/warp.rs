//! Resampling of one camera's raw image onto its rectified canvas.
//!
//! The two-dimensional warp is done as two one-dimensional ones (Catmull and Smith, 1980): first along
//! the raw rows to the columns of the canvas, then along those columns to its rows. Each is exact for a
//! continuous picture, so that 8 + 8 taps do what 8 x 8 would. Conversion from the camera's format is
//! part of the first pass: a raw row is converted in the first-level cache, and its scale is in the
//! taps.

use std::sync::Arc;

use nalgebra::{Rotation3, Vector2, Vector3};
use rayon::prelude::*;
use stspp_matcher::parallel::Share;
use stspp_matcher::{Image, Level, Sample};

use super::kernel::{PHASE_BITS, TAP_BITS, TAPS, TAPS_BEFORE, TapTables};
use super::resample::{BLOCK, Places, across, along};
use crate::raw::RawPixels;
use crate::{CameraIntrinsics, RawImage};

/// Rows that a task handles.
const BAND: usize = 32;

/// Positions of first taps in a padded line, in 2^-10 pixels.
type Position = u32;

/// A virtual camera's view of a real one's image.
pub(super) struct Warp {
    level: Level,
    /// Per raw row and canvas column: where in the (padded) raw row.
    along_rows: Places,
    /// Per canvas row and column: where in the (padded) column of the picture between.
    along_columns: Places,
    raw_px: [usize; 2],
    canvas_px: [usize; 2],
    /// Non-zero where the camera saw.
    pub mask: Image<u8>,
    taps: Arc<TapTables>,
}

/// Working memory of a warp; any number of warps of any size can share one.
#[derive(Debug)]
pub struct RectifyScratch {
    /// The picture between the passes: raw rows, padded above and below, by canvas columns.
    between: Image<i16>,
    /// A raw row per band.
    lines: Vec<i16>,
}

impl Default for RectifyScratch {
    fn default() -> Self {
        Self { between: Image::new(0, 0, 0), lines: Vec::new() }
    }
}

/// A virtual camera: where canvas pixels are on the real one.
pub(super) struct Virtual {
    pub camera: CameraIntrinsics,
    pub rect_camera_taps: Rotation3<f64>,
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
        let ray = self.rect_camera_taps.inverse_transform_vector(&ray_rect);
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
    pub fn new(level: Level, view: &Virtual, taps: &Arc<TapTables>) -> Self {
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
        let mask =
            Image::from_vec(w, h, transposed(&seen, h)).unwrap_or_else(|| Image::new(w, h, 0));
        Self {
            level: level.usable(),
            along_rows: Places::new(&transposed(&along_rows, raw_h), w),
            along_columns: Places::new(&transposed(&columns, h), w),
            raw_px,
            canvas_px,
            mask,
            taps: Arc::clone(taps),
        }
    }

    /// Resamples `raw`, whose size must be the calibration's, into `out`, whose size must be the
    /// canvas's.
    pub fn apply(&self, raw: &RawImage, out: &mut Image<Sample>, scratch: &mut RectifyScratch) {
        let ([raw_w, raw_h], [w, _]) = (self.raw_px, self.canvas_px);
        let stride = w.next_multiple_of(BLOCK);
        let line_len = raw_w + TAPS;
        if (scratch.between.width(), scratch.between.height()) != (stride, raw_h + TAPS) {
            scratch.between = Image::new(stride, raw_h + TAPS, 0);
        }
        scratch.lines.resize(line_len * raw_h.div_ceil(BAND), 0);
        let bits = u32::from(raw.bits.clamp(1, 16));
        let (taps, shift) = self.taps.camera_taps(bits);
        let lines = Lines { raw, width: raw_w, halve: bits == 16 };
        let inner = &mut scratch.between.as_mut_slice()[TAPS_BEFORE * stride..][..raw_h * stride];
        inner
            .par_chunks_mut(stride * BAND)
            .zip(scratch.lines.par_chunks_mut(line_len))
            .enumerate()
            .share(|(band, (rows, line))| {
                for (k, out) in rows.chunks_mut(stride).enumerate() {
                    let y = band * BAND + k;
                    lines.read(y, line);
                    along(self.level, line, self.along_rows.row(y), taps, shift, out);
                }
            });
        // Beyond its ends, the first and the last row repeat.
        let between = scratch.between.as_mut_slice();
        let end = TAPS_BEFORE + raw_h;
        for y in 0..TAPS_BEFORE {
            between.copy_within(TAPS_BEFORE * stride..(TAPS_BEFORE + 1) * stride, y * stride);
        }
        for y in end..raw_h + TAPS {
            between.copy_within((end - 1) * stride..end * stride, y * stride);
        }
        let taps = self.taps.plain();
        out.as_mut_slice().par_chunks_mut(w * BAND).enumerate().share(|(band, rows)| {
            for (k, out) in rows.chunks_mut(w).enumerate() {
                let row = self.along_columns.row(band * BAND + k);
                across(self.level, between, stride, row, taps, TAP_BITS, out);
            }
        });
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
