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
    // Distances above, indices from a constant below.
    let distance = |other| {
        let bits = _mm512_popcnt_epi64(_mm512_xor_si512(value, other));
        _mm512_slli_epi64::<32>(bits)
    };
    let first = _mm512_setr_epi64(0, 1, 2, 3, 4, 5, 6, 7);
    let mut best = [_mm512_set1_epi64(-1); 4];
    let whole = row.len() / BLOCK * BLOCK;
    let mut index = first;
    for at in (0..whole).step_by(BLOCK) {
        for (k, best) in best.iter_mut().enumerate() {
            // SAFETY: within the row.
            let other = unsafe { _mm512_loadu_si512(row.as_ptr().add(at + 8 * k).cast()) };
            *best = _mm512_min_epu64(*best, _mm512_or_si512(distance(other), index));
            index = _mm512_add_epi64(index, _mm512_set1_epi64(8));
        }
    }
    let mut best =
        _mm512_min_epu64(_mm512_min_epu64(best[0], best[1]), _mm512_min_epu64(best[2], best[3]));
    for at in (whole..row.len()).step_by(8) {
        let here = (row.len() - at).min(8);
        let inside = 0xFF_u8 >> (8 - here);
        // SAFETY: only values inside the row are read.
        let other = unsafe { _mm512_maskz_loadu_epi64(inside, row.as_ptr().add(at).cast()) };
        let key = _mm512_or_si512(distance(other), index);
        best = _mm512_mask_min_epu64(best, inside, best, key);
        index = _mm512_add_epi64(index, _mm512_set1_epi64(8));
    }
    _mm512_reduce_min_epu64(best)
}

/// The number of those that are not taken. What is written behind them does not count.
///
/// # Safety
/// The processor has the features; as many flags as descriptors; `descriptors` and `columns` are longer
/// by a block.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512vbmi2")]
pub(super) unsafe fn untaken(
    taken: &[u8],
    row: &[u64],
    descriptors: &mut [u64],
    columns: &mut [u16],
) -> usize {
    let mut n = 0;
    let numbers: [u16; BLOCK] = std::array::from_fn(|i| i as u16);
    // SAFETY: 64 bytes.
    let numbers = unsafe { _mm512_loadu_si512(numbers.as_ptr().cast()) };
    for at in (0..row.len()).step_by(BLOCK) {
        let inside = u32::MAX >> (BLOCK - (row.len() - at).min(BLOCK));
        // SAFETY: only flags inside the row are read.
        let flags = unsafe { _mm256_maskz_loadu_epi8(inside, taken.as_ptr().add(at).cast()) };
        let free = _mm256_mask_testn_epi8_mask(inside, flags, flags);
        if free == 0 {
            continue;
        }
        let here = _mm512_add_epi16(numbers, _mm512_set1_epi16(at as i16));
        // SAFETY: no more were written than were passed, and a block fits behind them.
        unsafe {
            let packed = _mm512_maskz_compress_epi16(free, here);
            _mm512_storeu_si512(columns.as_mut_ptr().add(n).cast(), packed);
        }
        for k in 0..BLOCK / 8 {
            let free = (free >> (8 * k)) as u8;
            // SAFETY: as above; only descriptors of the row are read.
            unsafe {
                let own = _mm512_maskz_loadu_epi64(free, row.as_ptr().add(at + 8 * k).cast());
                let packed = _mm512_maskz_compress_epi64(free, own);
                _mm512_storeu_si512(descriptors.as_mut_ptr().add(n).cast(), packed);
            }
            n += free.count_ones() as usize;
        }
    }
    n
}
