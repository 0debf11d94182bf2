//! AVX-512 with VNNI: 16 pixels a register.

use std::arch::x86_64::*;

use super::Weighted;

/// # Safety
/// The processor has the features; slices are as long as [`super::weigh`] checks.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512vnni")]
pub(super) unsafe fn weigh(
    gradient: &[i32],
    grey: &[i32],
    times: &[i32; 8],
    out: &mut Weighted<'_>,
) {
    let len = out.ilt.len();
    let ones = _mm512_set1_epi16(1);
    for x in (0..len).step_by(16) {
        let mut sums = [_mm512_setzero_si512(); 4];
        for (pair, time) in (0..gradient.len() / len).zip(times) {
            let at = pair * len + x;
            // SAFETY: `at + 16` lies within all words.
            let (g, l) = unsafe {
                (
                    _mm512_loadu_si512(gradient.as_ptr().add(at).cast()),
                    _mm512_loadu_si512(grey.as_ptr().add(at).cast()),
                )
            };
            let weighted = _mm512_mulhrs_epi16(g, _mm512_set1_epi32(*time));
            // SAFETY: as above.
            unsafe { _mm512_storeu_si512(out.gradient.as_mut_ptr().add(at).cast(), weighted) };
            for (sum, with) in sums.iter_mut().zip([l, ones, g, weighted]) {
                *sum = _mm512_dpwssd_epi32(*sum, weighted, with);
            }
        }
        let maps = [&mut *out.ilt, &mut *out.it, &mut *out.st, &mut *out.stt];
        for (map, sum) in maps.into_iter().zip(sums) {
            // SAFETY: `x + 16` lies within every sum.
            unsafe { _mm512_storeu_ps(map.as_mut_ptr().add(x), _mm512_cvtepi32_ps(sum)) };
        }
    }
}
