//! A 64-bit signature per pixel: samples of the window against its mean (paper eq 1-3, thinned), and
//! comparisons of the centre between frames.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;

use std::ops::Range;

use rayon::prelude::*;

use crate::{Image, Level, Sample, aligned::Aligned, lanes::vectorised};

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

impl Test {
    /// How many columns away it looks.
    fn reach(&self) -> usize {
        match self {
            Test::Mean { dx, .. } => dx.unsigned_abs(),
            Test::Time { .. } => 0,
        }
    }
}

/// The 64 tests for a number of frames: the centre in every frame, its neighbours two pixels away,
/// the centre between frames, then samples ever farther away.
fn tests(frames: usize) -> [Test; 64] {
    let at = |dx, dy| (0..frames).map(move |frame| Test::Mean { dx, dy, frame });
    let near = [(2, 0), (-2, 0), (0, 2), (0, -2)];
    let beside = near.into_iter().enumerate().flat_map(|(k, (dx, dy))| {
        // Of many frames every second: thin objects are told by their own samples alone.
        let every = if frames > 12 { 2 } else { 1 };
        at(dx, dy).skip(k % every).step_by(every)
    });
    let time = (1..=frames / 2).flat_map(|lag| {
        // At half the period each pair would come twice.
        let pairs = if 2 * lag == frames { lag } else { frames };
        (0..pairs).map(move |f| Test::Time { frame: f, other: (f + lag) % frames })
    });
    let reach = REACH as isize;
    let mut around: [(isize, isize); ROWS * ROWS] =
        std::array::from_fn(|i| ((i % ROWS) as isize - reach, (i / ROWS) as isize - reach));
    around.sort_unstable_by_key(|(dx, dy)| (dx * dx + dy * dy, *dy, *dx));
    let far = around.into_iter().filter(|p| *p != (0, 0) && !near.contains(p));
    let far = far.flat_map(|(dx, dy)| at(dx, dy));
    let mut all = at(0, 0).chain(beside).chain(time).chain(far);
    // One frame alone has 81 samples in reach.
    let spare = Test::Time { frame: 0, other: 0 };
    std::array::from_fn(|_| all.next().unwrap_or(spare))
}

/// Rows of a task.
const BAND: usize = 32;
/// Blocks of a strip: 1536 columns. Narrower ones would keep ten frames' rows in the first-level cache,
/// but memory gives short pieces of many rows at half its speed.
const STRIP: usize = 48;
/// Farthest that a window or a test reaches to either side.
const REACH: usize = 4;
/// Most rows of a window.
const ROWS: usize = 2 * REACH + 1;
/// Most columns of a strip: whole blocks, the edges that no block covers, one block that overlaps
/// the strip before, and what windows reach; rounded up to whole vectors.
const COLUMNS: usize = (STRIP + 1) * BLOCK + 4 * REACH + BLOCK;

/// Descriptors of one image stack.
#[derive(Debug, Default)]
pub(crate) struct Descriptors {
    width: usize,
    stride: usize,
    data: Aligned<u64>,
    /// The tests for the last number of frames.
    tests: Option<(usize, [Test; 64])>,
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
        let width = images[0].width();
        self.width = width;
        self.stride = width.next_multiple_of(BLOCK) + 2 * MARGIN;
        self.data.resize(self.stride * images[0].height(), OUTSIDE);
        let tests = match self.tests {
            Some((frames, tests)) if frames == images.len() => tests,
            _ => self.tests.insert((images.len(), tests(images.len()))).1,
        };
        let stride = self.stride;
        self.data.par_chunks_mut(stride * BAND).enumerate().for_each(|(band, rows)| {
            for row in rows.chunks_mut(stride) {
                row[..MARGIN].fill(OUTSIDE);
                row[MARGIN + width..].fill(OUTSIDE);
            }
            describe_band(level, images, &tests, band * BAND, stride, rows);
        });
    }
}

