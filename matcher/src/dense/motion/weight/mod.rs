//! Gradients weighted by their frame's time, and the sums over time that hold them.
//!
//! Times are -1..=1 in units of 2^-15; products are rounded to whole gradient units, pair by pair as
//! [`crate::dense::gradient`] lays them out.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;

use crate::Level;

/// Pixels that a row of sums is a multiple of.
const BLOCK: usize = 16;

/// Where a row's results go.
pub(crate) struct Weighted<'a> {
    /// Weighted gradient pairs, laid out as the gradients are.
    pub gradient: &'a mut [i32],
    /// Sum over time of weighted gradient times grey value.
    pub ilt: &'a mut [f32],
    /// Of the weighted gradient.
    pub it: &'a mut [f32],
    /// Of its product with the gradient.
    pub st: &'a mut [f32],
    /// Of its square.
    pub stt: &'a mut [f32],
}

/// Times as the kernels take them: a pair of frames in a word.
pub(crate) fn words(times: &[f32; 16]) -> [i32; 8] {
    let fixed = |t: f32| (t * 32_767.0).round_ties_even() as i16;
    std::array::from_fn(|k| {
        i32::from(fixed(times[2 * k]) as u16) | i32::from(fixed(times[2 * k + 1])) << 16
    })
}

/// Weighs the gradients of a row: as many words a pair of frames as each sum has pixels.
pub(crate) fn weigh(
    level: Level,
    gradient: &[i32],
    grey: &[i32],
    times: &[i32; 8],
    out: &mut Weighted<'_>,
) {
    let len = out.ilt.len();
    assert!(len.is_multiple_of(BLOCK) && gradient.len() == grey.len());
    assert!(gradient.len().is_multiple_of(len.max(1)) && gradient.len() <= 8 * len);
    assert!(out.gradient.len() == gradient.len());
    assert!([&out.it, &out.st, &out.stt].iter().all(|sum| sum.len() == len));
    match level {
        // SAFETY: trusted levels are the processor's; slices are as long as checked.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::weigh(gradient, grey, times, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::weigh(gradient, grey, times, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::weigh(gradient, grey, times, out) },
        _ => scalar::weigh(gradient, grey, times, out),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        guarded::{Edge, Guarded},
        synthetic::Random,
    };

    #[test]
    fn levels_are_bit_equal_and_sum_what_they_say() {
        let mut random = Random::new(6);
        let times: [f32; 16] = std::array::from_fn(|k| (k as f32 - 7.5) / 7.5);
        for (len, pairs) in [(16usize, 1usize), (64, 5), (48, 8)] {
            let mut words_of = |from: i32, range: u64| -> Vec<i32> {
                let mut half = || from + (random.bits() % range) as i32;
                (0..len * pairs).map(|_| (half() & 0xFFFF) | half() << 16).collect()
            };
            let (gradient, grey) = (words_of(-2040, 4081), words_of(0, 4081));
            let run = |level: Level| {
                let guarded = |words: &[i32]| Guarded::new(words, Edge::End);
                let (gradient, grey) = (guarded(&gradient), guarded(&grey));
                let mut weighted = guarded(&vec![0; len * pairs]);
                let mut sums: [Guarded<f32>; 4] =
                    std::array::from_fn(|_| Guarded::new(&vec![0.0; len], Edge::End));
                let [ilt, it, st, stt] = &mut sums;
                let mut out = Weighted { gradient: &mut weighted, ilt, it, st, stt };
                weigh(level, &gradient, &grey, &words(&times), &mut out);
                (weighted.to_vec(), sums.map(|sum| sum.to_vec()))
            };
            let want = run(Level::Scalar);
            for level in Level::available() {
                assert_eq!(run(level), want, "{level} {len} {pairs}");
            }
            for x in 0..len {
                let exact: f64 = (0..2 * pairs)
                    .map(|k| {
                        let word = gradient[k / 2 * len + x];
                        let g = if k % 2 == 0 { (word << 16) >> 16 } else { word >> 16 };
                        f64::from(times[k]) * f64::from(g).powi(2)
                    })
                    .sum();
                let off = (f64::from(want.1[2][x]) - exact).abs();
                assert!(off < 2.0 * pairs as f64 * 1200.0, "{x}: {} {exact}", want.1[2][x]);
            }
        }
    }
}
