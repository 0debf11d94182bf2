//! A 64-bit signature per pixel: samples of the window against its mean (paper eq 1-3, thinned), and
//! comparisons of the centre between frames.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;

use rayon::prelude::*;

use crate::{Image, Level, Sample, lanes::vectorised};

/// Margin of right descriptor rows on both sides, so that whole blocks of candidates can be read.
pub(crate) const MARGIN: usize = 64;
/// What the margin holds: far from most descriptors.
const OUTSIDE: u64 = 0xA5A5_5A5A_A5A5_5A5A;
/// Pixels of a block.
const BLOCK: usize = 32;

/// Per bit: a row of samples, and what they are compared with (the window's mean when none).
type Rows<'a> = [(&'a [Sample], Option<&'a [Sample]>); 64];

/// One bit of the descriptor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Test {
    /// Sample at (dx, dy) of a frame above the window's mean.
    Mean { dx: isize, dy: isize, frame: usize },
    /// The centre brighter in one frame than in another.
    Time { frame: usize, other: usize },
}

/// The 64 tests for a number of frames: the centre in every frame, its neighbours two pixels away,
/// the centre between frames, then samples ever farther away.
fn tests(frames: usize) -> Vec<Test> {
    let mut tests = Vec::with_capacity(64 + 16);
    let at = |dx, dy| (0..frames).map(move |frame| Test::Mean { dx, dy, frame });
    tests.extend(at(0, 0));
    let near = [(2, 0), (-2, 0), (0, 2), (0, -2)];
    for (dx, dy) in near {
        tests.extend(at(dx, dy));
    }
    for lag in 1..=frames / 2 {
        // At half the period each pair would come twice.
        let pairs = if 2 * lag == frames { lag } else { frames };
        tests.extend((0..pairs).map(|f| Test::Time { frame: f, other: (f + lag) % frames }));
    }
    let mut far: Vec<(isize, isize)> = (-4..=4isize)
        .flat_map(|dy| (-4..=4isize).map(move |dx| (dx, dy)))
        .filter(|p| *p != (0, 0) && !near.contains(p))
        .collect();
    far.sort_by_key(|(dx, dy)| (dx * dx + dy * dy, *dy, *dx));
    for (dx, dy) in far {
        tests.extend(at(dx, dy));
    }
    tests.truncate(64);
    tests
}

/// Rows of a task.
const BAND: usize = 32;

/// A task's buffers.
struct Scratch {
    /// Sums over time of samples / 8.
    light: Vec<i16>,
    mean: Vec<i16>,
    column: Vec<i32>,
}

impl Scratch {
    fn new(width: usize, radius: usize) -> Self {
        Self {
            light: vec![0; width * (BAND + 2 * radius)],
            mean: vec![0; width + BLOCK],
            column: vec![0; width],
        }
    }
}

/// Descriptors of one image stack.
#[derive(Debug, Default)]
pub(crate) struct Descriptors {
    width: usize,
    stride: usize,
    data: Vec<u64>,
}

impl Descriptors {
    /// Row `y` with [`MARGIN`] values before the first pixel and at least as many after the last.
    pub(crate) fn row(&self, y: usize) -> &[u64] {
        &self.data[y * self.stride..][..self.stride]
    }

