//! The warp of one row: the right stack interpolated at x - w(x), and the sums over time of its
//! products with the left stack.

pub(crate) mod moving;
mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;

use super::kernels::{Kernels, PHASES};
use crate::{Level, Sample};

/// Disparities of this magnitude are invalid at any image size.
const FARTHEST: f32 = 1_048_576.0;

/// What a warp reads; slices of pixels start at image column `x0`.
pub(crate) struct Source<'a> {
    /// Rows of the right stack: an even number, a last odd frame followed by zeros.
    pub right: &'a [&'a [Sample]],
    /// Image column of the first pixel.
    pub x0: usize,
    /// Disparity in px; NaN is invalid.
    pub w: &'a [f32],
    /// Gradient pairs of the left stack ([`super::gradient`]).
    pub gradient: &'a [i32],
    /// Grey value pairs of the left stack.
    pub grey: &'a [i32],
    /// Words per pair of frames.
    pub stride: usize,
}

/// Where a warp's results go. Invalid pixels, and such whose interpolation reaches beyond the right
/// image, get zeros.
pub(crate) struct Warped<'a> {
    /// The disparity used: `w` rounded to 1/16 px.
    pub at: &'a mut [f32],
    /// One where valid.
    pub valid: &'a mut [f32],
    /// Sum over time of left gradient times right grey value.
    pub ig: &'a mut [f32],
    /// Sum over time of the right grey value.
    pub g: &'a mut [f32],
    /// Sum over time of the squared right grey value, in [`super::gradient::SQUARE_UNIT`].
    pub gg: &'a mut [f32],
    /// Sum over time of left times right grey value, in the same unit, where it is wanted.
    pub lg: Option<&'a mut [f32]>,
    /// Where they are wanted, and `lg` is: products with gradients that are weighted by time.
    pub timed: Option<Timed<'a>>,
}

/// Sums for motion.
pub(crate) struct Timed<'a> {
    /// Gradient pairs of the left stack times their frame's time, laid out as [`Source::gradient`].
    pub gradient: &'a [i32],
    /// Sum over time of these times the right grey value.
    pub ig: &'a mut [f32],
}

/// Warps one row. Grey values are in 1/16 of an 8-bit grey level.
pub(crate) fn warp_row(level: Level, source: &Source<'_>, out: &mut Warped<'_>) {
    let len = source.w.len();
    let width = source.right[0].len();
    assert!(source.right.len().is_multiple_of(2));
    assert!(source.right.iter().all(|r| r.len() == width));
    let words = source.right.len() / 2 * source.stride;
    assert!(len <= source.stride && source.gradient.len() >= words && source.grey.len() >= words);
    for map in [&out.at, &out.valid, &out.ig, &out.g, &out.gg].into_iter().chain(&out.lg) {
        assert!(map.len() >= len);
    }
    if let Some(timed) = &out.timed {
        assert!(timed.ig.len() >= len && timed.gradient.len() >= words && out.lg.is_some());
    }
    let kernels = Kernels::get();
    let done = match level {
        // SAFETY: trusted levels are the processor's; slices are as long as checked above; rows
        // hold at least one window of 32 samples.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 if width >= 32 => unsafe { avx512::blocks(kernels, source, out) },
        // SAFETY: as above; rows hold at least 8 samples.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 if width >= 8 => unsafe { avx2::blocks(kernels, source, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon if width >= 8 => unsafe { neon::blocks(kernels, source, out) },
        _ => 0,
    };
    scalar::pixels(kernels, source, done..len, out);
}

