//! The search kernels with AVX2: 16 columns at a time, bits counted by byte shuffles.

use std::arch::x86_64::*;

/// The slices are as long as [`super::CostKernel::costs`] asserts.
#[target_feature(enable = "avx2")]
pub(super) fn costs(
    words: &[u16],
    planes: &[u16],
    invalid: &[u16],
    first: usize,
    costs: &mut [u16],
) {
    let nibble = _mm256_set1_epi8(0x0f);
    let counts = _mm256_setr_epi8(
        0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3,
        3, 4,
    );
    for at in (0..costs.len()).step_by(16) {
        let mut sum = _mm256_setzero_si256();
        // A byte counts at most 8 bits a word: 31 words fit before it has to be widened.
        for (chunk, words) in words.chunks(31).enumerate() {
            let mut bytes = _mm256_setzero_si256();
            for (w, &word) in words.iter().enumerate() {
                let plane = (chunk * 31 + w) * invalid.len();
                // SAFETY: first + at + 16 is at most the plane's length.
                let other =
                    unsafe { _mm256_loadu_si256(planes.as_ptr().add(plane + first + at).cast()) };
                let differing = _mm256_xor_si256(_mm256_set1_epi16(word as i16), other);
                let low = _mm256_shuffle_epi8(counts, _mm256_and_si256(differing, nibble));
                let high = _mm256_and_si256(_mm256_srli_epi16(differing, 4), nibble);
                bytes = _mm256_add_epi8(bytes, low);
                bytes = _mm256_add_epi8(bytes, _mm256_shuffle_epi8(counts, high));
            }
            let pairs = _mm256_maddubs_epi16(bytes, _mm256_set1_epi8(1));
            sum = _mm256_add_epi16(sum, pairs);
        }
        // SAFETY: 16 values from there on, in both slices.
        unsafe {
            let invalid = _mm256_loadu_si256(invalid.as_ptr().add(first + at).cast());
            let cost = _mm256_or_si256(sum, invalid);
            _mm256_storeu_si256(costs.as_mut_ptr().add(at).cast(), cost);
        }
    }
}

#[target_feature(enable = "avx2")]
pub(super) fn smallest(costs: &[u16]) -> u16 {
    super::scalar::smallest(costs)
}

#[target_feature(enable = "avx2")]
pub(super) fn keep_best(costs: &[u16], x: u16, best_cost: &mut [u16], best_x: &mut [u16]) {
    super::scalar::keep_best(costs, x, best_cost, best_x);
}

#[target_feature(enable = "avx2")]
pub(super) fn find(costs: &[u16], cost: u16) -> Option<usize> {
    super::scalar::find(costs, cost)
}
