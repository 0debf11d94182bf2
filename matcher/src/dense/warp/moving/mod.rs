//! The warp of one row of a moving surface: each frame of the right stack is interpolated at its own
//! place, x - w(x) - rate(x) offset_k.
//!
//! Sums and units are those of [`super::warp_row`], so that whatever follows does not know of motion.
//! The place is rounded to 1/16 px frame by frame; `at` is w plus the mean of these roundings, each
//! weighted as the fit weights its frame.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;

use super::{FARTHEST, Source, Warped};
use crate::{
    Level, Sample,
    dense::{
        gradient::SQUARE_SHIFT,
        kernels::{Kernels, PHASES, TAPS},
    },
    lanes::vectorised,
};

/// How a row moves.
pub(crate) struct Moving<'a> {
    /// Rate of the disparity per pixel, per unit of the offsets; as long as [`Source::w`].
    pub rate: &'a [f32],
    /// Time of each frame against the time that w refers to; as many as there are frames.
    pub offsets: &'a [f32],
}

/// Buffers of [`warp_moving_row`], kept between rows.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    /// Place in the right row in 1/16 px.
    place: Vec<i32>,
    grey: Vec<i16>,
    sums: [Vec<i32>; 4],
    rounding: Vec<f32>,
    squares: Vec<f32>,
}

impl Scratch {
    fn resize(&mut self, len: usize) {
        self.place.resize(len, 0);
        self.grey.resize(len, 0);
        for sum in &mut self.sums {
            sum.clear();
            sum.resize(len, 0);
        }
        for sum in [&mut self.rounding, &mut self.squares] {
            sum.clear();
            sum.resize(len, 0.0);
        }
    }
}

/// Warps one row, each frame at its own place; otherwise as [`super::warp_row`]. A pixel is valid
/// where all frames are.
pub(crate) fn warp_moving_row(
    level: Level,
    source: &Source<'_>,
    moving: &Moving<'_>,
    scratch: &mut Scratch,
    out: &mut Warped<'_>,
) {
    let len = source.w.len();
    let width = source.right[0].len();
    let frames = moving.offsets.len();
    assert!(frames <= source.right.len() && moving.rate.len() == len);
    assert!(source.right.iter().all(|r| r.len() == width));
    let words = source.right.len() / 2 * source.stride;
    assert!(len <= source.stride && source.gradient.len() >= words && source.grey.len() >= words);
    for map in [&out.at, &out.valid, &out.ig, &out.g, &out.gg].into_iter().chain(&out.lg) {
        assert!(map.len() >= len);
    }
    scratch.resize(len);
    let valid = &mut out.valid[..len];
    for (valid, w) in valid.iter_mut().zip(source.w) {
        *valid = if w.abs() < FARTHEST { 1.0 } else { 0.0 };
    }
    let kernels = Kernels::get();
    for frame in 0..frames {
        let word = frame / 2 * source.stride;
        let gradient = &source.gradient[word..word + len];
        let grey = &source.grey[word..word + len];
        // The even frame lies in the low half of a word.
        let shift = if frame % 2 == 0 { 16 } else { 0 };
        let Scratch { place, grey: g, sums, rounding, squares } = scratch;
        vectorised!(
            level,
            place_loop(
                bounds: (usize, usize) = (source.x0, width),
                w: &[f32] = source.w,
                rate: &[f32] = moving.rate,
                offset: f32 = moving.offsets[frame],
                gradient: (&[i32], u32) = (gradient, shift),
                place: &mut [i32] = place,
                valid: &mut [f32] = valid,
                rounding: &mut [f32] = rounding,
                squares: &mut [f32] = squares,
            )
        );
        interpolate(level, kernels, source.right[frame], place, g);
        vectorised!(
            level,
            sum_loop(
                g: &[i16] = g,
                gradient: &[i32] = gradient,
                grey: &[i32] = grey,
                shift: u32 = shift,
                sums: &mut [Vec<i32>; 4] = sums,
            )
        );
    }
    vectorised!(
        level,
        finish_loop(
            w: &[f32] = source.w,
            scratch: &Scratch = scratch,
            out: &mut Warped<'_> = out,
        )
    );
}