/// Describes the rows from `y0`, of which `out` has as many as fit, strip by strip of columns. Sums
/// over time are made just before they are needed, so that samples come from memory once.
fn describe_band(
    level: Level,
    images: &[&Image<Sample>],
    tests: &[Test; 64],
    y0: usize,
    stride: usize,
    out: &mut [u64],
) {
    let width = images[0].width();
    let reach = tests.iter().map(Test::reach).max().unwrap_or(0);
    // The columns where no test leaves the image, in whole blocks. All but the first and the last
    // begin at a multiple of the block, where loads are aligned in images of such a width.
    let inner = if width >= 2 * reach + BLOCK { width - 2 * reach } else { 0 };
    let count = if inner == 0 { 0 } else { width.div_ceil(BLOCK) };
    let at_block = |b: usize| (b * BLOCK).saturating_sub(reach).min(inner - BLOCK);
    let edges: [usize; 2] = if count == 0 { [width, width] } else { [reach, width - reach] };
    let strips = count.div_ceil(STRIP).max(width.div_ceil(BLOCK * STRIP) * usize::from(count == 0));
    for strip in 0..strips {
        let blocks =
            if count == 0 { 0..0 } else { strip * STRIP..((strip + 1) * STRIP).min(count) };
        let columns = if count == 0 {
            // Too narrow for blocks.
            strip * STRIP * BLOCK..((strip + 1) * STRIP * BLOCK).min(width)
        } else {
            let from = if strip == 0 { 0 } else { reach + at_block(blocks.start) };
            let to = if strip + 1 == strips { width } else { blocks.end * BLOCK };
            from..to
        };
        let mut means = Means::new(level, images, columns.clone());
        means.begin(y0);
        for (i, out) in out.chunks_mut(stride).enumerate() {
            let mean = means.next(y0 + i);
            let out = &mut out[MARGIN..][..width];
            if !blocks.is_empty() {
                let at = blocks.clone().map(at_block);
                let out = &mut out[reach..][..inner];
                let rows = &rows_of(images, tests, y0 + i, reach, inner);
                let mean = &mean[reach.saturating_sub(columns.start)..];
                let begin = columns.start.saturating_sub(reach);
                match level {
                    // SAFETY: trusted levels are the processor's; rows and `out` are `inner` long,
                    // where blocks end at most, and the means are those of the strip's columns.
                    #[cfg(target_arch = "x86_64")]
                    Level::Avx512 => unsafe { avx512::blocks(rows, mean, begin, at, out) },
                    // SAFETY: as above.
                    #[cfg(target_arch = "x86_64")]
                    Level::Avx2 => unsafe { avx2::blocks(rows, mean, begin, at, out) },
                    _ => scalar::blocks(rows, mean, begin, at, out),
                }
            }
            let edge = columns.clone().filter(|x| *x < edges[0] || *x >= edges[1]);
            describe_edge(images, tests, y0 + i, edge, (mean, columns.start), out);
        }
    }
}

/// What each test compares on row `y`: slices of `inner` samples that begin at column `reach`,
/// shifted by the test's dx.
fn rows_of<'a>(
    images: &[&'a Image<Sample>],
    tests: &[Test; 64],
    y: usize,
    reach: usize,
    inner: usize,
) -> Rows<'a> {
    let height = images[0].height();
    if inner == 0 {
        return [(&[], None); 64];
    }
    std::array::from_fn(|k| match tests[k] {
        Test::Mean { dx, dy, frame } => {
            let row = images[frame].row(clamp(y, dy, height));
            (&row[reach.wrapping_add_signed(dx)..][..inner], None)
        }
        Test::Time { frame, other } => {
            let of = |f: usize| &images[f].row(y)[reach..][..inner];
            (of(frame), Some(of(other)))
        }
    })
}

