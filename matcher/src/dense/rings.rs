//! Rows kept by image row, the last few of them: what a tile's stages leave for those behind them.

use super::{moments::PAD, warp::Warped};
use crate::aligned::Aligned;

/// Rows by image row, the last `depth` of them kept. Those of numbers are padded.
#[derive(Debug, Default)]
pub(super) struct Ring<T = f32> {
    data: Aligned<T>,
    stride: usize,
    depth: usize,
}

impl<T: Copy + Default> Ring<T> {
    pub fn resize(&mut self, stride: usize, depth: usize) {
        if (self.stride, self.depth) != (stride, depth) {
            self.data.resize(stride * depth, T::default());
            (self.stride, self.depth) = (stride, depth);
        }
        self.data.fill(T::default());
    }

    /// Where row `y` is kept; rows above the image count from -[`ABOVE`].
    fn slot(&self, y: isize) -> usize {
        // A division of 32 bits: there are a hundred of them for each row of a tile.
        ((y + ABOVE) as u32 % self.depth as u32) as usize
    }

    pub fn row(&self, y: isize) -> &[T] {
        &self.data[self.slot(y) * self.stride..][..self.stride]
    }

    pub fn row_mut(&mut self, y: isize) -> &mut [T] {
        let at = self.slot(y) * self.stride;
        &mut self.data[at..][..self.stride]
    }

    /// The row without its pads.
    pub fn inner_mut(&mut self, y: isize) -> &mut [T] {
        let stride = self.stride;
        &mut self.row_mut(y)[PAD..stride - PAD]
    }
}

/// Most rows of a window.
const ROWS: usize = 17;
/// More rows than any stage looks at above the image.
const ABOVE: isize = 128;

/// Calls `work` with the 2 radius + 1 rows of `ring` around `y`.
pub(super) fn around<T>(
    ring: &Ring,
    y: isize,
    radius: usize,
    work: impl FnOnce(&[&[f32]]) -> T,
) -> T {
    let mut rows: [&[f32]; ROWS] = [&[]; ROWS];
    let rows = &mut rows[..2 * radius + 1];
    let mut slot = ring.slot(y - radius as isize);
    for row in &mut *rows {
        *row = &ring.data[slot * ring.stride..][..ring.stride];
        slot = if slot + 1 == ring.depth { 0 } else { slot + 1 };
    }
    work(rows)
}

/// A warp's terms, and q.
#[derive(Debug, Default)]
pub(super) struct Pass {
    pub at: Ring,
    pub valid: Ring,
    pub ig: Ring,
    pub g: Ring,
    pub gg: Ring,
    pub lg: Ring,
    pub q: Ring,
}

impl Pass {
    pub fn resize(&mut self, stride: usize, window: usize) {
        // Window sums slide: the row that leaves is one behind the window.
        for ring in [&mut self.valid, &mut self.g, &mut self.gg, &mut self.lg] {
            ring.resize(stride, window + 1);
        }
        for ring in [&mut self.at, &mut self.ig, &mut self.q] {
            ring.resize(stride, window);
        }
    }

    /// Where the warp of row `y` goes; the products of grey values are for the similarity, which
    /// the first pass does not give.
    pub fn warped(&mut self, y: isize, with_lg: bool) -> Warped<'_> {
        Warped {
            at: self.at.inner_mut(y),
            valid: self.valid.inner_mut(y),
            ig: self.ig.inner_mut(y),
            g: self.g.inner_mut(y),
            gg: self.gg.inner_mut(y),
            lg: with_lg.then(|| self.lg.inner_mut(y)),
            timed: None,
        }
    }

    pub fn clear(&mut self, y: isize) {
        for ring in [&mut self.at, &mut self.valid, &mut self.ig, &mut self.g, &mut self.gg] {
            ring.row_mut(y).fill(0.0);
        }
        self.lg.row_mut(y).fill(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_the_last_rows_and_gives_them_in_order() {
        let mut ring = Ring::<f32>::default();
        ring.resize(3, 5);
        for y in -20isize..40 {
            ring.row_mut(y).fill(y as f32);
            if y >= -16 {
                around(&ring, y - 2, 2, |rows| {
                    let found: Vec<f32> = rows.iter().map(|row| row[1]).collect();
                    let want: Vec<f32> = (y - 4..=y).map(|y| y as f32).collect();
                    assert_eq!(found, want);
                });
            }
        }
    }
}