    /// Width in pixels.
    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// Describes a stack.
    pub(crate) fn describe(&mut self, level: Level, images: &[&Image<Sample>]) {
        let (width, height) = (images[0].width(), images[0].height());
        self.width = width;
        self.stride = width.next_multiple_of(BLOCK) + 2 * MARGIN;
        self.data.resize(self.stride * height, OUTSIDE);
        let tests = tests(images.len());
        // A window's mean over few frames needs more of its area.
        let radius = if images.len() < 4 { 4 } else { 2 };
        let stride = self.stride;
        self.data.par_chunks_mut(stride * BAND).enumerate().for_each_init(
            || Scratch::new(width, radius),
            |scratch, (band, rows)| {
                let Scratch { light, mean, column } = scratch;
                // Sums over time of the band's rows and those its windows reach; rows beyond the
                // image repeat the outermost one.
                for (i, light) in light.chunks_mut(width).enumerate() {
                    let y = (band * BAND + i).saturating_sub(radius).min(height - 1);
                    light.fill(0);
                    for image in images {
                        add_eighth(level, image.row(y), light);
                    }
                }
                let side = 2 * radius + 1;
                let scale = 8.0 / (side * side * images.len()) as f32;
                for (i, row) in rows.chunks_mut(stride).enumerate() {
                    let mut window: [&[i16]; 9] = [&[]; 9];
                    for (j, to) in window.iter_mut().enumerate().take(side) {
                        *to = &light[(i + j) * width..][..width];
                    }
                    vectorised!(
                        level,
                        means_loop(
                            rows: &[&[i16]] = &window[..side],
                            scale: f32 = scale,
                            column: &mut [i32] = column,
                            mean: &mut [i16] = mean,
                        )
                    );
                    row[..MARGIN].fill(OUTSIDE);
                    row[MARGIN + width..].fill(OUTSIDE);
                    describe_row(level, images, &tests, band * BAND + i, mean, &mut row[MARGIN..]);
                }
            },
        );
    }
}

fn add_eighth(level: Level, row: &[Sample], light: &mut [i16]) {
    vectorised!(level, add_eighth_loop(row: &[Sample] = row, light: &mut [i16] = light));
}

#[inline(always)]
fn add_eighth_loop(row: &[Sample], light: &mut [i16]) {
    for (l, &v) in light.iter_mut().zip(row) {
        *l = l.wrapping_add(v >> 3);
    }
}

/// Means over the windows of one row from sums over time, in sample units; windows end at the image's
/// sides by repeating the outermost pixel.
#[inline(always)]
fn means_loop(rows: &[&[i16]], scale: f32, column: &mut [i32], mean: &mut [i16]) {
    let width = column.len();
    let radius = rows.len() / 2;
    column.fill(0);
    for row in rows {
        for (c, &v) in column.iter_mut().zip(*row) {
            *c += i32::from(v);
        }
    }
    let inner = radius..width.saturating_sub(radius);
    let clamped = |x: usize, j: usize| (x + j).saturating_sub(radius).min(width - 1);
    for x in (0..width).filter(|x| !inner.contains(x)) {
        let sum: i32 = (0..rows.len()).map(|j| column[clamped(x, j)]).sum();
        mean[x] = (sum as f32 * scale) as i16;
    }
    if inner.is_empty() {
        return;
    }
    let count = inner.len();
    let mean = &mut mean[inner];
    if radius == 2 {
        let (a, b, c) = (&column[..count], &column[1..1 + count], &column[2..2 + count]);
        let (d, e) = (&column[3..3 + count], &column[4..4 + count]);
        for x in 0..count {
            mean[x] = ((a[x] + b[x] + c[x] + d[x] + e[x]) as f32 * scale) as i16;
        }
    } else {
        for x in 0..count {
            let sum: i32 = column[x..x + 2 * radius + 1].iter().sum();
            mean[x] = (sum as f32 * scale) as i16;
        }
    }
}

