//! AVX-512 with VNNI: 16 pixels a block. A window of 32 samples holds the taps of all pixels where
//! the disparity varies by at most 8 px over them; further windows serve the others.

use std::arch::x86_64::*;

use super::{Kernels, Sample};

/// Does whole blocks, and returns the number of pixels done.
///
/// # Safety
/// The processor has the features; `place` lies within the row with all eight taps; the row holds at
/// least 32 samples; `grey` is at least as long as `place`.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512vnni")]
pub(super) unsafe fn blocks(
    kernels: &Kernels,
    row: &[Sample],
    place: &[i32],
    grey: &mut [i16],
) -> usize {
    let width = row.len() as i32;
    // Per pair of taps, a register of the 16 phases' coefficient pairs.
    let mut tables = [_mm512_setzero_si512(); 4];
    for (j, to) in tables.iter_mut().enumerate() {
        let mut table = [0i32; 16];
        for (t, taps) in table.iter_mut().zip(&kernels.taps) {
            *t = i32::from(taps[2 * j] as u16) | i32::from(taps[2 * j + 1]) << 16;
        }
        // SAFETY: an array of 64 bytes.
        *to = unsafe { _mm512_loadu_si512(table.as_ptr().cast()) };
    }
    let half = _mm512_set1_epi32(0x8000);
    let blocks = place.len() / 16;
    for i in (0..blocks * 16).step_by(16) {
        // SAFETY: `i + 16` lies within the places.
        let at = unsafe { _mm512_loadu_si512(place.as_ptr().add(i).cast()) };
        let first = _mm512_sub_epi32(_mm512_srai_epi32::<4>(at), _mm512_set1_epi32(3));
        let phase = _mm512_and_si512(at, _mm512_set1_epi32(15));
        let mut taps = [_mm512_setzero_si512(); 4];
        for (to, table) in taps.iter_mut().zip(tables) {
            *to = _mm512_permutexvar_epi32(phase, table);
        }
        let mut g = _mm512_setzero_si512();
        let mut left: __mmask16 = 0xFFFF;
        while left != 0 {
            let base = _mm512_mask_reduce_min_epi32(left, first).min(width - 32);
            let offset = _mm512_sub_epi32(first, _mm512_set1_epi32(base));
            let now = _mm512_mask_cmple_epi32_mask(left, offset, _mm512_set1_epi32(24));
            left &= !now;
            // Both halves of a word hold the offset; then pairs of neighbouring samples.
            let both = _mm512_or_si512(offset, _mm512_slli_epi32::<16>(offset));
            // SAFETY: 0 <= base <= width - 32.
            let window = unsafe { _mm512_loadu_si512(row.as_ptr().add(base as usize).cast()) };
            let mut sum = half;
            for (j, taps) in (0i32..).zip(taps) {
                let pair = _mm512_set1_epi32((2 * j) | ((2 * j + 1) << 16));
                let samples = _mm512_permutexvar_epi16(_mm512_add_epi16(both, pair), window);
                sum = _mm512_dpwssd_epi32(sum, samples, taps);
            }
            g = _mm512_mask_srai_epi32::<16>(g, now, sum);
        }
        // SAFETY: `i + 16` lies within the row of results.
        unsafe {
            _mm256_storeu_si256(grey.as_mut_ptr().add(i).cast(), _mm512_cvtepi32_epi16(g));
        }
    }
    blocks * 16
}