/// Where each pixel is interpolated in one frame; adds to the weighted roundings.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn place_loop(
    (x0, width): (usize, usize),
    w: &[f32],
    rate: &[f32],
    offset: f32,
    (gradient, shift): (&[i32], u32),
    place: &mut [i32],
    valid: &mut [f32],
    rounding: &mut [f32],
    squares: &mut [f32],
) {
    let phases = PHASES as f32;
    let last = (width as i32 - TAPS as i32 + 3) * PHASES as i32 + PHASES as i32 - 1;
    let first = 3 * PHASES as i32;
    let n = w.len();
    let (rate, gradient, place) = (&rate[..n], &gradient[..n], &mut place[..n]);
    let (valid, rounding, squares) = (&mut valid[..n], &mut rounding[..n], &mut squares[..n]);
    for i in 0..n {
        let known = w[i].abs() < FARTHEST && rate[i].abs() < FARTHEST;
        let d = if known { w[i] + rate[i] * offset } else { 0.0 };
        let steps = (d * phases).round_ties_even();
        let at = (x0 + i) as i32 * PHASES as i32 - steps as i32;
        let inside = known & (at >= first) & (at <= last);
        valid[i] = if inside { valid[i] } else { 0.0 };
        place[i] = if inside { at } else { first };
        let slope = ((gradient[i] << shift) >> 16) as f32;
        rounding[i] += slope * slope * (steps / phases - d);
        squares[i] += slope * slope;
    }
}

/// Adds one frame's products to the sums over time.
#[inline(always)]
fn sum_loop(g: &[i16], gradient: &[i32], grey: &[i32], shift: u32, sums: &mut [Vec<i32>; 4]) {
    let n = g.len();
    let [ig, g1, gg, lg] = sums;
    let (ig, g1, gg, lg) = (&mut ig[..n], &mut g1[..n], &mut gg[..n], &mut lg[..n]);
    let (gradient, grey) = (&gradient[..n], &grey[..n]);
    for i in 0..n {
        let value = i32::from(g[i]);
        ig[i] = ig[i].wrapping_add(((gradient[i] << shift) >> 16).wrapping_mul(value));
        lg[i] = lg[i].wrapping_add(((grey[i] << shift) >> 16).wrapping_mul(value));
        g1[i] = g1[i].wrapping_add(value);
        gg[i] = gg[i].wrapping_add(value * value);
    }
}

#[inline(always)]
fn finish_loop(w: &[f32], scratch: &Scratch, out: &mut Warped<'_>) {
    let n = w.len();
    let [ig, g1, gg, lg] = &scratch.sums;
    let half = 1 << (SQUARE_SHIFT - 1);
    for i in 0..n {
        let valid = out.valid[i] > 0.5;
        let keep = |v: i32| if valid { v as f32 } else { 0.0 };
        let mean = scratch.rounding[i] / scratch.squares[i].max(1.0);
        out.at[i] = if valid { w[i] + mean } else { 0.0 };
        out.ig[i] = keep(ig[i]);
        out.g[i] = keep(g1[i]);
        out.gg[i] = keep(gg[i].wrapping_add(half) >> SQUARE_SHIFT);
    }
    let Some(out_lg) = &mut out.lg else { return };
    for i in 0..n {
        let sum = lg[i].wrapping_add(half) >> SQUARE_SHIFT;
        out_lg[i] = if out.valid[i] > 0.5 { sum as f32 } else { 0.0 };
    }
}