/// Describes the columns at which a test leaves the image: samples there repeat the outermost one.
fn describe_edge(
    images: &[&Image<Sample>],
    tests: &[Test; 64],
    y: usize,
    columns: impl Iterator<Item = usize>,
    (mean, from): (&[i16], usize),
    out: &mut [u64],
) {
    let (width, height) = (images[0].width(), images[0].height());
    let mut columns = columns.peekable();
    while columns.peek().is_some() {
        // Test by test, for as many columns as there are at both sides of a row together.
        let mut some = [0; 2 * REACH];
        let count = some.iter_mut().zip(&mut columns).map(|(to, x)| *to = x).count();
        let some = &some[..count];
        let mut bits = [0_u64; 2 * REACH];
        for (k, test) in tests.iter().enumerate() {
            let bits = bits.iter_mut().zip(some);
            match *test {
                Test::Mean { dx, dy, frame } => {
                    let row = images[frame].row(clamp(y, dy, height));
                    for (bits, &x) in bits {
                        *bits |= u64::from(row[clamp(x, dx, width)] > mean[x - from]) << k;
                    }
                }
                Test::Time { frame, other } => {
                    let (row, than) = (images[frame].row(y), images[other].row(y));
                    for (bits, &x) in bits {
                        *bits |= u64::from(row[x] > than[x]) << k;
                    }
                }
            }
        }
        for (bits, &x) in bits.iter().zip(some) {
            out[x] = *bits;
        }
    }
}

/// `v` + `d`, brought into 0..`n`.
fn clamp(v: usize, d: isize, n: usize) -> usize {
    v.saturating_add_signed(d).min(n - 1)
}

/// Means over space and time around the pixels of a strip of columns, row by row.
///
/// In 16 bits: the mean over time is rounded to half or whole grey levels, which the mean over space
/// averages out.
struct Means<'a> {
    level: Level,
    images: &'a [&'a Image<Sample>],
    columns: Range<usize>,
    scale: Scale,
    /// Means over time of the window's rows, from [`REACH`] columns before the strip.
    light: [[i16; COLUMNS]; ROWS],
    /// Their sums.
    column: [i16; COLUMNS],
    mean: [i16; COLUMNS],
}

/// A window and the fixed-point factors of its mean.
#[derive(Clone, Copy)]
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
            Self { radius: 4, time: 8192 / n, round: 4 * n, space: 12_945, up: 0, back: 2 }
        } else {
            // Units of 32 samples; 25 pixels: 2^16 * 32 / 4 / 25.
            Self { radius: 2, time: 16_384 / n, round: 2 * n, space: 20_972, up: 1, back: 1 }
        }
    }
}

impl<'a> Means<'a> {
    fn new(level: Level, images: &'a [&'a Image<Sample>], columns: Range<usize>) -> Self {
        Self {
            level,
            images,
            columns,
            scale: Scale::new(images.len()),
            light: [[0; COLUMNS]; ROWS],
            column: [0; COLUMNS],
            mean: [0; COLUMNS],
        }
    }

    /// Sums up the rows before row `y`'s last one.
    fn begin(&mut self, y: usize) {
        for row in 0..2 * self.scale.radius {
            self.enter(y + row);
        }
    }

    /// The means of row `y`, which must follow the row of the last call.
    fn next(&mut self, y: usize) -> &[i16] {
        let radius = self.scale.radius;
        self.enter(y + 2 * radius);
        let len = self.columns.len();
        vectorised!(
            self.level,
            means_loop(
                column: &[i16] = &self.column[REACH - radius..][..len + 2 * radius],
                scale: Scale = self.scale,
                mean: &mut [i16] = &mut self.mean[..len],
            )
        );
        &self.mean[..len]
    }

    /// Takes image row `row` - radius (the nearest where there is none) into the sums, and the one a
    /// window before out.
    fn enter(&mut self, row: usize) {
        let (width, height) = (self.images[0].width(), self.images[0].height());
        let radius = self.scale.radius;
        let y = row.saturating_sub(radius).min(height - 1);
        let from = self.columns.start.saturating_sub(REACH);
        let to = (self.columns.end + REACH).min(width);
        prefetch(self.images, row + 1, from..to);
        let mut rows: [&[Sample]; 16] = [&[]; 16];
        for (to_row, image) in rows.iter_mut().zip(self.images) {
            *to_row = &image.row(y)[from..to];
        }
        // Columns beyond the image repeat the outermost one.
        let before = REACH - (self.columns.start - from);
        let len = self.columns.len() + 2 * REACH;
        vectorised!(
            self.level,
            enter_loop(
                rows: &[&[Sample]] = &rows[..self.images.len()],
                scale: Scale = self.scale,
                before: usize = before,
                light: &mut [i16] = &mut self.light[row % (2 * radius + 1)][..len],
                column: &mut [i16] = &mut self.column[..len],
            )
        );
    }
}

