//! AVX2: 16 pixels a block.

use std::arch::x86_64::*;

use super::{SPREAD, place, scalar};
use crate::coarse::INVALID;

const BLOCK: usize = 16;

/// The columns from `x` on.
#[target_feature(enable = "avx2")]
#[inline]
fn columns(x: usize) -> __m256i {
    let numbers: [u16; BLOCK] = std::array::from_fn(|i| i as u16);
    // SAFETY: 32 bytes.
    let numbers = unsafe { _mm256_loadu_si256(numbers.as_ptr().cast()) };
    _mm256_add_epi16(numbers, _mm256_set1_epi16(x as i16))
}

/// Two bits a pixel.
#[target_feature(enable = "avx2")]
#[inline]
fn bits(mask: __m256i) -> u32 {
    _mm256_movemask_epi8(mask) as u32
}

/// # Safety
/// The processor has AVX2; as many costs as disparities.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn claim(disparity: &[i16], cost: &[u8], claims: &mut [u32]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: the caller's promise.
        let (d, c) = unsafe {
            (
                _mm256_loadu_si256(disparity.as_ptr().add(x).cast()),
                _mm_loadu_si128(cost.as_ptr().add(x).cast()),
            )
        };
        let (columns, c) = (columns(x), _mm256_cvtepu8_epi16(c));
        let half = |columns, c| {
            let c = _mm256_slli_epi32::<16>(_mm256_cvtepu16_epi32(c));
            _mm256_or_si256(c, _mm256_cvtepu16_epi32(columns))
        };
        // Costs above columns.
        let own = [
            half(_mm256_castsi256_si128(columns), _mm256_castsi256_si128(c)),
            half(_mm256_extracti128_si256::<1>(columns), _mm256_extracti128_si256::<1>(c)),
        ];
        let mut left = !bits(_mm256_cmpeq_epi16(d, _mm256_set1_epi16(INVALID)));
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize / 2];
            let same = _mm256_cmpeq_epi16(d, _mm256_set1_epi16(v));
            left &= !bits(same);
            let same = [_mm256_castsi256_si128(same), _mm256_extracti128_si256::<1>(same)];
            let to = &mut claims[place(x, v)..][..BLOCK];
            for (to, (same, own)) in to.chunks_exact_mut(8).zip(same.into_iter().zip(own)) {
                // The others' are the largest number.
                let ones = _mm256_set1_epi32(-1);
                let own = _mm256_or_si256(own, _mm256_xor_si256(_mm256_cvtepi16_epi32(same), ones));
                // SAFETY: 8 claims.
                unsafe {
                    let claims = _mm256_loadu_si256(to.as_ptr().cast());
                    _mm256_storeu_si256(to.as_mut_ptr().cast(), _mm256_min_epu32(claims, own));
                }
            }
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize / 2;
            left &= !(3 << (2 * i));
            scalar::claim(x + i, &disparity[x + i..][..1], &cost[x + i..][..1], claims);
        }
    }
    scalar::claim(whole, &disparity[whole..], &cost[whole..], claims);
}

/// # Safety
/// The processor has AVX2.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn keep(claims: &[u32], most: u16, disparity: &mut [i16]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    let (invalid, zero) = (_mm256_set1_epi16(INVALID), _mm256_setzero_si256());
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: a block of the row.
        let d = unsafe { _mm256_loadu_si256(disparity.as_ptr().add(x).cast()) };
        let columns = columns(x);
        let mut lost = zero;
        let mut left = !bits(_mm256_cmpeq_epi16(d, invalid));
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize / 2];
            let same = _mm256_cmpeq_epi16(d, _mm256_set1_epi16(v));
            left &= !bits(same);
            let from = &claims[place(x, v)..][..BLOCK];
            // SAFETY: 16 claims.
            let (low, high) = unsafe {
                (
                    _mm256_loadu_si256(from.as_ptr().cast()),
                    _mm256_loadu_si256(from.as_ptr().add(8).cast()),
                )
            };
            let column = _mm256_set1_epi32(0xFFFF);
            let owner = _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packus_epi32(
                _mm256_and_si256(low, column),
                _mm256_and_si256(high, column),
            ));
            let away = _mm256_or_si256(
                _mm256_subs_epu16(owner, columns),
                _mm256_subs_epu16(columns, owner),
            );
            let beyond = _mm256_subs_epu16(away, _mm256_set1_epi16(most as i16));
            let near = _mm256_cmpeq_epi16(beyond, zero);
            lost = _mm256_or_si256(lost, _mm256_andnot_si256(near, same));
        }
        // SAFETY: a block of the row.
        unsafe {
            let to = disparity.as_mut_ptr().add(x).cast();
            _mm256_storeu_si256(to, _mm256_blendv_epi8(d, invalid, lost));
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize / 2;
            left &= !(3 << (2 * i));
            scalar::keep(x + i, claims, most, &mut disparity[x + i..][..1]);
        }
    }
    scalar::keep(whole, claims, most, &mut disparity[whole..]);
}

/// # Safety
/// The processor has AVX2; as many costs as disparities.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn take(disparity: &[i16], cost: &[u8], most: u8, taken: &mut [u8]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: the caller's promise.
        let (d, c) = unsafe {
            (
                _mm256_loadu_si256(disparity.as_ptr().add(x).cast()),
                _mm_loadu_si128(cost.as_ptr().add(x).cast()),
            )
        };
        let bad = _mm256_or_si256(
            _mm256_cmpgt_epi16(_mm256_cvtepu8_epi16(c), _mm256_set1_epi16(i16::from(most))),
            _mm256_cmpeq_epi16(d, _mm256_set1_epi16(INVALID)),
        );
        let mut left = !bits(bad);
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize / 2];
            let same = _mm256_andnot_si256(bad, _mm256_cmpeq_epi16(d, _mm256_set1_epi16(v)));
            left &= !bits(same);
            let to = &mut taken[place(x, v)..][..BLOCK];
            let same =
                _mm_packs_epi16(_mm256_castsi256_si128(same), _mm256_extracti128_si256::<1>(same));
            // SAFETY: 16 flags.
            unsafe {
                let flags = _mm_loadu_si128(to.as_ptr().cast());
                let flags = _mm_or_si128(flags, _mm_and_si128(same, _mm_set1_epi8(1)));
                _mm_storeu_si128(to.as_mut_ptr().cast(), flags);
            }
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize / 2;
            left &= !(3 << (2 * i));
            taken[place(x + i, disparity[x + i])] = 1;
        }
    }
    scalar::take(whole, &disparity[whole..], &cost[whole..], most, taken);
}
