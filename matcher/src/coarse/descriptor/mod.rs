//! A 64-bit signature per pixel: samples of the window against its mean (paper eq 1-3, thinned), and
//! comparisons of the centre between frames.

mod codes;
mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;

use rayon::prelude::*;

use crate::{
    Image, Level, Sample,
    aligned::Aligned,
    parallel::{self, PerThread, Share},
};
use codes::{BLOCK, Codes};

/// Margin of right descriptor rows on both sides, so that whole blocks of candidates can be read.
pub(crate) const MARGIN: usize = 64;
/// What the margin holds: far from most descriptors.
const OUTSIDE: u64 = 0xA5A5_5A5A_A5A5_5A5A;

/// What the bits compare in a row, in whole blocks of pixels.
struct Rows<'a> {
    codes: [&'a [i8]; 64],
    /// The windows' means for the first [`Rows::means`] bits, a frame's own codes for the others.
    than: [&'a [i8]; 64],
    means: usize,
}

/// One bit of the descriptor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Test {
    /// Sample at (dx, dy) of a frame above the window's mean.
    Mean { at: (isize, isize), frame: usize },
    /// The centre brighter in one frame than in another.
    Time { frame: usize, other: usize },
}

/// The 64 tests for a number of frames: the centre in every frame, its neighbours two pixels away,
/// the centre between frames, then samples ever farther away. Those against the mean come first.
fn tests(frames: usize) -> [Test; 64] {
    let at = |dx, dy| (0..frames).map(move |frame| Test::Mean { at: (dx, dy), frame });
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
    let reach = Codes::reach(frames) as isize;
    let square = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
    let mut around: Vec<(isize, isize)> = square.collect();
    around.sort_unstable_by_key(|(dx, dy)| (dx * dx + dy * dy, *dy, *dx));
    let far = around.into_iter().filter(|p| *p != (0, 0) && !near.contains(p));
    let far = far.flat_map(|(dx, dy)| at(dx, dy));
    let mut all = at(0, 0).chain(beside).chain(time).chain(far);
    // One frame alone has 81 samples in reach.
    let spare = Test::Time { frame: 0, other: 0 };
    let mut tests: [Test; 64] = std::array::from_fn(|_| all.next().unwrap_or(spare));
    tests.sort_by_key(|test| matches!(test, Test::Time { .. }));
    tests
}

/// Bands of a run that are left to its thread.
const LEFT: usize = 2;
/// Rows of a task within a frame, where a thread's tasks follow each other and take over its rows...
const BAND: usize = 16;
/// ...and of one where they do not, and each begins with rows of its own.
const BAND_ALONE: usize = 64;

/// Working memory for descriptors, one per thread.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    codes: PerThread<Codes>,
    /// Number of stacks described.
    stamp: u64,
}

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
    pub(crate) fn describe(
        &mut self,
        level: Level,
        images: &[&Image<Sample>],
        scratch: &mut Scratch,
    ) {
        let width = images[0].width();
        let blocks = width.next_multiple_of(BLOCK);
        self.width = width;
        self.stride = blocks + 2 * MARGIN;
        self.data.resize(self.stride * images[0].height(), OUTSIDE);
        let tests = match self.tests {
            Some((frames, tests)) if frames == images.len() => tests,
            _ => self.tests.insert((images.len(), tests(images.len()))).1,
        };
        let stride = self.stride;
        scratch.stamp += 1;
        let (stamp, scratch) = (scratch.stamp, scratch.codes.ready());
        let band_rows = if parallel::is_shared() { BAND } else { BAND_ALONE };
        self.data.par_chunks_mut(stride * band_rows).enumerate().share_runs(
            LEFT,
            |(band, rows)| {
                scratch.with(|codes| {
                    let top = band * band_rows;
                    codes.begin(level, images, top, stamp);
                    for (y, out) in (top..).zip(rows.chunks_mut(stride)) {
                        codes.next(level, images, y);
                        describe_row(level, &tests, codes, y, &mut out[MARGIN..][..blocks]);
                        out[..MARGIN].fill(OUTSIDE);
                        out[MARGIN + width..].fill(OUTSIDE);
                    }
                });
            },
        );
    }
}

/// Describes row `y`, in whole blocks.
fn describe_row(level: Level, tests: &[Test; 64], codes: &Codes, y: usize, out: &mut [u64]) {
    let (around, mean) = (codes.around(y), codes.mean());
    let mut rows = Rows { codes: [mean; 64], than: [mean; 64], means: 0 };
    for (test, (row, than)) in tests.iter().zip(rows.codes.iter_mut().zip(&mut rows.than)) {
        match *test {
            Test::Mean { at, frame } => {
                *row = around.row(frame, at);
                rows.means += 1;
            }
            Test::Time { frame, other } => {
                (*row, *than) = (around.row(frame, (0, 0)), around.row(other, (0, 0)));
            }
        }
    }
    let rows = &rows;
    assert!(out.len().is_multiple_of(BLOCK) && out.as_ptr().addr().is_multiple_of(64));
    assert!(rows.codes.iter().chain(&rows.than).all(|row| row.len() >= out.len()));
    match level {
        // SAFETY: trusted levels are the processor's; lengths and `out`'s address are as checked.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::blocks(rows, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::blocks(rows, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::blocks(rows, out) },
        _ => scalar::blocks(rows, out),
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
        for (width, height, frames) in
            [(77, 9, 10), (40, 5, 1), (3, 2, 4), (129, 3, 16), (64, 70, 3), (130, 140, 2)]
        {
            let images: Vec<Image<Sample>> = (0..frames)
                .map(|_| Image::new(width, height, 0).map(|_: i16| (random.bits() % 16_000) as i16))
                .collect();
            let images: Vec<&Image<Sample>> = images.iter().collect();
            let mut scratch = Scratch::default();
            let mut want = Descriptors::default();
            want.describe(Level::Scalar, &images, &mut scratch);
            for level in Level::available() {
                let mut got = Descriptors::default();
                got.describe(level, &images, &mut scratch);
                assert_eq!(&*got.data, &*want.data, "{level} {width}");
            }
            // Of grey levels: half a code each, and two more up to 64.
            let code = |sample: f64| (sample / 128.0).floor() + (sample / 32.0).floor().min(128.0);
            let (x, y) = ((width / 2) as isize, (height / 2) as isize);
            let radius: isize = if frames < 4 { 4 } else { 2 };
            let at = |dx: isize, dy: isize, f: usize| {
                let x = (x + dx).clamp(0, width as isize - 1) as usize;
                f64::from(images[f].row((y + dy).clamp(0, height as isize - 1) as usize)[x])
            };
            let window =
                (-radius..=radius).flat_map(|dy| (-radius..=radius).map(move |dx| (dx, dy)));
            let sum: f64 =
                window.flat_map(|(dx, dy)| (0..frames).map(move |f| at(dx, dy, f))).sum();
            let mean = sum / ((2 * radius + 1).pow(2) as f64 * frames as f64);
            for (k, test) in tests(frames).iter().enumerate() {
                let bit = want.row(y as usize)[MARGIN + x as usize] >> k & 1 == 1;
                match *test {
                    Test::Mean { at: (dx, dy), frame } => {
                        let v = at(dx, dy, frame);
                        let above = code(v) > code(mean);
                        assert!(bit == above || (code(v) - code(mean)).abs() <= 1.0, "{v} {mean}");
                    }
                    Test::Time { frame, other } => {
                        assert_eq!(bit, code(at(0, 0, frame)) > code(at(0, 0, other)));
                    }
                }
            }
        }
    }
}
