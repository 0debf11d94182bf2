//! Spatio-temporal census transform (paper eq 1-3).
//!
//! A pixel's descriptor has one bit per sample of its (2R+1) x (2R+1) x N window: whether the sample
//! is above the mean of the whole window. Samples outside the image or its mask take no part in the
//! mean, and their bit is 0.

pub mod kernel;

use crate::{Image, Sample, params::RADIUS_LIMIT};

pub use kernel::CensusKernel;

/// Columns a SIMD block covers; row strides are multiples of it.
pub const BLOCK: usize = 32;

/// The left or the right camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Side {
    /// Left.
    #[default]
    Left,
    /// Right.
    Right,
}

/// Values of samples that are outside the image or its mask. No threshold is below the one or above
/// the other: the bit of the first is always 0, of the second always 1.
const OUTSIDE: [Sample; 2] = [Sample::MIN, Sample::MAX];

/// Bit of a sample that is outside its mask, or left or right of the image.
pub fn outside_bit(side: Side, t: usize, x: isize, y: usize) -> bool {
    let place =
        ((side as u64) << 60) ^ ((t as u64) << 40) ^ ((y as u64) << 20) ^ (x as u64 & 0xfffff);
    // The middle bits of a product with an odd constant depend on all lower bits of the factor.
    let mixed = (place ^ (place >> 29)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mixed = (mixed ^ (mixed >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    mixed >> 40 & 1 != 0
}

/// Rounds a width up to whole blocks.
pub fn stride_of(width: usize) -> usize {
    width.next_multiple_of(BLOCK)
}

/// One side's frames with margins, and everything outside the mask marked.
#[derive(Debug, Default)]
pub struct PaddedStack {
    width: usize,
    height: usize,
    frames: usize,
    /// Samples a row takes, margins included.
    pitch: usize,
    samples: Vec<Sample>,
    /// Per pixel the sum over the frames; 0 outside the mask.
    sums: Vec<i32>,
    /// Per pixel 1 inside the mask, 0 outside.
    inside: Vec<u8>,
    /// A row outside the image.
    outside: Vec<Sample>,
}

/// What a missing sample is stored as.
fn outside_sample(side: Side, t: usize, x: isize, y: usize) -> Sample {
    OUTSIDE[outside_bit(side, t, x, y) as usize]
}

impl PaddedStack {
    /// Copies one side's `frames`, all of one size, reusing this stack's memory.
    pub fn fill(&mut self, side: Side, frames: &[&Image<Sample>], mask: Option<&Image<u8>>) {
        use rayon::prelude::*;

        (self.width, self.height) = (frames[0].width(), frames[0].height());
        self.frames = frames.len();
        self.pitch = stride_of(self.width) + 2 * RADIUS_LIMIT;
        let (width, pitch, n) = (self.width, self.pitch, self.frames);
        self.outside.clear();
        self.outside.resize(pitch, OUTSIDE[0]);
        self.samples.resize(self.height * n * pitch, 0);
        self.sums.resize(self.height * width, 0);
        self.inside.resize(self.height * width, 0);
        self.samples
            .par_chunks_mut(n * pitch)
            .zip(self.sums.par_chunks_mut(width))
            .zip(self.inside.par_chunks_mut(width))
            .enumerate()
            .for_each(|(y, ((rows, sums), inside))| {
                match mask {
                    Some(m) => {
                        inside.iter_mut().zip(m.row(y)).for_each(|(i, &m)| *i = (m != 0) as u8)
                    }
                    None => inside.fill(1),
                }
                sums.fill(0);
                for (t, (row, frame)) in rows.chunks_exact_mut(pitch).zip(frames).enumerate() {
                    let outside =
                        |at: usize| outside_sample(side, t, at as isize - RADIUS_LIMIT as isize, y);
                    // Beyond the margin there are only pixels that are invalid themselves.
                    for at in
                        (0..RADIUS_LIMIT).chain(RADIUS_LIMIT + width..2 * RADIUS_LIMIT + width)
                    {
                        row[at] = outside(at);
                    }
                    row[2 * RADIUS_LIMIT + width..].fill(OUTSIDE[0]);
                    for x in 0..width {
                        // The extremes mark the outside; nothing is lost by moving a sample by one
                        // part in 32768 off them.
                        let v = frame.row(y)[x].clamp(OUTSIDE[0] + 1, OUTSIDE[1] - 1);
                        let at = RADIUS_LIMIT + x;
                        row[at] = if inside[x] != 0 { v } else { outside(at) };
                        sums[x] += if inside[x] != 0 { v as i32 } else { 0 };
                    }
                }
            });
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Whether the pixel is inside the mask.
    pub fn is_inside(&self, x: usize, y: usize) -> bool {
        self.inside[y * self.width + x] != 0
    }

    /// Row `y` of frame `t` with margins of [`RADIUS_LIMIT`] samples; a row of outside samples above
    /// and below the image.
    fn row(&self, y: isize, t: usize) -> &[Sample] {
        if y < 0 || y as usize >= self.height {
            return &self.outside;
        }
        &self.samples[(y as usize * self.frames + t) * self.pitch..][..self.pitch]
    }
}

/// Descriptors of one row: bit k of a pixel is bit k % 16 of its word in plane k / 16, with
/// k = (t (2R+1) + i) (2R+1) + j for the sample of frame t at column x - R + i and row y - R + j, the
/// order of eq 1.
#[derive(Debug, Default)]
pub struct CensusRow {
    width: usize,
    stride: usize,
    bits: usize,
    bits_inside: usize,
    planes: Vec<u16>,
    /// 0 at pixels inside the mask, all ones elsewhere and in the padding.
    invalid: Vec<u16>,
    thresholds: Vec<Sample>,
    window_sums: Vec<i32>,
    window_counts: Vec<i32>,
}

impl CensusRow {
    /// Computes the descriptors of row `y`, reusing this row's memory.
    ///
    /// # Panics
    /// When `radius` is above [`RADIUS_LIMIT`] or `y` outside the image.
    pub fn fill(&mut self, stack: &PaddedStack, y: usize, radius: usize, kernel: CensusKernel) {
        assert!(radius <= RADIUS_LIMIT && y < stack.height);
        let side = 2 * radius + 1;
        self.width = stack.width;
        self.stride = stride_of(stack.width);
        self.bits = side * side * stack.frames;
        let rows = (y + radius + 1).min(stack.height) - y.saturating_sub(radius);
        self.bits_inside = rows * side * stack.frames;
        self.planes.resize(self.bits.div_ceil(16) * self.stride, 0);
        self.invalid.clear();
        self.invalid.resize(self.stride, u16::MAX);
        let inside = &stack.inside[y * stack.width..][..stack.width];
        for (invalid, &inside) in self.invalid.iter_mut().zip(inside) {
            *invalid = if inside != 0 { 0 } else { u16::MAX };
        }
        self.find_thresholds(stack, y, radius);
        let rows = (0..stack.frames)
            .flat_map(|t| (0..side).map(move |j| (t, y as isize + j as isize - radius as isize)))
            .map(|(t, y)| stack.row(y, t));
        // On the stack: at most 16 frames of 17 rows.
        let mut table = [stack.outside.as_slice(); 16 * (2 * RADIUS_LIMIT + 1)];
        let count = table.iter_mut().zip(rows).map(|(slot, row)| *slot = row).count();
        kernel.run(&table[..count], radius, &self.thresholds, &mut self.planes);
    }

    /// Means over the windows (eq 3), rounded down: a whole number is above the mean exactly when it
    /// is above the mean rounded down.
    fn find_thresholds(&mut self, stack: &PaddedStack, y: usize, radius: usize) {
        let (width, frames) = (stack.width, stack.frames);
        let rows = y.saturating_sub(radius)..(y + radius + 1).min(stack.height);
        // Column sums with `radius` zeros on both sides, then sums along the row.
        let padded = width + 2 * radius;
        self.window_sums.clear();
        self.window_sums.resize(padded, 0);
        self.window_counts.clear();
        self.window_counts.resize(padded, 0);
        for r in rows {
            let sums = &stack.sums[r * width..][..width];
            let inside = &stack.inside[r * width..][..width];
            let columns = self.window_sums[radius..].iter_mut();
            columns.zip(sums).for_each(|(c, s)| *c += s);
            let columns = self.window_counts[radius..].iter_mut();
            columns.zip(inside).for_each(|(c, &i)| *c += i as i32);
        }
        self.thresholds.clear();
        self.thresholds.resize(self.stride, Sample::MAX);
        for (x, threshold) in self.thresholds[..width].iter_mut().enumerate() {
            let window = x..x + 2 * radius + 1;
            let sum: i32 = self.window_sums[window.clone()].iter().sum();
            let count: i32 = self.window_counts[window].iter().sum::<i32>() * frames as i32;
            *threshold = if count == 0 {
                Sample::MAX
            } else {
                (sum as f64 / count as f64).floor() as Sample
            };
        }
    }

    /// Number of pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Distance between planes, a multiple of [`BLOCK`].
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// Bits of a descriptor: N (2R+1)^2.
    pub fn bits(&self) -> usize {
        self.bits
    }

    /// Bits in rows inside the image: the others agree always.
    pub fn bits_inside(&self) -> usize {
        self.bits_inside
    }

    /// All planes, one after the other.
    pub fn planes(&self) -> &[u16] {
        &self.planes
    }

    /// Per pixel 0 when valid, all ones when not.
    pub fn invalid(&self) -> &[u16] {
        &self.invalid
    }

    /// Bit `k` of pixel `x`.
    pub fn bit(&self, x: usize, k: usize) -> bool {
        self.planes[k / 16 * self.stride + x] >> (k % 16) & 1 != 0
    }
}
