//! The search kernels with AVX-512: 32 columns at a time, bits counted by VPOPCNTW.

use std::arch::x86_64::*;

/// The slices are as long as [`super::CostKernel::costs`] asserts.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bitalg")]
pub(super) fn costs(
    words: &[u16],
    planes: &[u16],
    invalid: &[u16],
    first: usize,
    costs: &mut [u16],
) {
    // Four blocks share the broadcast of a word.
    let mut at = 0;
    while at + 128 <= costs.len() {
        // SAFETY: 128 columns from `at` on are inside `costs`.
        unsafe { blocks::<4>(words, planes, invalid, first + at, costs.as_mut_ptr().add(at)) };
        at += 128;
    }
    while at + 32 <= costs.len() {
        // SAFETY: 32 columns from `at` on are inside `costs`.
        unsafe { blocks::<1>(words, planes, invalid, first + at, costs.as_mut_ptr().add(at)) };
        at += 32;
    }
}

/// # Safety
/// `column` + 32 N is at most the length of `invalid`, `planes` holds as many planes of that length
/// as there are words, and `costs` points to 32 N values.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512bitalg")]
unsafe fn blocks<const N: usize>(
    words: &[u16],
    planes: &[u16],
    invalid: &[u16],
    column: usize,
    costs: *mut u16,
) {
    let mut sums = [_mm512_setzero_si512(); N];
    for (w, &word) in words.iter().enumerate() {
        let word = _mm512_set1_epi16(word as i16);
        for (b, sum) in sums.iter_mut().enumerate() {
            let at = w * invalid.len() + column + 32 * b;
            // SAFETY: inside plane w, as the caller promises.
            let other = unsafe { _mm512_loadu_si512(planes.as_ptr().add(at).cast()) };
            let bits = _mm512_popcnt_epi16(_mm512_xor_si512(word, other));
            *sum = _mm512_add_epi16(*sum, bits);
        }
    }
    for (b, sum) in sums.into_iter().enumerate() {
        // SAFETY: 32 values of `invalid` from the column on, 32 N values at `costs`.
        unsafe {
            let invalid = _mm512_loadu_si512(invalid.as_ptr().add(column + 32 * b).cast());
            _mm512_storeu_si512(costs.add(32 * b).cast(), _mm512_or_si512(sum, invalid));
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
pub(super) fn smallest(costs: &[u16]) -> u16 {
    super::scalar::smallest(costs)
}

#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
pub(super) fn keep_best(costs: &[u16], x: u16, best_cost: &mut [u16], best_x: &mut [u16]) {
    super::scalar::keep_best(costs, x, best_cost, best_x);
}

#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
pub(super) fn find(costs: &[u16], cost: u16) -> Option<usize> {
    super::scalar::find(costs, cost)
}
