//! AVX-512 with VPOPCNTDQ: 8 pixels a register, 32 a block.

use std::arch::x86_64::*;

use super::BLOCK;

/// # Safety
/// The processor has the features; arguments are as [`super::best_candidates`] checks.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512vpopcntdq")]
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
        for (c, &shift) in shifts.iter().enumerate() {
            // SAFETY: the candidate lies inside for the whole block.
            let r = unsafe { right.as_ptr().offset(from as isize - shift as isize) };
            let index = _mm512_set1_epi64(c as i64);
            for k in 0..4 {
                // SAFETY: as above.
                let r = unsafe { _mm512_loadu_si512(r.add(8 * k).cast()) };
                let bits = _mm512_popcnt_epi64(_mm512_xor_si512(l[k], r));
                let key = _mm512_or_si512(_mm512_slli_epi64::<16>(bits), index);
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
