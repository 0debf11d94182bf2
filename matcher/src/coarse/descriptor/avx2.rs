//! AVX2: 32 pixels at a time, eight outcomes a byte. Descriptors are written past the cache, as with
//! AVX-512.

use std::arch::x86_64::*;

use super::{Rows, codes::BLOCK};

/// # Safety
/// The processor has AVX2; `out` begins at a cache line and is whole blocks long, and every row is at
/// least as long.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn blocks(rows: &Rows<'_>, out: &mut [u64]) {
    for at in (0..out.len()).step_by(BLOCK / 2) {
        // SAFETY: the caller's promise, here and below.
        let load = |row: &[i8]| unsafe { _mm256_loadu_si256(row.as_ptr().add(at).cast()) };
        let mean = load(rows.than[0]);
        let mut bytes = [_mm256_setzero_si256(); 8];
        for (i, byte) in bytes.iter_mut().enumerate() {
            for k in (8 * i..8 * i + 8).rev() {
                let than = if k < rows.means { mean } else { load(rows.than[k]) };
                // A comparison that holds is -1.
                let above = _mm256_cmpgt_epi8(load(rows.codes[k]), than);
                *byte = _mm256_sub_epi8(_mm256_add_epi8(*byte, *byte), above);
            }
        }
        let [a, b, c, d, e, f, g, h] = bytes;
        // Two pixels of each half a register, from pairs of bytes to pairs of pairs and so on.
        let low = |a, b, c, d| {
            let (ab, cd) = (_mm256_unpacklo_epi8(a, b), _mm256_unpacklo_epi8(c, d));
            (_mm256_unpacklo_epi16(ab, cd), _mm256_unpackhi_epi16(ab, cd))
        };
        let high = |a, b, c, d| {
            let (ab, cd) = (_mm256_unpackhi_epi8(a, b), _mm256_unpackhi_epi8(c, d));
            (_mm256_unpacklo_epi16(ab, cd), _mm256_unpackhi_epi16(ab, cd))
        };
        let (p, q) = (low(a, b, c, d), low(e, f, g, h));
        let (r, s) = (high(a, b, c, d), high(e, f, g, h));
        let halves = [(p.0, q.0), (p.1, q.1), (r.0, s.0), (r.1, s.1)];
        for (k, (a, b)) in halves.into_iter().enumerate() {
            let (first, second) = (_mm256_unpacklo_epi32(a, b), _mm256_unpackhi_epi32(a, b));
            // SAFETY: as above.
            unsafe {
                let to = out.as_mut_ptr().add(at + 4 * k);
                let joined = _mm256_permute2x128_si256::<0x20>(first, second);
                _mm256_stream_si256(to.cast(), joined);
                let joined = _mm256_permute2x128_si256::<0x31>(first, second);
                _mm256_stream_si256(to.add(16).cast(), joined);
            }
        }
    }
    // Writes that pass the cache are in no order until here.
    _mm_sfence();
}
