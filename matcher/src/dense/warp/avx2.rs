//! AVX2: 8 pixels a block; each pixel's eight taps are one load, summed by horizontal additions.

use std::arch::x86_64::*;

use super::{Source, Warped, position};
use crate::dense::{gradient::SQUARE_SHIFT, kernels::Kernels};

/// Does whole blocks, and returns the number of pixels done.
///
/// # Safety
/// The processor has AVX2; rows hold at least 8 samples; slices are as long as [`super::warp_row`]
/// checks.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn blocks(kernels: &Kernels, source: &Source<'_>, out: &mut Warped<'_>) -> usize {
    let width = source.right[0].len();
    let ones = _mm256_set1_epi16(1);
    let half = _mm256_set1_epi32(0x8000);
    let quarter = _mm256_set1_epi16(8192);
    let blocks = source.w.len() / 8;
    for block in 0..blocks {
        let i = block * 8;
        let mut first = [0usize; 8];
        let mut phase = [0usize; 8];
        let mut mask = [0i32; 8];
        for l in 0..8 {
            let place = position(source.x0 + i + l, source.w[i + l], width);
            out.at[i + l] = place.map_or(0.0, |p| p.0);
            out.valid[i + l] = if place.is_some() { 1.0 } else { 0.0 };
            if let Some((_, f, p)) = place {
                (first[l], phase[l], mask[l]) = (f, p, -1);
            }
        }
        // Neighbours at one whole disparity, as where a coarse search starts: nothing is interpolated.
        let together = (0..8).all(|l| mask[l] != 0 && phase[l] == 0 && first[l] == first[0] + l);
        let mut taps = [half; 4];
        for (j, taps) in taps.iter_mut().enumerate() {
            // SAFETY: a phase's taps are 16 bytes.
            *taps = unsafe {
                two(kernels.taps[phase[j]].as_ptr(), kernels.taps[phase[j + 4]].as_ptr())
            };
        }
        // SAFETY: 32 bytes.
        let mask = unsafe { _mm256_loadu_si256(mask.as_ptr().cast()) };
        let zero = _mm256_setzero_si256();
        let (mut ig, mut g1, mut gg, mut lg, mut igt) = (zero, zero, zero, zero, zero);
        for (pair, rows) in source.right.chunks_exact(2).enumerate() {
            // The images' next row, a line of 32 samples for four blocks.
            if block % 4 == 0 {
                for row in rows {
                    let next = row.as_ptr().wrapping_add(row.len() + first[0] + 16);
                    _mm_prefetch::<_MM_HINT_T0>(next.cast());
                }
            }
            let g = if together {
                // SAFETY: eight samples from the fourth of the first pixel's taps end before the
                // last pixel's last tap.
                let (even, odd) = unsafe {
                    (
                        _mm_loadu_si128(rows[0].as_ptr().add(first[0] + 3).cast()),
                        _mm_loadu_si128(rows[1].as_ptr().add(first[0] + 3).cast()),
                    )
                };
                let samples =
                    _mm256_set_m128i(_mm_unpackhi_epi16(even, odd), _mm_unpacklo_epi16(even, odd));
                // Rounds as the taps of phase 0 do.
                _mm256_mulhrs_epi16(samples, quarter)
            } else {
                let mut sums = [half; 2];
                for (sum, row) in sums.iter_mut().zip(rows) {
                    let mut products = taps;
                    for (j, product) in products.iter_mut().enumerate() {
                        // SAFETY: `first + 8` is at most the row's length.
                        let samples = unsafe {
                            two(row.as_ptr().add(first[j]), row.as_ptr().add(first[j + 4]))
                        };
                        *product = _mm256_madd_epi16(samples, *product);
                    }
                    let all = _mm256_hadd_epi32(
                        _mm256_hadd_epi32(products[0], products[1]),
                        _mm256_hadd_epi32(products[2], products[3]),
                    );
                    *sum = _mm256_add_epi32(*sum, all);
                }
                let even = _mm256_srli_epi32::<16>(sums[0]);
                _mm256_blend_epi16::<0xAA>(even, sums[1])
            };
            let word = pair * source.stride + i;
            // SAFETY: `word + 8` lies within the gradients.
            let gradient = unsafe { _mm256_loadu_si256(source.gradient.as_ptr().add(word).cast()) };
            ig = _mm256_add_epi32(ig, _mm256_madd_epi16(g, gradient));
            if out.lg.is_some() {
                // SAFETY: as above, within the grey values.
                let grey = unsafe { _mm256_loadu_si256(source.grey.as_ptr().add(word).cast()) };
                lg = _mm256_add_epi32(lg, _mm256_madd_epi16(g, grey));
            }
            if let Some(timed) = &out.timed {
                // SAFETY: as above, within the weighted gradients.
                let t = unsafe { _mm256_loadu_si256(timed.gradient.as_ptr().add(word).cast()) };
                igt = _mm256_add_epi32(igt, _mm256_madd_epi16(g, t));
            }
            g1 = _mm256_add_epi32(g1, _mm256_madd_epi16(g, ones));
            gg = _mm256_add_epi32(gg, _mm256_madd_epi16(g, g));
        }
        let float = |v| _mm256_cvtepi32_ps(_mm256_and_si256(v, mask));
        let square = |v| {
            let rounded = _mm256_add_epi32(v, _mm256_set1_epi32(1 << (SQUARE_SHIFT - 1)));
            float(_mm256_srai_epi32::<{ SQUARE_SHIFT as i32 }>(rounded))
        };
        // SAFETY: `i + 8` lies within every map.
        unsafe {
            _mm256_storeu_ps(out.ig.as_mut_ptr().add(i), float(ig));
            _mm256_storeu_ps(out.g.as_mut_ptr().add(i), float(g1));
            _mm256_storeu_ps(out.gg.as_mut_ptr().add(i), square(gg));
            if let Some(out) = &mut out.lg {
                _mm256_storeu_ps(out.as_mut_ptr().add(i), square(lg));
            }
            if let Some(timed) = &mut out.timed {
                _mm256_storeu_ps(timed.ig.as_mut_ptr().add(i), float(igt));
            }
        }
    }
    blocks * 8
}

/// Eight samples from each of two places.
///
/// # Safety
/// They are readable.
#[target_feature(enable = "avx2")]
#[inline]
unsafe fn two(low: *const i16, high: *const i16) -> __m256i {
    // SAFETY: the caller's promise.
    unsafe {
        _mm256_inserti128_si256::<1>(
            _mm256_castsi128_si256(_mm_loadu_si128(low.cast())),
            _mm_loadu_si128(high.cast()),
        )
    }
}
