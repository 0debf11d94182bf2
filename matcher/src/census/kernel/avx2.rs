//! Census with AVX2: 16 pixels at a time.

use std::arch::x86_64::*;

use crate::{Sample, params::RADIUS_LIMIT};

/// The slices are as long as [`super::CensusKernel::run`] asserts.
#[target_feature(enable = "avx2")]
pub(super) fn census(rows: &[&[Sample]], radius: usize, thresholds: &[Sample], planes: &mut [u16]) {
    let side = 2 * radius + 1;
    let stride = thresholds.len();
    for x in (0..stride).step_by(16) {
        // SAFETY: x + 16 <= stride, the length of `thresholds`.
        let threshold = unsafe { _mm256_loadu_si256(thresholds.as_ptr().add(x).cast()) };
        let mut word = _mm256_setzero_si256();
        let mut k = 0;
        for window in rows.chunks_exact(side) {
            for i in 0..side {
                let column = RADIUS_LIMIT - radius + i + x;
                for row in window {
                    // SAFETY: column + 16 <= 2 RADIUS_LIMIT + stride, at most the row's length.
                    let sample = unsafe { _mm256_loadu_si256(row.as_ptr().add(column).cast()) };
                    let above = _mm256_cmpgt_epi16(sample, threshold);
                    let bit = _mm256_set1_epi16(1i16 << (k % 16));
                    word = _mm256_or_si256(word, _mm256_and_si256(above, bit));
                    k += 1;
                    if k % 16 == 0 {
                        let at = (k / 16 - 1) * stride + x;
                        // SAFETY: plane k / 16 - 1 is complete inside `planes`.
                        unsafe { _mm256_storeu_si256(planes.as_mut_ptr().add(at).cast(), word) };
                        word = _mm256_setzero_si256();
                    }
                }
            }
        }
        if k % 16 != 0 {
            let at = k / 16 * stride + x;
            // SAFETY: `planes` has a last plane for the bits left over.
            unsafe { _mm256_storeu_si256(planes.as_mut_ptr().add(at).cast(), word) };
        }
    }
}