/// Position in the right row, in 1/16 px, of the first of the eight taps; `None` when it or the last
/// tap lies outside.
#[inline]
fn position(x: usize, w: f32, width: usize) -> Option<(f32, usize, usize)> {
    if w.is_nan() || w.abs() >= FARTHEST {
        return None;
    }
    let steps = (w * PHASES as f32).round_ties_even();
    let at = x as i64 * PHASES as i64 - steps as i64;
    let first = at.div_euclid(PHASES as i64) - 3;
    let inside = first >= 0 && first + 8 <= width as i64;
    inside.then(|| (steps / PHASES as f32, first as usize, at.rem_euclid(PHASES as i64) as usize))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        guarded::{Edge, Guarded},
        synthetic::Random,
    };

    fn run(level: Level, right: &[Vec<Sample>], x0: usize, w: &[f32], edge: Edge) -> [Vec<f32>; 7] {
        let right: Vec<Guarded<Sample>> = right.iter().map(|r| Guarded::new(r, edge)).collect();
        let rows: Vec<&[Sample]> = right.iter().map(|r| &r[..]).collect();
        let w = &*Guarded::new(w, edge);
        let mut random = Random::new(8);
        let words = rows.len() / 2 * w.len();
        let pair = |r: &mut Random| {
            let half = |r: &mut Random| (r.bits() % 4081) as i32;
            half(r) | (half(r) - 2040) << 16
        };
        let mut pairs = || {
            let pairs: Vec<i32> = (0..words).map(|_| pair(&mut random)).collect();
            Guarded::new(&pairs, edge)
        };
        let (gradient, grey, weighted) = (pairs(), pairs(), pairs());
        let map = || Guarded::new(&vec![7.0; w.len()], edge);
        let mut maps: [Guarded<f32>; 7] = std::array::from_fn(|_| map());
        let [at, valid, ig, g, gg, lg, igt] = &mut maps;
        let source =
            Source { right: &rows, x0, w, gradient: &gradient, grey: &grey, stride: w.len() };
        let timed = Some(Timed { gradient: &weighted, ig: igt });
        warp_row(level, &source, &mut Warped { at, valid, ig, g, gg, lg: Some(lg), timed });
        for with_lg in [false, true] {
            let mut without: [Guarded<f32>; 6] = std::array::from_fn(|_| map());
            let [at, valid, ig, g, gg, lg] = &mut without;
            let lg = with_lg.then_some(&mut lg[..]);
            warp_row(level, &source, &mut Warped { at, valid, ig, g, gg, lg, timed: None });
            let count = if with_lg { 6 } else { 5 };
            for (without, map) in without.iter().zip(&maps).take(count) {
                assert_eq!(without[..], map[..], "{level}");
            }
        }
        maps.map(|map| map.to_vec())
    }

    #[test]
    fn levels_are_bit_equal() {
        let mut random = Random::new(3);
        for (width, x0, len) in
            [(200, 0, 200), (131, 40, 91), (131, 40, 128), (40, 0, 48), (12, 0, 16)]
        {
            let rows: Vec<Vec<Sample>> = (0..10)
                .map(|_| (0..width).map(|_| (random.bits() % 16_321) as i16).collect())
                .collect();
            for (roughness, whole) in
                [(0.3, false), (8.0, false), (120.0, false), (0.0, true), (0.6, true), (60.0, true)]
            {
                let mut w: Vec<f32> = (0..len)
                    .map(|i| {
                        let w = 3.0 + 0.1 * i as f64 + roughness * (random.unit() - 0.5);
                        (if whole { w.round() } else { w }) as f32
                    })
                    .collect();
                w[3] = f32::NAN;
                w[5] = f32::INFINITY;
                w[6] = -1e30;
                let want = run(Level::Scalar, &rows, x0, &w, Edge::End);
                for (level, edge) in Level::available().flat_map(|l| Edge::BOTH.map(|e| (l, e))) {
                    let got = run(level, &rows, x0, &w, edge);
                    assert_eq!(got, want, "{level} {edge:?} {width} {x0} {len}");
                }
            }
        }
    }

    /// Against the interpolation written out: smooth rows come out right between samples.
    #[test]
    fn interpolates_a_smooth_row() {
        let f = |x: f64| 8000.0 + 4000.0 * (0.7 * x).sin();
        let row: Vec<Sample> = (0..80).map(|x| f(x as f64).round() as Sample).collect();
        let w: Vec<f32> = (0..80).map(|x| 0.0625 * (x % 16) as f32).collect();
        let out = run(Level::Scalar, &[row, vec![0; 80]], 0, &w, Edge::End);
        for x in 10..70 {
            let want = f(x as f64 - f64::from(w[x])) / 4.0;
            assert!((f64::from(out[3][x]) - want).abs() < 6.0, "{x} {} {want}", out[3][x]);
        }
    }
}
