//! AVX-512: 32 pixels a block.

use std::arch::x86_64::*;

use super::{BLOCK, SPREAD, place, scalar};
use crate::coarse::INVALID;

/// The columns from `x` on.
#[target_feature(enable = "avx512f,avx512bw")]
#[inline]
fn columns(x: usize) -> __m512i {
    let numbers: [u16; BLOCK] = std::array::from_fn(|i| i as u16);
    // SAFETY: 64 bytes.
    let numbers = unsafe { _mm512_loadu_si512(numbers.as_ptr().cast()) };
    _mm512_add_epi16(numbers, _mm512_set1_epi16(x as i16))
}

/// # Safety
/// The processor has the features; as many costs as disparities.
#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
pub(super) unsafe fn claim(disparity: &[i16], cost: &[u8], claims: &mut [u32]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: the caller's promise.
        let (d, c) = unsafe {
            (
                _mm512_loadu_si512(disparity.as_ptr().add(x).cast()),
                _mm256_loadu_si256(cost.as_ptr().add(x).cast()),
            )
        };
        let columns = columns(x);
        // Costs above columns.
        let own = [
            _mm512_or_si512(
                _mm512_slli_epi32::<16>(_mm512_cvtepu8_epi32(_mm256_castsi256_si128(c))),
                _mm512_cvtepu16_epi32(_mm512_castsi512_si256(columns)),
            ),
            _mm512_or_si512(
                _mm512_slli_epi32::<16>(_mm512_cvtepu8_epi32(_mm256_extracti128_si256::<1>(c))),
                _mm512_cvtepu16_epi32(_mm512_extracti64x4_epi64::<1>(columns)),
            ),
        ];
        let mut left = _mm512_cmpneq_epi16_mask(d, _mm512_set1_epi16(INVALID));
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize];
            let same = _mm512_cmpeq_epi16_mask(d, _mm512_set1_epi16(v));
            left &= !same;
            let to = &mut claims[place(x, v)..][..BLOCK];
            for (to, (same, own)) in
                to.chunks_exact_mut(16).zip([(same as u16, own[0]), ((same >> 16) as u16, own[1])])
            {
                // SAFETY: 16 claims.
                unsafe {
                    let claims = _mm512_loadu_si512(to.as_ptr().cast());
                    let claims = _mm512_mask_min_epu32(claims, same, claims, own);
                    _mm512_storeu_si512(to.as_mut_ptr().cast(), claims);
                }
            }
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize;
            left &= left - 1;
            scalar::claim(x + i, &disparity[x + i..][..1], &cost[x + i..][..1], claims);
        }
    }
    scalar::claim(whole, &disparity[whole..], &cost[whole..], claims);
}

/// # Safety
/// The processor has the features.
#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
pub(super) unsafe fn keep(claims: &[u32], most: u16, disparity: &mut [i16]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    let invalid = _mm512_set1_epi16(INVALID);
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: a block of the row.
        let d = unsafe { _mm512_loadu_si512(disparity.as_ptr().add(x).cast()) };
        let columns = columns(x);
        let mut lost = 0_u32;
        let mut left = _mm512_cmpneq_epi16_mask(d, invalid);
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize];
            let same = _mm512_cmpeq_epi16_mask(d, _mm512_set1_epi16(v));
            left &= !same;
            let from = &claims[place(x, v)..][..BLOCK];
            // SAFETY: 32 claims.
            let (low, high) = unsafe {
                (
                    _mm512_loadu_si512(from.as_ptr().cast()),
                    _mm512_loadu_si512(from.as_ptr().add(16).cast()),
                )
            };
            let owner = _mm512_inserti64x4::<1>(
                _mm512_castsi256_si512(_mm512_cvtepi32_epi16(low)),
                _mm512_cvtepi32_epi16(high),
            );
            let away = _mm512_or_si512(
                _mm512_subs_epu16(owner, columns),
                _mm512_subs_epu16(columns, owner),
            );
            lost |= _mm512_mask_cmpgt_epu16_mask(same, away, _mm512_set1_epi16(most as i16));
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize;
            left &= left - 1;
            lost |= u32::from(scalar::far(claims, most, x + i, disparity[x + i])) << i;
        }
        if lost != 0 {
            // SAFETY: a block of the row.
            unsafe {
                _mm512_mask_storeu_epi16(disparity.as_mut_ptr().add(x), lost, invalid);
            }
        }
    }
    scalar::keep(whole, claims, most, &mut disparity[whole..]);
}

/// # Safety
/// The processor has the features; as many costs as disparities.
#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
pub(super) unsafe fn take(disparity: &[i16], cost: &[u8], most: u8, taken: &mut [u8]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: the caller's promise.
        let (d, c) = unsafe {
            (
                _mm512_loadu_si512(disparity.as_ptr().add(x).cast()),
                _mm256_loadu_si256(cost.as_ptr().add(x).cast()),
            )
        };
        let valid = _mm512_cmpneq_epi16_mask(d, _mm512_set1_epi16(INVALID));
        let mut left = _mm256_mask_cmple_epu8_mask(valid, c, _mm256_set1_epi8(most as i8));
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize];
            let same = _mm512_mask_cmpeq_epi16_mask(left, d, _mm512_set1_epi16(v));
            left &= !same;
            let to = &mut taken[place(x, v)..][..BLOCK];
            // SAFETY: 32 flags.
            unsafe {
                _mm256_mask_storeu_epi8(to.as_mut_ptr().cast(), same, _mm256_set1_epi8(1));
            }
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize;
            left &= left - 1;
            taken[place(x + i, disparity[x + i])] = 1;
        }
    }
    scalar::take(whole, &disparity[whole..], &cost[whole..], most, taken);
}
