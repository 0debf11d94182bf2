//! A try with windows of a single row, for surfaces too steep for square ones.
//!
//! A surface that tilts up or down by 75 degrees and more moves by over a pixel of disparity from row to
//! row: five rows of census bits no longer agree anywhere. A single row still does, and N frames make
//! seven columns of it long enough a word. It is compared by ZNCC over the disparities that are found
//! around the gap.

use rayon::prelude::*;

use crate::{DisparityRange, Image, SAMPLES_PER_DN8, StereoStack};

/// Fewest frames: with fewer a row's window matches elsewhere by chance.
const FRAMES_MIN: usize = 6;

/// Columns of the window to either side of its centre.
const RADIUS: usize = 3;
const COLUMNS: usize = 2 * RADIUS + 1;

/// Side of the blocks whose disparities bound the search, with those of the blocks around.
const BLOCK: usize = 16;

/// Disparities beyond those found nearby that are tried too.
const MARGIN_PX: i32 = 3;

/// Least similarity of a match. Of a hundred unrelated candidates the best has 0.6 by chance.
const SIMILARITY_MIN: f32 = 0.85;

/// How much better a match must be than all that are more than [`VALLEY`] away.
const MARGIN_MIN: f32 = 0.1;
const VALLEY: i32 = 2;

/// Least variance of the window's grey values in squared DN of 8 bits: below it is noise.
const VARIANCE_MIN: f32 = 4.0;

/// Fills gaps of `map` (NaN) where a row's grey values match uniquely. Does nothing with fewer than
/// six frames.
///
/// # Panics
/// When the map and the checked stack differ in size.
pub fn fill(stack: &StereoStack<'_>, range: DisparityRange, map: &mut Image<f32>) {
    let (width, height) = (map.width(), map.height());
    assert_eq!((width, height), (stack.width(), stack.height()));
    if stack.frames() < FRAMES_MIN || width < COLUMNS {
        return;
    }
    let bounds = Bounds::of(map);
    map.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let seen = stack.left_mask.is_none_or(|m| m.row(y)[x] != 0);
            if !value.is_nan() || !seen || x < RADIUS || x + RADIUS >= width {
                continue;
            }
            let Some((low, high)) = bounds.around(x, y) else { continue };
            let low = (low.floor() as i32 - MARGIN_PX).max(range.min_px);
            let high = (high.ceil() as i32 + MARGIN_PX).min(range.max_px);
            if let Some(disparity_px) = best(stack, x, y, low..=high) {
                *value = disparity_px;
            }
        }
    });
}

/// The disparity among `candidates` that fits left pixel (x, y), if one does and no other.
fn best(
    stack: &StereoStack<'_>,
    x: usize,
    y: usize,
    candidates: std::ops::RangeInclusive<i32>,
) -> Option<f32> {
    let n = (COLUMNS * stack.frames()) as f32;
    let window = Window::of(stack.left, x, y);
    let left_norm = window.deviation(n);
    if left_norm < VARIANCE_MIN * n {
        return None;
    }
    let (mut first, mut second) = ((f32::MIN, 0), f32::MIN);
    let first_px = *candidates.start();
    let similarity = |d: i32| {
        let at = x as i64 - i64::from(d);
        let inside = at >= RADIUS as i64
            && at + (RADIUS as i64) < stack.width() as i64
            && stack.right_mask.is_none_or(|m| m.row(y)[at as usize] != 0);
        if !inside {
            return -1.0;
        }
        let (right, product) = window.compared(stack.right, at as usize, y);
        let norm = (left_norm * right.deviation(n)).sqrt();
        if norm > 0.0 { (product - window.sum * right.sum / n) / norm } else { -1.0 }
    };
    let values: Vec<f32> = candidates.map(similarity).collect();
    for (k, &z) in values.iter().enumerate() {
        if z > first.0 {
            first = (z, k as i32);
        }
    }
    for (k, &z) in values.iter().enumerate() {
        if (k as i32 - first.1).abs() > VALLEY {
            second = second.max(z);
        }
    }
    if first.0 < SIMILARITY_MIN || first.0 - second < MARGIN_MIN {
        return None;
    }
    let k = first.1 as usize;
    let offset = match (k.checked_sub(1).and_then(|k| values.get(k)), values.get(k + 1)) {
        (Some(&below), Some(&above)) => crate::parabola::offset(-below, -first.0, -above),
        _ => 0.0,
    };
    Some((first_px + first.1) as f32 + offset)
}

