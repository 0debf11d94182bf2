//! AVX2: 4 pixels a register, bits counted by a table of nibbles.

use std::arch::x86_64::*;

use super::BLOCK;

/// # Safety
/// The processor has AVX2; arguments are as [`super::best_candidates`] checks.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn search(
    left: &[u64],
    right: &[u64],
    origin: usize,
    shifts: &[i32],
    best: &mut [u32],
) {
    let nibbles =
        _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4));
    let low = _mm256_set1_epi8(15);
    let zero = _mm256_setzero_si256();
    for block in 0..left.len() / BLOCK {
        for half in 0..2 {
            let at = block * BLOCK + half * 16;
            let mut l = [zero; 4];
            for (k, l) in l.iter_mut().enumerate() {
                // SAFETY: `at + 16` lies within `left`.
                *l = unsafe { _mm256_loadu_si256(left.as_ptr().add(at + 4 * k).cast()) };
            }
            let mut b = [_mm256_set1_epi64x(i64::from(u32::MAX)); 4];
            let from = origin + at;
            for &shift in shifts {
                // SAFETY: the candidate lies inside for the whole block.
                let r = unsafe { right.as_ptr().offset(from as isize - shift as isize) };
                let index = _mm256_set1_epi64x(i64::from(shift - shifts[0]));
                for k in 0..4 {
                    // SAFETY: as above.
                    let r = unsafe { _mm256_loadu_si256(r.add(4 * k).cast()) };
                    let x = _mm256_xor_si256(l[k], r);
                    let bytes = _mm256_add_epi8(
                        _mm256_shuffle_epi8(nibbles, _mm256_and_si256(x, low)),
                        _mm256_shuffle_epi8(
                            nibbles,
                            _mm256_and_si256(_mm256_srli_epi16::<4>(x), low),
                        ),
                    );
                    let bits = _mm256_sad_epu8(bytes, zero);
                    let key = _mm256_or_si256(_mm256_slli_epi64::<16>(bits), index);
                    b[k] = _mm256_min_epu32(b[k], key);
                }
            }
            for (k, b) in b.into_iter().enumerate() {
                let packed =
                    _mm256_permutevar8x32_epi32(b, _mm256_setr_epi32(0, 2, 4, 6, 0, 0, 0, 0));
                // SAFETY: `at + 16` lies within `best`.
                unsafe {
                    let to = best.as_mut_ptr().add(at + 4 * k).cast();
                    _mm_storeu_si128(to, _mm256_castsi256_si128(packed));
                }
            }
        }
    }
}

/// Distance << 32 | index of the row's nearest; all ones for none. One pixel at a time: the bit counter
/// is faster than tables of nibbles where nothing else is wanted.
///
/// # Safety
/// The processor has the feature.
#[target_feature(enable = "popcnt")]
pub(super) unsafe fn nearest(value: u64, row: &[u64]) -> u64 {
    super::scalar::nearest(value, row)
}
