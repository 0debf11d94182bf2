//! AVX-512 with VBMI and GFNI: 32 pixels a block. Each test gives a word of 32 bits, one a pixel; the
//! 64 words of a block are then transposed to 32 words of 64 bits.

use std::arch::x86_64::*;

use super::{BLOCK, Rows};

/// The outcomes of 64 tests for 32 pixels.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Outcomes([__mmask32; 64]);

/// # Safety
/// The processor has the features; there are 64 rows; `at + 32` lies within every row and `out`, and
/// `at + 32 - begin` within `mean`.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512vbmi,gfni")]
pub(super) unsafe fn blocks(
    rows: &Rows<'_>,
    mean: &[i16],
    begin: usize,
    at: impl Iterator<Item = usize>,
    out: &mut [u64],
) {
    const { assert!(BLOCK == 32) };
    // A block's bits are transposed while the next one is tested: words that were just written one
    // by one cannot be read as a vector at once.
    let mut outcomes = [Outcomes([0; 64]); 2];
    let mut before = None;
    for (turn, from) in at.enumerate() {
        // SAFETY: the caller's promise, here and below.
        unsafe { test(rows, mean.as_ptr().add(from - begin), from, &mut outcomes[turn % 2]) };
        if let Some((turn, from)) = before.replace((turn, from)) {
            let turn: usize = turn;
            // SAFETY: as above.
            unsafe { transpose(&outcomes[turn % 2], out.as_mut_ptr().add(from)) };
        }
    }
    if let Some((turn, from)) = before {
        // SAFETY: as above.
        unsafe { transpose(&outcomes[turn % 2], out.as_mut_ptr().add(from)) };
    }
}

/// # Safety
/// The processor has the features; `from + 32` lies within every row, and 32 means are readable.
#[target_feature(enable = "avx512f,avx512bw")]
#[inline]
unsafe fn test(rows: &Rows<'_>, mean: *const i16, from: usize, outcomes: &mut Outcomes) {
    // SAFETY: the caller's promise, here and below.
    let mean = unsafe { _mm512_loadu_si512(mean.cast()) };
    for ((row, other), outcome) in rows.iter().zip(&mut outcomes.0) {
        // SAFETY: as above.
        let value = unsafe { _mm512_loadu_si512(row.as_ptr().add(from).cast()) };
        *outcome = match other {
            None => _mm512_cmpgt_epi16_mask(value, mean),
            Some(other) => {
                // SAFETY: as above.
                let than = unsafe { _mm512_loadu_si512(other.as_ptr().add(from).cast()) };
                _mm512_cmpgt_epi16_mask(value, than)
            }
        };
    }
}

/// Byte b of 16 words side by side, b by b; in each eight, the last word first.
const COLUMNS: [u8; 64] = {
    let mut index = [0; 64];
    let mut i = 0;
    while i < 64 {
        index[i] = (4 * ((i % 16) ^ 7) + i / 16) as u8;
        i += 1;
    }
    index
};

/// Eight words of eight bytes, transposed.
const WORDS: [u8; 64] = {
    let mut index = [0; 64];
    let mut i = 0;
    while i < 64 {
        index[i] = (8 * (i % 8) + i / 8) as u8;
        i += 1;
    }
    index
};

/// Writes the descriptors of 32 pixels.
///
/// # Safety
/// The processor has the features; 32 words are writable at `out`.
#[target_feature(enable = "avx512f,avx512bw,avx512vbmi,gfni")]
#[inline]
unsafe fn transpose(outcomes: &Outcomes, out: *mut u64) {
    // SAFETY: arrays of 64 bytes.
    let (columns, words) = unsafe {
        (_mm512_loadu_si512(COLUMNS.as_ptr().cast()), _mm512_loadu_si512(WORDS.as_ptr().cast()))
    };
    let mut p = [_mm512_setzero_si512(); 4];
    for (i, p) in p.iter_mut().enumerate() {
        // SAFETY: 16 of the 64 words.
        let sixteen = unsafe { _mm512_load_si512(outcomes.0.as_ptr().add(16 * i).cast()) };
        *p = _mm512_permutexvar_epi8(columns, sixteen);
    }
    // Lane b of each to the register of pixels 8 b to 8 b + 7.
    let (low, high) = (
        [_mm512_shuffle_i32x4::<0x44>(p[0], p[1]), _mm512_shuffle_i32x4::<0x44>(p[2], p[3])],
        [_mm512_shuffle_i32x4::<0xEE>(p[0], p[1]), _mm512_shuffle_i32x4::<0xEE>(p[2], p[3])],
    );
    let eights = [
        _mm512_shuffle_i32x4::<0x88>(low[0], low[1]),
        _mm512_shuffle_i32x4::<0xDD>(low[0], low[1]),
        _mm512_shuffle_i32x4::<0x88>(high[0], high[1]),
        _mm512_shuffle_i32x4::<0xDD>(high[0], high[1]),
    ];
    let identity = _mm512_set1_epi64(0x8040_2010_0804_0201_u64 as i64);
    for (b, eight) in eights.into_iter().enumerate() {
        // Product with the identity, by columns: the transposed 8 x 8 bits.
        let bits = _mm512_gf2p8affine_epi64_epi8::<0>(identity, eight);
        let descriptors = _mm512_permutexvar_epi8(words, bits);
        // SAFETY: the caller's promise.
        unsafe { _mm512_storeu_si512(out.add(8 * b).cast(), descriptors) };
    }
}