/// A row's window in all frames, in DN of 8 bits.
struct Window {
    values: [[f32; COLUMNS]; 16],
    sum: f32,
    squares: f32,
}

impl Window {
    fn of(images: &[&Image<i16>], x: usize, y: usize) -> Self {
        let mut window = Self { values: [[0.0; COLUMNS]; 16], sum: 0.0, squares: 0.0 };
        for (values, image) in window.values.iter_mut().zip(images) {
            let row = &image.row(y)[x - RADIUS..][..COLUMNS];
            for (value, &sample) in values.iter_mut().zip(row) {
                *value = f32::from(sample) * (1.0 / SAMPLES_PER_DN8 as f32);
                window.sum += *value;
                window.squares += *value * *value;
            }
        }
        window
    }

    /// The other side's window about (x, y), and the sum of products with it.
    fn compared(&self, images: &[&Image<i16>], x: usize, y: usize) -> (Self, f32) {
        let other = Self::of(images, x, y);
        let pairs = self.values.as_flattened().iter().zip(other.values.as_flattened());
        let product = pairs.map(|(a, b)| a * b).sum();
        (other, product)
    }

    /// Summed squared deviations from the mean of `n` values.
    fn deviation(&self, n: f32) -> f32 {
        self.squares - self.sum * self.sum / n
    }
}

/// Lowest and highest disparity of blocks of a map; NaN where there is none.
struct Bounds {
    blocks: Image<(f32, f32)>,
}

impl Bounds {
    fn of(map: &Image<f32>) -> Self {
        let size = (map.width().div_ceil(BLOCK), map.height().div_ceil(BLOCK));
        let mut blocks = Image::new(size.0, size.1, (f32::NAN, f32::NAN));
        for y in 0..map.height() {
            for (x, &d) in map.row(y).iter().enumerate() {
                let block = &mut blocks.row_mut(y / BLOCK)[x / BLOCK];
                // The other operand where one is NaN.
                *block = (block.0.min(d), block.1.max(d));
            }
        }
        Self { blocks }
    }

    /// Those of the pixel's block and the ones around it.
    fn around(&self, x: usize, y: usize) -> Option<(f32, f32)> {
        let (bx, by) = (x / BLOCK, y / BLOCK);
        let mut bounds = (f32::NAN, f32::NAN);
        for row in by.saturating_sub(1)..(by + 2).min(self.blocks.height()) {
            for &(low, high) in
                &self.blocks.row(row)[bx.saturating_sub(1)..(bx + 2).min(self.blocks.width())]
            {
                bounds = (bounds.0.min(low), bounds.1.max(high));
            }
        }
        (!bounds.0.is_nan()).then_some(bounds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Layer, Scene};

    #[test]
    fn a_steep_surface_is_found() {
        // 1.4 px of disparity a row, between two level parts.
        let field = |_: f64, y: f64| 10.0 + 1.4 * (y - 30.0).clamp(0.0, 30.0);
        let rendered = Scene::new(120, 90, 10, vec![Layer::everywhere(field)]).render();
        let mut map = rendered.truth_px.clone();
        for y in 28..62 {
            map.row_mut(y).fill(f32::NAN);
        }
        let range = DisparityRange { min_px: -10, max_px: 70 };
        rendered.with_stack(|stack| fill(stack, range, &mut map));
        let (mut filled, mut wrong, mut all) = (0, 0, 0);
        for y in 32..58 {
            for x in 60..115 {
                let error = (map.row(y)[x] - rendered.truth_px.row(y)[x]).abs();
                all += 1;
                filled += usize::from(error <= 1.0);
                wrong += usize::from(error > 1.0);
            }
        }
        // Enough to grow from: where dots are sparse, a row has too little of them.
        assert!(filled * 2 > all, "{filled} of {all}");
        assert!(wrong * 200 <= all, "{wrong} of {all} wrong");
    }
}
