//! AVX2: 8 pixels a register.

use std::arch::x86_64::*;

use super::Weighted;

/// # Safety
/// The processor has AVX2; slices are as long as [`super::weigh`] checks.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn weigh(
    gradient: &[i32],
    grey: &[i32],
    times: &[i32; 8],
    out: &mut Weighted<'_>,
) {
    let len = out.ilt.len();
    let ones = _mm256_set1_epi16(1);
    for x in (0..len).step_by(8) {
        let mut sums = [_mm256_setzero_si256(); 4];
        for (pair, time) in (0..gradient.len() / len).zip(times) {
            let at = pair * len + x;
            // SAFETY: `at + 8` lies within all words.
            let (g, l) = unsafe {
                (
                    _mm256_loadu_si256(gradient.as_ptr().add(at).cast()),
                    _mm256_loadu_si256(grey.as_ptr().add(at).cast()),
                )
            };
            let weighted = _mm256_mulhrs_epi16(g, _mm256_set1_epi32(*time));
            // SAFETY: as above.
            unsafe { _mm256_storeu_si256(out.gradient.as_mut_ptr().add(at).cast(), weighted) };
            for (sum, with) in sums.iter_mut().zip([l, ones, g, weighted]) {
                *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(weighted, with));
            }
        }
        let maps = [&mut *out.ilt, &mut *out.it, &mut *out.st, &mut *out.stt];
        for (map, sum) in maps.into_iter().zip(sums) {
            // SAFETY: `x + 8` lies within every sum.
            unsafe { _mm256_storeu_ps(map.as_mut_ptr().add(x), _mm256_cvtepi32_ps(sum)) };
        }
    }
}