/// Asks for the samples of a row that will be needed soon.
fn prefetch(images: &[&Image<Sample>], y: usize, columns: Range<usize>) {
    #[cfg(target_arch = "x86_64")]
    if y < images[0].height() {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        for image in images {
            for line in image.row(y)[columns.clone()].chunks(32) {
                // SAFETY: a hint about memory that the slice holds.
                unsafe { _mm_prefetch::<_MM_HINT_T0>(line.as_ptr().cast()) };
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (images, y, columns);
}

/// Replaces a row of means over time by that of `rows`, which has `before` columns fewer on the left,
/// and brings the column sums up to date.
#[inline(always)]
fn enter_loop(
    rows: &[&[Sample]],
    scale: Scale,
    before: usize,
    light: &mut [i16],
    column: &mut [i16],
) {
    let mut new = [0i16; COLUMNS];
    let count = rows[0].len();
    let inner = &mut new[before..before + count];
    let (blocks, rest) = inner.as_chunks_mut::<BLOCK>();
    let done = blocks.len() * BLOCK;
    let mean = |sum: i16| {
        ((i32::from(sum.wrapping_add(scale.round)) * i32::from(scale.time)) >> 16) as i16
    };
    for (b, light) in blocks.iter_mut().enumerate() {
        let mut sum = [0i16; BLOCK];
        for row in rows {
            if let Some(row) = row[b * BLOCK..].first_chunk::<BLOCK>() {
                for (s, v) in sum.iter_mut().zip(row) {
                    *s = s.wrapping_add(v >> 3);
                }
            }
        }
        *light = sum.map(mean);
    }
    for (i, light) in rest.iter_mut().enumerate() {
        let sum = rows.iter().fold(0, |sum: i16, row| sum.wrapping_add(row[done + i] >> 3));
        *light = mean(sum);
    }
    let (first, last) = (new[before], new[before + count - 1]);
    new[..before].fill(first);
    new[before + count..light.len()].fill(last);
    for ((sum, old), new) in column.iter_mut().zip(light).zip(new) {
        *sum = sum.wrapping_add(new.wrapping_sub(*old));
        *old = new;
    }
}

/// Means in sample units from sums over columns, which begin `radius` before the first pixel.
#[inline(always)]
fn means_loop(column: &[i16], scale: Scale, mean: &mut [i16]) {
    let count = mean.len();
    let finish = |sum: i16| {
        let scaled = (i32::from(sum << scale.up) * i32::from(scale.space)) >> 16;
        (scaled as i16) << scale.back
    };
    if scale.radius == 2 {
        let (a, b, c) = (&column[..count], &column[1..1 + count], &column[2..2 + count]);
        let (d, e) = (&column[3..3 + count], &column[4..4 + count]);
        for x in 0..count {
            let near = b[x].wrapping_add(c[x]).wrapping_add(d[x]);
            mean[x] = finish(near.wrapping_add(a[x]).wrapping_add(e[x]));
        }
    } else {
        for x in 0..count {
            let window = &column[x..x + 2 * REACH + 1];
            mean[x] = finish(window.iter().fold(0, |sum: i16, v| sum.wrapping_add(*v)));
        }
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
                assert_eq!(&*got.data, &*want.data, "{level} {width}");
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
