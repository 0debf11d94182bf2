//! What descriptors compare: the samples of the rows around the one in work as bytes, and the means of
//! windows of them.
//!
//! A byte holds what a comparison needs, and a register twice as many of them as of samples. Codes rise
//! with the samples in steps of 0.4 grey levels where it is dark, where the camera's noise is small, and
//! of two from 64 grey levels on, where light itself is noisier.

use crate::{Image, Level, SAMPLES_PER_DN8, Sample, aligned::Aligned, lanes::vectorised};

/// Farthest that a window reaches to either side.
const REACH: usize = 4;
/// Pixels of a block.
pub(super) const BLOCK: usize = 64;
/// Columns of a row's buffer before the first pixel; at least as many follow the last.
const PAD: usize = BLOCK;

/// The rows of a stack around the one in work.
#[derive(Debug, Default)]
pub(super) struct Codes {
    width: usize,
    /// Columns of a row, with margins.
    stride: usize,
    scale: Scale,
    /// Frame by frame and row by row, columns beyond the image like its outermost ones.
    codes: Aligned<i8>,
    /// Means over time of each row's samples, and their sums over the window's rows. In 16 bits: they are
    /// rounded to half or whole grey levels, which the mean over space averages out.
    light: Aligned<i16>,
    column: Aligned<i16>,
    /// A row of means over time, until it is in the sums.
    new: Aligned<i16>,
    mean: Aligned<i8>,
    /// The stack that the rows are of, and the row that would follow.
    follows: Option<(u64, usize)>,
}

/// A window and the fixed-point factors of its mean.
#[derive(Debug, Clone, Copy, Default)]
struct Scale {
    radius: usize,
    /// Sum of eighths of samples, to their mean: (sum + `round`) * `time` / 2^16.
    time: i16,
    round: i16,
    /// Sum of means, to the mean in samples: (sum << `up`) * `space` / 2^16 << `back`.
    space: i16,
    up: u32,
    back: u32,
}

impl Scale {
    /// A window's mean over few frames needs more of its area.
    fn new(frames: usize) -> Self {
        let n = frames as i16;
        if frames < 4 {
            // Units of 64 samples; 81 pixels: 2^16 * 64 / 4 / 81.
            Self { radius: REACH, time: 8192 / n, round: 4 * n, space: 12_945, up: 0, back: 2 }
        } else {
            // Units of 32 samples; 25 pixels: 2^16 * 32 / 4 / 25.
            Self { radius: 2, time: 16_384 / n, round: 2 * n, space: 20_972, up: 1, back: 1 }
        }
    }
}

impl Codes {
    /// How far windows reach with so many frames, which is as far as a test can look.
    pub(super) fn reach(frames: usize) -> usize {
        Scale::new(frames).radius
    }

    /// Takes what row `y` needs of the rows before its last one, if those are not here already: `stamp` is
    /// another one for each stack. [`Codes::next`] must follow.
    pub(super) fn begin(&mut self, level: Level, images: &[&Image<Sample>], y: usize, stamp: u64) {
        if self.follows == Some((stamp, y)) {
            return;
        }
        self.follows = Some((stamp, y));
        let (width, frames) = (images[0].width(), images.len());
        self.scale = Scale::new(frames);
        self.width = width;
        self.stride = width.next_multiple_of(BLOCK) + 2 * PAD;
        self.codes.resize(frames * self.rows() * self.stride, 0);
        self.light.resize(self.rows() * self.stride, 0);
        self.column.resize(self.stride, 0);
        self.new.resize(self.stride, 0);
        self.mean.resize(self.stride, 0);
        self.light.fill(0);
        self.column.fill(0);
        for number in y..y + 2 * self.scale.radius {
            self.enter(level, images, number);
        }
    }

    /// Rows of a window.
    fn rows(&self) -> usize {
        2 * self.scale.radius + 1
    }

    /// Goes on to row `y`, which must follow the row of the last call.
    pub(super) fn next(&mut self, level: Level, images: &[&Image<Sample>], y: usize) {
        let (radius, width) = (self.scale.radius, self.width);
        self.follows = self.follows.map(|(stamp, _)| (stamp, y + 1));
        self.enter(level, images, y + 2 * radius);
        vectorised!(
            level,
            means_loop(
                column: &[i16] = &self.column[PAD - radius..][..width + 2 * radius],
                scale: Scale = self.scale,
                mean: &mut [i8] = &mut self.mean[PAD..][..width],
            )
        );
    }

    /// The rows around row `y`, the row in work.
    pub(super) fn around(&self, y: usize) -> Around<'_> {
        // Rows farther than a window reaches are not asked for.
        let (number, rows) = (y + self.scale.radius, self.rows());
        let start = |i: usize| (number + i + rows * REACH - REACH) % rows * self.stride + PAD;
        Around {
            codes: &self.codes,
            starts: std::array::from_fn(start),
            of_frame: rows * self.stride,
            len: self.stride - 2 * PAD,
        }
    }

    /// Codes of the windows' means in the row in work, in whole blocks.
    pub(super) fn mean(&self) -> &[i8] {
        &self.mean[PAD..self.stride - PAD]
    }

    /// Takes image row `number` - radius, or the nearest where there is none, in place of the one a
    /// window before.
    fn enter(&mut self, level: Level, images: &[&Image<Sample>], number: usize) {
        let y = number.saturating_sub(self.scale.radius).min(images[0].height() - 1);
        let mut samples: [&[Sample]; 16] = [&[]; 16];
        for (samples, image) in samples.iter_mut().zip(images) {
            *samples = image.row(y);
        }
        let samples = &samples[..images.len()];
        let of_frame = self.rows() * self.stride;
        let from = number % self.rows() * self.stride;
        vectorised!(
            level,
            encode_loop(
                samples: &[&[Sample]] = samples,
                scale: Scale = self.scale,
                codes: &mut [i8] = &mut self.codes[from + PAD..],
                of_frame: usize = of_frame,
                light: &mut [i16] = &mut self.new[PAD..][..self.width],
            )
        );
        for frame in 0..images.len() {
            let row = &mut self.codes[frame * of_frame + from..][..self.stride];
            repeat_ends(row, self.width, self.scale.radius);
        }
        repeat_ends(&mut self.new, self.width, self.scale.radius);
        vectorised!(
            level,
            slide_loop(
                new: &[i16] = &self.new,
                light: &mut [i16] = &mut self.light[from..][..self.stride],
                column: &mut [i16] = &mut self.column,
            )
        );
    }
}