fn describe_row(
    level: Level,
    images: &[&Image<Sample>],
    tests: &[Test],
    y: usize,
    mean: &[i16],
    out: &mut [u64],
) {
    let (width, height) = (images[0].width(), images[0].height());
    let clamp = |v: usize, d: isize, n: usize| v.saturating_add_signed(d).min(n - 1);
    let reach = tests
        .iter()
        .map(|t| match t {
            Test::Mean { dx, .. } => dx.unsigned_abs(),
            Test::Time { .. } => 0,
        })
        .max()
        .unwrap_or(0);
    let inner = if width >= 2 * reach + BLOCK { width - 2 * reach } else { 0 };
    let blocks = inner / BLOCK;
    // Whole blocks; the last one may overlap the one before.
    let at_block = |b: usize| if b < blocks { b * BLOCK } else { inner - BLOCK };
    let count = if inner == 0 { 0 } else { inner.div_ceil(BLOCK) };
    if count > 0 {
        // All slices begin at column `reach`, shifted by the test's dx.
        let rows: Rows<'_> = std::array::from_fn(|k| match tests[k] {
            Test::Mean { dx, dy, frame } => {
                let row = images[frame].row(clamp(y, dy, height));
                (&row[reach.wrapping_add_signed(dx)..][..inner], None)
            }
            Test::Time { frame, other } => {
                let of = |f: usize| &images[f].row(y)[reach..][..inner];
                (of(frame), Some(of(other)))
            }
        });
        let at = (0..count).map(at_block);
        let (mean, out) = (&mean[reach..][..inner], &mut out[reach..][..inner]);
        match level {
            // SAFETY: trusted levels are the processor's; all slices are `inner` long, and blocks
            // end there at most.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { avx512::blocks(&rows, mean, at, out) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { avx2::blocks(&rows, mean, at, out) },
            _ => scalar::blocks(&rows, mean, at, out),
        }
    }
    let done = if count == 0 { 0..0 } else { reach..width - reach };
    for x in (0..width).filter(|x| !done.contains(x)) {
        out[x] = tests.iter().enumerate().fold(0, |bits, (k, test)| {
            let (value, than) = match *test {
                Test::Mean { dx, dy, frame } => {
                    (images[frame].row(clamp(y, dy, height))[clamp(x, dx, width)], mean[x])
                }
                Test::Time { frame, other } => (images[frame].row(y)[x], images[other].row(y)[x]),
            };
            bits | u64::from(value > than) << k
        });
    }
}

#[cfg(test)]
mod tests_ {
    use super::*;
    use crate::synthetic::Random;

    #[test]
    fn there_are_64_different_tests_for_any_number_of_frames() {
        for frames in 1..=16 {
            let tests = tests(frames);
            assert_eq!(tests.len(), 64, "{frames}");
            for (i, t) in tests.iter().enumerate() {
                assert!(!tests[..i].contains(t), "{frames} {t:?}");
            }
        }
    }

    #[test]
    fn levels_agree_and_bits_mean_what_they_say() {
        let mut random = Random::new(2);
        for (width, height, frames) in [(77, 9, 10), (40, 5, 1), (3, 2, 4), (129, 3, 16)] {
            let images: Vec<Image<Sample>> = (0..frames)
                .map(|_| Image::new(width, height, 0).map(|_: i16| (random.bits() % 16_000) as i16))
                .collect();
            let images: Vec<&Image<Sample>> = images.iter().collect();
            let mut want = Descriptors::default();
            want.describe(Level::Scalar, &images);
            for level in Level::available() {
                let mut got = Descriptors::default();
                got.describe(level, &images);
                assert_eq!(got.data, want.data, "{level} {width}");
            }
            let (x, y) = (width / 2, height / 2);
            let radius: isize = if frames < 4 { 4 } else { 2 };
            let at = |x: isize, y: isize, f: usize| {
                let x = x.clamp(0, width as isize - 1) as usize;
                images[f].row(y.clamp(0, height as isize - 1) as usize)[x]
            };
            let mut sum = 0.0;
            for dy in -radius..=radius {
                for dx in -radius..=radius {
                    for f in 0..frames {
                        sum += f64::from(at(x as isize + dx, y as isize + dy, f));
                    }
                }
            }
            let mean = sum / ((2 * radius + 1).pow(2) as f64 * frames as f64);
            for (k, test) in tests(frames).iter().enumerate() {
                let bit = want.row(y)[MARGIN + x] >> k & 1 == 1;
                match *test {
                    Test::Mean { dx, dy, frame } => {
                        let v = f64::from(at(x as isize + dx, y as isize + dy, frame));
                        assert!(bit == (v > mean) || (v - mean).abs() < 16.0);
                    }
                    Test::Time { frame, other } => {
                        let (x, y) = (x as isize, y as isize);
                        assert_eq!(bit, at(x, y, frame) > at(x, y, other));
                    }
                }
            }
        }
    }
}
