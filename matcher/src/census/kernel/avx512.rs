//! Census with AVX-512: 32 pixels at a time.

use std::arch::x86_64::*;

use crate::{Sample, params::RADIUS_LIMIT};

/// The slices are as long as [`super::CensusKernel::run`] asserts.
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) fn census(rows: &[&[Sample]], radius: usize, thresholds: &[Sample], planes: &mut [u16]) {
    let side = 2 * radius + 1;
    let stride = thresholds.len();
    for x in (0..stride).step_by(32) {
        // SAFETY: x + 32 <= stride, the length of `thresholds`.
        let threshold = unsafe { _mm512_loadu_si512(thresholds.as_ptr().add(x).cast()) };
        let mut word = _mm512_setzero_si512();
        let mut k = 0;
        for window in rows.chunks_exact(side) {
            for i in 0..side {
                let column = RADIUS_LIMIT - radius + i + x;
                for row in window {
                    // SAFETY: column + 32 <= 2 RADIUS_LIMIT + stride, at most the row's length.
                    let sample = unsafe { _mm512_loadu_si512(row.as_ptr().add(column).cast()) };
                    let above = _mm512_cmpgt_epi16_mask(sample, threshold);
                    let bit = _mm512_set1_epi16(1i16 << (k % 16));
                    word = _mm512_mask_add_epi16(word, above, word, bit);
                    k += 1;
                    if k % 16 == 0 {
                        let at = (k / 16 - 1) * stride + x;
                        // SAFETY: plane k / 16 - 1 is complete inside `planes`.
                        unsafe { _mm512_storeu_si512(planes.as_mut_ptr().add(at).cast(), word) };
                        word = _mm512_setzero_si512();
                    }
                }
            }
        }
        if k % 16 != 0 {
            let at = k / 16 * stride + x;
            // SAFETY: `planes` has a last plane for the bits left over.
            unsafe { _mm512_storeu_si512(planes.as_mut_ptr().add(at).cast(), word) };
        }
    }
}