/// Grey values of `row` at `place` in 1/16 px, all within the row, in 1/16 grey level.
fn interpolate(level: Level, kernels: &Kernels, row: &[Sample], place: &[i32], grey: &mut [i16]) {
    assert!(grey.len() >= place.len());
    let done = match level {
        // SAFETY: trusted levels are the processor's; `place_loop` keeps the taps inside rows, which
        // hold at least one window of 32 samples.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 if row.len() >= 32 => unsafe { avx512::blocks(kernels, row, place, grey) },
        // SAFETY: as above, with rows of at least 8 samples.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 if row.len() >= 8 => unsafe { avx2::blocks(kernels, row, place, grey) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon if row.len() >= 8 => unsafe { neon::blocks(kernels, row, place, grey) },
        _ => 0,
    };
    scalar::pixels(kernels, row, &place[done..], &mut grey[done..place.len()]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        guarded::{Edge, Guarded},
        synthetic::Random,
    };

    type Maps = [Vec<f32>; 6];

    struct Input {
        rows: Vec<Vec<Sample>>,
        gradient: Vec<i32>,
        grey: Vec<i32>,
        w: Vec<f32>,
        rate: Vec<f32>,
        offsets: Vec<f32>,
    }

    fn input(width: usize, len: usize, frames: usize, roughness: f64) -> Input {
        let mut random = Random::new(11);
        let even = frames.next_multiple_of(2);
        let mut rows: Vec<Vec<Sample>> = (0..frames)
            .map(|_| (0..width).map(|_| (random.bits() % 16_321) as i16).collect())
            .collect();
        rows.resize(even, vec![0; width]);
        let half = |r: &mut Random| (r.bits() % 4081) as i32 - 2040;
        let mut words = || -> Vec<i32> {
            let word = |r: &mut Random| (half(r) & 0xFFFF) | half(r) << 16;
            (0..even / 2 * len).map(|_| word(&mut random)).collect()
        };
        let (gradient, grey) = (words(), words());
        let mut w: Vec<f32> = (0..len)
            .map(|i| (3.0 + 0.1 * i as f64 + roughness * (random.unit() - 0.5)) as f32)
            .collect();
        w[3] = f32::NAN;
        w[5] = f32::INFINITY;
        let rate = (0..len).map(|i| 0.01 * (i % 40) as f32).collect();
        let offsets = (0..frames).map(|k| k as f32 - frames as f32 + 1.0).collect();
        Input { rows, gradient, grey, w, rate, offsets }
    }

    fn run(level: Level, input: &Input, x0: usize, edge: Edge) -> Maps {
        let rows: Vec<Guarded<Sample>> = input.rows.iter().map(|r| Guarded::new(r, edge)).collect();
        let rows: Vec<&[Sample]> = rows.iter().map(|r| &r[..]).collect();
        let (w, len) = (&input.w, input.w.len());
        let mut maps: Maps = std::array::from_fn(|_| vec![7.0; len]);
        let [at, valid, ig, g, gg, lg] = &mut maps;
        let (gradient, grey) = (&input.gradient[..], &input.grey[..]);
        let source = Source { right: &rows, x0, w, gradient, grey, stride: len };
        let moving = Moving { rate: &input.rate, offsets: &input.offsets };
        let mut out = Warped { at, valid, ig, g, gg, lg: Some(lg), timed: None };
        warp_moving_row(level, &source, &moving, &mut Scratch::default(), &mut out);
        maps
    }

    #[test]
    fn levels_are_bit_equal() {
        for (width, x0, len, frames) in [
            (200, 0, 200, 10),
            (131, 40, 91, 5),
            (131, 40, 128, 3),
            (40, 0, 48, 16),
            (12, 0, 16, 4),
        ] {
            for roughness in [0.3, 8.0, 120.0] {
                let input = input(width, len, frames, roughness);
                let want = run(Level::Scalar, &input, x0, Edge::End);
                for (level, edge) in Level::available().flat_map(|l| Edge::BOTH.map(|e| (l, e))) {
                    let got = run(level, &input, x0, edge);
                    assert_eq!(got, want, "{level} {edge:?} {width} {x0} {len}");
                }
            }
        }
    }

    /// Without motion, all sums are those of the plain warp.
    #[test]
    fn at_rest_it_is_the_plain_warp() {
        let mut input = input(200, 200, 10, 8.0);
        input.rate.fill(0.0);
        let moving = run(Level::best(), &input, 0, Edge::End);
        let rows: Vec<&[Sample]> = input.rows.iter().map(|r| &r[..]).collect();
        let mut maps: Maps = std::array::from_fn(|_| vec![7.0; 200]);
        let [at, valid, ig, g, gg, lg] = &mut maps;
        let (w, gradient, grey) = (&input.w[..], &input.gradient[..], &input.grey[..]);
        let source = Source { right: &rows, x0: 0, w, gradient, grey, stride: 200 };
        super::super::warp_row(
            Level::best(),
            &source,
            &mut Warped { at, valid, ig, g, gg, lg: Some(lg), timed: None },
        );
        assert_eq!(moving[1..], maps[1..]);
        for (a, b) in moving[0].iter().zip(&maps[0]) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
    }

    /// Against the definition in f64: grey values of a smooth function at x - w - rate offset.
    #[test]
    fn interpolates_each_frame_at_its_own_place() {
        let f = |x: f64| 8000.0 + 4000.0 * (0.7 * x).sin();
        let rows: Vec<Vec<Sample>> =
            vec![(0..120).map(|x| f(f64::from(x)).round() as Sample).collect(); 4];
        let mut input = input(120, 120, 4, 0.0);
        input.rows = rows;
        input.w = vec![4.3; 120];
        input.rate = vec![0.5; 120];
        let out = run(Level::best(), &input, 0, Edge::End);
        for (x, (g, at)) in out[3].iter().zip(&out[0]).enumerate().take(100).skip(20) {
            let want: f64 =
                (0..4).map(|k| f(x as f64 - 4.3 - 0.5 * (f64::from(k) - 3.0)) / 4.0).sum();
            // Places are rounded to 1/16 px: 1/32 px of the steepest slope, four times.
            assert!((f64::from(*g) - want).abs() < 4.0 * 700.0 / 32.0 + 4.0);
            assert!((f64::from(*at) - 4.3).abs() < 1.0 / 32.0 + 1e-5);
        }
    }
}
