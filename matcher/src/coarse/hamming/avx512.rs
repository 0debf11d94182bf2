//! AVX-512 with VPOPCNTDQ: 8 pixels a register, 32 a block.

use std::arch::x86_64::*;

use super::BLOCK;

/// # Safety
/// The processor has the features; arguments are as [`super::best_candidates`] checks.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512vpopcntdq,avx512vbmi2")]
pub(super) unsafe fn search(
    left: &[u64],
    right: &[u64],
    origin: usize,
    shifts: &[i32],
    best: &mut [u32],
) {
    for block in 0..left.len() / BLOCK {
        let at = block * BLOCK;
        let mut l = [_mm512_setzero_si512(); 4];
        for (k, l) in l.iter_mut().enumerate() {
            // SAFETY: `at + 32` lies within `left`.
            *l = unsafe { _mm512_loadu_si512(left.as_ptr().add(at + 8 * k).cast()) };
        }
        let mut b = [_mm512_set1_epi64(i64::from(u32::MAX)); 4];
        let from = origin + at;
        for &shift in shifts {
            // SAFETY: the candidate lies inside for the whole block.
            let r = unsafe { right.as_ptr().offset(from as isize - shift as isize) };
            // In the upper 16 bits, from where a double shift brings it below the distance.
            let index = _mm512_set1_epi64(i64::from(shift - shifts[0]) << 48);
            for k in 0..4 {
                // SAFETY: as above.
                let r = unsafe { _mm512_loadu_si512(r.add(8 * k).cast()) };
                let bits = _mm512_popcnt_epi64(_mm512_xor_si512(l[k], r));
                let key = _mm512_shldi_epi64::<16>(bits, index);
                // Keys fit 32 bits, whose minimum is cheaper.
                b[k] = _mm512_min_epu32(b[k], key);
            }
        }
        for (k, b) in b.into_iter().enumerate() {
            // SAFETY: `at + 32` lies within `best`.
            unsafe {
                let to = best.as_mut_ptr().add(at + 8 * k).cast();
                _mm256_storeu_si256(to, _mm512_cvtepi64_epi32(b));
            }
        }
    }
}

/// Distance << 32 | index of the row's nearest; all ones for none.
///
/// # Safety
/// The processor has the features.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512vpopcntdq")]
pub(super) unsafe fn nearest(value: u64, row: &[u64]) -> u64 {
    let value = _mm512_set1_epi64(value as i64);
    let mut best = _mm512_set1_epi64(-1);
    let mut index = _mm512_setr_epi64(0, 1, 2, 3, 4, 5, 6, 7);
    for at in (0..row.len()).step_by(8) {
        let here = (row.len() - at).min(8);
        let inside = 0xFF_u8 >> (8 - here);
        // SAFETY: only values inside the row are read.
        let other = unsafe { _mm512_maskz_loadu_epi64(inside, row.as_ptr().add(at).cast()) };
        let bits = _mm512_popcnt_epi64(_mm512_xor_si512(value, other));
        let key = _mm512_or_si512(_mm512_slli_epi64::<32>(bits), index);
        best = _mm512_mask_min_epu64(best, inside, best, key);
        index = _mm512_add_epi64(index, _mm512_set1_epi64(8));
    }
    _mm512_reduce_min_epu64(best)
}
