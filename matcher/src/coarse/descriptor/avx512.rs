//! AVX-512: 32 pixels a block, 16 bits a register.

use std::arch::x86_64::*;

use super::{BLOCK, Rows};

/// # Safety
/// The processor has the features; there are 64 rows; `at + 32` lies within every row and `out`.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq")]
pub(super) unsafe fn blocks(
    rows: &Rows<'_>,
    mean: &[i16],
    at: impl Iterator<Item = usize>,
    out: &mut [u64],
) {
    let one = _mm512_set1_epi16(1);
    for from in at {
        // SAFETY: the caller's promise, here and below.
        let load = |row: &[i16]| unsafe { _mm512_loadu_si512(row.as_ptr().add(from).cast()) };
        let mean = load(mean);
        let mut words = [_mm512_setzero_si512(); 4];
        for (word, rows) in words.iter_mut().zip(rows.chunks_exact(16)) {
            for (row, other) in rows.iter().rev() {
                let than = match other {
                    Some(other) => load(other),
                    None => mean,
                };
                let above = _mm512_cmpgt_epi16_mask(load(row), than);
                *word = _mm512_add_epi16(*word, *word);
                *word = _mm512_mask_add_epi16(*word, above, *word, one);
            }
        }
        let [a, b, c, d] = words;
        let (ab, cd) = (_mm512_unpacklo_epi16(a, b), _mm512_unpacklo_epi16(c, d));
        let (ab_hi, cd_hi) = (_mm512_unpackhi_epi16(a, b), _mm512_unpackhi_epi16(c, d));
        let pairs = [
            _mm512_unpacklo_epi32(ab, cd),
            _mm512_unpackhi_epi32(ab, cd),
            _mm512_unpacklo_epi32(ab_hi, cd_hi),
            _mm512_unpackhi_epi32(ab_hi, cd_hi),
        ];
        const { assert!(BLOCK == 32) };
        for (k, pair) in pairs.into_iter().enumerate() {
            // Each 128-bit part holds two neighbouring pixels of another eight.
            // SAFETY: as above.
            unsafe {
                let to = out.as_mut_ptr().add(from + 2 * k);
                _mm_storeu_si128(to.cast(), _mm512_castsi512_si128(pair));
                _mm_storeu_si128(to.add(8).cast(), _mm512_extracti32x4_epi32::<1>(pair));
                _mm_storeu_si128(to.add(16).cast(), _mm512_extracti32x4_epi32::<2>(pair));
                _mm_storeu_si128(to.add(24).cast(), _mm512_extracti32x4_epi32::<3>(pair));
            }
        }
    }
}
