//! AVX2: 16 pixels at a time, 16 bits a register.

use std::arch::x86_64::*;

use super::{BLOCK, Rows};

/// # Safety
/// The processor has AVX2; there are 64 rows; `at + 32` lies within every row and `out`, and
/// `at + 32 - begin` within `mean`.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn blocks(
    rows: &Rows<'_>,
    mean: &[i16],
    begin: usize,
    at: impl Iterator<Item = usize>,
    out: &mut [u64],
) {
    for from in at.flat_map(|at| [at, at + BLOCK / 2]) {
        // SAFETY: the caller's promise, here and below.
        let load = |row: &[i16]| unsafe { _mm256_loadu_si256(row.as_ptr().add(from).cast()) };
        // SAFETY: as above; the means begin at column `begin`.
        let mean = unsafe { _mm256_loadu_si256(mean.as_ptr().add(from - begin).cast()) };
        let mut words = [_mm256_setzero_si256(); 4];
        for (word, rows) in words.iter_mut().zip(rows.chunks_exact(16)) {
            for (row, other) in rows.iter().rev() {
                let than = match other {
                    Some(other) => load(other),
                    None => mean,
                };
                // A comparison that holds is -1.
                let above = _mm256_cmpgt_epi16(load(row), than);
                *word = _mm256_sub_epi16(_mm256_add_epi16(*word, *word), above);
            }
        }
        let [a, b, c, d] = words;
        let (ab, cd) = (_mm256_unpacklo_epi16(a, b), _mm256_unpacklo_epi16(c, d));
        let (ab_hi, cd_hi) = (_mm256_unpackhi_epi16(a, b), _mm256_unpackhi_epi16(c, d));
        let pairs = [
            _mm256_unpacklo_epi32(ab, cd),
            _mm256_unpackhi_epi32(ab, cd),
            _mm256_unpacklo_epi32(ab_hi, cd_hi),
            _mm256_unpackhi_epi32(ab_hi, cd_hi),
        ];
        for (k, pair) in pairs.into_iter().enumerate() {
            // SAFETY: as above.
            unsafe {
                let to = out.as_mut_ptr().add(from + 2 * k);
                _mm_storeu_si128(to.cast(), _mm256_castsi256_si128(pair));
                _mm_storeu_si128(to.add(8).cast(), _mm256_extracti128_si256::<1>(pair));
            }
        }
    }
}