/// Codes of the rows around one.
pub(super) struct Around<'a> {
    codes: &'a [i8],
    /// Where the first frame's rows begin, from the one [`REACH`] above.
    starts: [usize; 2 * REACH + 1],
    of_frame: usize,
    len: usize,
}

impl<'a> Around<'a> {
    /// The codes of a frame `dx` columns and `dy` rows from the pixels of the row, in whole blocks.
    #[inline]
    pub(super) fn row(&self, frame: usize, (dx, dy): (isize, isize)) -> &'a [i8] {
        let start = self.starts[REACH.wrapping_add_signed(dy)];
        &self.codes[(frame * self.of_frame + start).wrapping_add_signed(dx)..][..self.len]
    }
}

/// Repeats a row's outermost pixels beyond its ends.
fn repeat_ends<T: Copy>(row: &mut [T], width: usize, reach: usize) {
    let (first, last) = (row[PAD], row[PAD + width - 1]);
    row[PAD - reach..PAD].fill(first);
    row[PAD + width..][..reach].fill(last);
}

/// Asks for the samples of a row that come eight cache lines after those at `at`.
#[inline(always)]
fn ask_ahead(samples: &[Sample], at: usize) {
    #[cfg(target_arch = "x86_64")]
    for line in [256, 288] {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint, which reads nothing.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(samples.as_ptr().wrapping_add(at + line).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (samples, at);
}

/// The code of a sample: 0 to 255, less 128.
#[inline(always)]
fn code(sample: Sample) -> i8 {
    const { assert!(SAMPLES_PER_DN8 == 64) };
    (((sample >> 7) + (sample >> 5).min(128)).clamp(0, 255) as u8 ^ 0x80) as i8
}

/// The codes of a row of all frames, each `of_frame` behind the one before, and their means over time.
#[inline(always)]
fn encode_loop(
    samples: &[&[Sample]],
    scale: Scale,
    codes: &mut [i8],
    of_frame: usize,
    light: &mut [i16],
) {
    let width = light.len();
    let mean = |sum: i16| {
        ((i32::from(sum.wrapping_add(scale.round)) * i32::from(scale.time)) >> 16) as i16
    };
    // The last block overlaps the one before.
    let blocks = if width < BLOCK { 0 } else { width.div_ceil(BLOCK) };
    for block in 0..blocks {
        let at = (block * BLOCK).min(width - BLOCK);
        let mut sum = [0_i16; BLOCK];
        for (frame, samples) in samples.iter().enumerate() {
            let from = samples[at..].first_chunk::<BLOCK>();
            let to = codes[frame * of_frame + at..].first_chunk_mut::<BLOCK>();
            let (Some(from), Some(to)) = (from, to) else { continue };
            ask_ahead(samples, at);
            for i in 0..BLOCK {
                sum[i] = sum[i].wrapping_add(from[i] >> 3);
                to[i] = code(from[i]);
            }
        }
        if let Some(light) = light[at..].first_chunk_mut::<BLOCK>() {
            *light = sum.map(mean);
        }
    }
    if blocks == 0 {
        for (x, light) in light.iter_mut().enumerate() {
            let mut sum = 0_i16;
            for (frame, samples) in samples.iter().enumerate() {
                sum = sum.wrapping_add(samples[x] >> 3);
                codes[frame * of_frame + x] = code(samples[x]);
            }
            *light = mean(sum);
        }
    }
}

/// Replaces the means over time of one row by those of another, and brings the sums up to date.
#[inline(always)]
fn slide_loop(new: &[i16], light: &mut [i16], column: &mut [i16]) {
    let n = new.len();
    let (light, column) = (&mut light[..n], &mut column[..n]);
    for i in 0..n {
        column[i] = column[i].wrapping_add(new[i].wrapping_sub(light[i]));
        light[i] = new[i];
    }
}

/// Codes of the means, from sums over columns, which begin a radius before the first pixel.
#[inline(always)]
fn means_loop(column: &[i16], scale: Scale, mean: &mut [i8]) {
    let n = mean.len();
    let finish = |sum: i16| {
        let scaled = (i32::from(sum << scale.up) * i32::from(scale.space)) >> 16;
        code((scaled as i16) << scale.back)
    };
    if scale.radius == 2 {
        let (a, b, c) = (&column[..n], &column[1..n + 1], &column[2..n + 2]);
        let (d, e) = (&column[3..n + 3], &column[4..n + 4]);
        for x in 0..n {
            let near = b[x].wrapping_add(c[x]).wrapping_add(d[x]);
            mean[x] = finish(near.wrapping_add(a[x]).wrapping_add(e[x]));
        }
    } else {
        for x in 0..n {
            let window = &column[x..x + 2 * scale.radius + 1];
            mean[x] = finish(window.iter().fold(0, |sum: i16, v| sum.wrapping_add(*v)));
        }
    }
}
