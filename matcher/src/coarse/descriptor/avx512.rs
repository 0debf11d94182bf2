//! AVX-512: 64 pixels at a time, eight outcomes a byte. Descriptors are written past the cache, which
//! would read each line first and loses them before they are needed.

use std::arch::x86_64::*;

use super::{Rows, codes::BLOCK};

/// # Safety
/// The processor has the features; `out` begins at a cache line and is whole blocks long, and every row
/// is at least as long.
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) unsafe fn blocks(rows: &Rows<'_>, out: &mut [u64]) {
    let bits: [__m512i; 8] = std::array::from_fn(|j| _mm512_set1_epi8((1_u8 << j) as i8));
    for at in (0..out.len()).step_by(BLOCK) {
        // SAFETY: the caller's promise, here and below.
        let load = |row: &[i8]| unsafe { _mm512_loadu_si512(row.as_ptr().add(at).cast()) };
        let mean = load(rows.than[0]);
        let mut bytes = [_mm512_setzero_si512(); 8];
        for (i, byte) in bytes.iter_mut().enumerate() {
            for (j, bit) in bits.iter().enumerate() {
                let k = 8 * i + j;
                let than = if k < rows.means { mean } else { load(rows.than[k]) };
                let above = _mm512_cmpgt_epi8_mask(load(rows.codes[k]), than);
                *byte = _mm512_mask_add_epi8(*byte, above, *byte, *bit);
            }
        }
        let [a, b, c, d, e, f, g, h] = bytes;
        // Two pixels of each quarter a register, from pairs of bytes to pairs of pairs and so on.
        let low = |a, b, c, d| {
            let (ab, cd) = (_mm512_unpacklo_epi8(a, b), _mm512_unpacklo_epi8(c, d));
            (_mm512_unpacklo_epi16(ab, cd), _mm512_unpackhi_epi16(ab, cd))
        };
        let high = |a, b, c, d| {
            let (ab, cd) = (_mm512_unpackhi_epi8(a, b), _mm512_unpackhi_epi8(c, d));
            (_mm512_unpacklo_epi16(ab, cd), _mm512_unpackhi_epi16(ab, cd))
        };
        let (p, q) = (low(a, b, c, d), low(e, f, g, h));
        let (r, s) = (high(a, b, c, d), high(e, f, g, h));
        for (half, [(a, b), (c, d)]) in
            [[(p.0, q.0), (p.1, q.1)], [(r.0, s.0), (r.1, s.1)]].into_iter().enumerate()
        {
            let (first, second) = (_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b));
            let (third, fourth) = (_mm512_unpacklo_epi32(c, d), _mm512_unpackhi_epi32(c, d));
            // Four quarters of a kind side by side.
            let low = (
                _mm512_shuffle_i32x4::<0x44>(first, second),
                _mm512_shuffle_i32x4::<0x44>(third, fourth),
            );
            let high = (
                _mm512_shuffle_i32x4::<0xEE>(first, second),
                _mm512_shuffle_i32x4::<0xEE>(third, fourth),
            );
            let eights = [
                _mm512_shuffle_i32x4::<0x88>(low.0, low.1),
                _mm512_shuffle_i32x4::<0xDD>(low.0, low.1),
                _mm512_shuffle_i32x4::<0x88>(high.0, high.1),
                _mm512_shuffle_i32x4::<0xDD>(high.0, high.1),
            ];
            for (quarter, eight) in eights.into_iter().enumerate() {
                // SAFETY: as above.
                unsafe {
                    let to = out.as_mut_ptr().add(at + 16 * quarter + 8 * half);
                    _mm512_stream_si512(to.cast(), eight);
                }
            }
        }
    }
    // Writes that pass the cache are in no order until here.
    _mm_sfence();
}
