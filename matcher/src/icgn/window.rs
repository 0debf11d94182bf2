//! The pixels of a subset: all of a square, or those of them that belong to the centre's surface.

use super::prepare::{Prepared, RIGHT_MARGIN, SUBSET_RADIUS_LIMIT};
use crate::bspline::LANES;

/// Most pixels of a subset, in whole vectors.
pub const PIXELS_MAX: usize = 240;

/// Most rows of a subset.
pub const ROWS_MAX: usize = 2 * SUBSET_RADIUS_LIMIT + 1;

/// A subset's pixels in the forms that the kernels read.
#[derive(Debug, Clone)]
pub struct Window {
    /// Width of the images it was made for, which its offsets depend on.
    width: usize,
    pub(crate) radius: usize,
    pub(crate) count: usize,
    /// Derivatives of the shape function by its parameters at each pixel (1, x, y, x^2/2, y^2/2, xy);
    /// 0 beyond `count`.
    pub(crate) phi: [[f32; PIXELS_MAX]; 6],
    /// Each pixel's place in the left arrays, relative to the centre's.
    pub(crate) left_at: [i32; PIXELS_MAX],
    /// Each pixel's row in the right array, relative to the centre's.
    pub(crate) right_at: [i32; PIXELS_MAX],
    /// 1 at the subset's pixels: row -radius + r, column -radius + lane.
    pub(crate) mask: [[f32; LANES]; ROWS_MAX],
    /// Lowest and highest column and row.
    pub(crate) columns: (i32, i32),
    pub(crate) rows: (i32, i32),
}

impl Window {
    /// A window without pixels.
    pub fn empty() -> Self {
        Self {
            width: 0,
            radius: 0,
            count: 0,
            phi: [[0.0; PIXELS_MAX]; 6],
            left_at: [0; PIXELS_MAX],
            right_at: [0; PIXELS_MAX],
            mask: [[0.0; LANES]; ROWS_MAX],
            columns: (0, 0),
            rows: (0, 0),
        }
    }

    /// The full square.
    pub fn full(radius: usize, prepared: &Prepared) -> Self {
        let mut window = Self::empty();
        window.select(radius, prepared, |_, _| true);
        window
    }

    /// Takes the pixels of the square for which `member(column, row)`, relative to the centre, holds.
    pub fn select(
        &mut self,
        radius: usize,
        prepared: &Prepared,
        mut member: impl FnMut(i32, i32) -> bool,
    ) {
        assert!(radius <= SUBSET_RADIUS_LIMIT);
        let r = radius as i32;
        (self.width, self.radius, self.count) = (prepared.width, radius, 0);
        (self.columns, self.rows) = ((i32::MAX, i32::MIN), (i32::MAX, i32::MIN));
        self.mask = [[0.0; LANES]; ROWS_MAX];
        for dy in -r..=r {
            for dx in -r..=r {
                if !member(dx, dy) {
                    continue;
                }
                let (x, y, at) = (dx as f32, dy as f32, self.count);
                let phi = [1.0, x, y, 0.5 * x * x, 0.5 * y * y, x * y];
                phi.iter().zip(&mut self.phi).for_each(|(v, row)| row[at] = *v);
                self.left_at[at] = (dy * prepared.width as i32 + dx) * LANES as i32;
                self.right_at[at] = dy * prepared.right_pitch() as i32;
                self.mask[(dy + r) as usize][(dx + r) as usize] = 1.0;
                self.columns = (self.columns.0.min(dx), self.columns.1.max(dx));
                self.rows = (self.rows.0.min(dy), self.rows.1.max(dy));
                self.count += 1;
            }
        }
        let padded = self.padded();
        self.phi.iter_mut().for_each(|row| row[self.count..padded].fill(0.0));
        if self.count == 0 {
            (self.columns, self.rows) = ((0, 0), (0, 0));
        }
    }

    /// Number of pixels.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Number of pixels in whole vectors.
    pub(crate) fn padded(&self) -> usize {
        self.count.next_multiple_of(LANES)
    }

    /// Whether the window was made for `prepared` and lies inside its image when about (x, y).
    pub(crate) fn fits(&self, prepared: &Prepared, x: usize, y: usize) -> bool {
        let (x, y) = (x as i64, y as i64);
        self.width == prepared.width
            && x < prepared.width as i64
            && y < prepared.height as i64
            && x + self.columns.0 as i64 >= 0
            && x + (self.columns.1 as i64) < prepared.width as i64
            && y + self.rows.0 as i64 >= 0
            && y + (self.rows.1 as i64) < prepared.height as i64
    }
}

/// Where a subset's warp is read: everything the kernels need besides the window.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    /// Centre in [`Prepared::left`] and [`Prepared::gradient`].
    pub left: usize,
    /// The whole right column that positions are relative to, in [`Prepared::right`].
    pub right: usize,
    /// Lowest and highest relative position.
    pub limits: (f32, f32),
}

impl Place {
    /// The place of a subset about (x, y), with positions relative to right column `base`.
    ///
    /// # Panics
    /// When `base` is outside the image.
    pub(crate) fn new(prepared: &Prepared, x: usize, y: usize, base: i64) -> Self {
        assert!(base >= 0 && base < prepared.width as i64);
        // Positions are clamped to one pixel beyond the image: the taps then stay inside the margins.
        Self {
            left: (y * prepared.width + x) * LANES,
            right: y * prepared.right_pitch() + (RIGHT_MARGIN + base as usize) * LANES,
            limits: (-(base as f32) - 1.0, (prepared.width as i64 - 1 - base) as f32 + 0.999),
        }
    }
}
