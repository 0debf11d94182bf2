//! AVX2: 16 outputs a block.

use std::arch::x86_64::*;

use super::{BLOCK, Row};
use crate::rectify::kernel::{PHASE_BITS, PHASES, TAPS};

/// Eight samples or taps from each of two places.
///
/// # Safety
/// They are readable.
#[target_feature(enable = "avx2")]
#[inline]
unsafe fn two(low: *const i16, high: *const i16) -> __m256i {
    // SAFETY: the caller's promise.
    unsafe {
        _mm256_inserti128_si256::<1>(
            _mm256_castsi128_si256(_mm_loadu_si128(low.cast())),
            _mm_loadu_si128(high.cast()),
        )
    }
}

/// # Safety
/// The processor has AVX2; arguments are as [`super::along`] checks.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn along(
    line: &[i16],
    row: Row<'_>,
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    let rounding = _mm256_set1_epi32(1 << (shift - 1));
    let by = _mm_cvtsi32_si128(shift as i32);
    let taps = taps.as_ptr();
    let (places, _) = row.offsets.as_chunks::<BLOCK>();
    let (outputs, _) = out.as_chunks_mut::<BLOCK>();
    for ((block, offsets), out) in row.blocks.iter().zip(places).zip(outputs) {
        // SAFETY: `first` lies within the line.
        let from = unsafe { line.as_ptr().add(block.first as usize) };
        let mut sums = [rounding; 2];
        for (half, sum) in sums.iter_mut().enumerate() {
            let mut products = [rounding; 4];
            for (k, product) in products.iter_mut().enumerate() {
                let (low, high) = (offsets[8 * half + k], offsets[8 * half + k + 4]);
                let (low, high) = (usize::from(low), usize::from(high));
                // SAFETY: eight samples from there lie within the line's reach; there is a set of
                // taps for each phase.
                let (samples, taps) = unsafe {
                    (
                        two(from.add(low >> PHASE_BITS), from.add(high >> PHASE_BITS)),
                        two(
                            taps.add(low % PHASES).cast::<i16>(),
                            taps.add(high % PHASES).cast::<i16>(),
                        ),
                    )
                };
                *product = _mm256_madd_epi16(samples, taps);
            }
            let all = _mm256_hadd_epi32(
                _mm256_hadd_epi32(products[0], products[1]),
                _mm256_hadd_epi32(products[2], products[3]),
            );
            *sum = _mm256_sra_epi32(_mm256_add_epi32(all, rounding), by);
        }
        // Packing leaves outputs 0-3, 8-11, 4-7, 12-15.
        let packed =
            _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packs_epi32(sums[0], sums[1]));
        // SAFETY: 32 bytes.
        unsafe { _mm256_storeu_si256(out.as_mut_ptr().cast(), packed) };
    }
}

/// # Safety
/// The processor has AVX2; arguments are as [`super::across`] checks.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn across(
    lines: &[i16],
    stride: usize,
    row: Row<'_>,
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    let rounding = _mm256_set1_epi32(1 << (shift - 1));
    let by = _mm_cvtsi32_si128(shift as i32);
    let taps = taps.as_ptr();
    let (places, _) = row.offsets.as_chunks::<BLOCK>();
    for ((b, block), offsets) in row.blocks.iter().enumerate().zip(places) {
        // SAFETY: within the first of the block's lines; the block is no longer than a line.
        let from = unsafe { lines.as_ptr().add(block.first as usize * stride + b * BLOCK) };
        // SAFETY: `span` lines further lie the last taps.
        let load = |line: usize| unsafe { _mm256_loadu_si256(from.add(line * stride).cast()) };
        let mut samples = [rounding; TAPS];
        for (j, samples) in samples.iter_mut().enumerate() {
            *samples = load(j);
        }
        if block.span > 0 {
            // SAFETY: 32 bytes.
            let offsets = unsafe { _mm256_loadu_si256(offsets.as_ptr().cast()) };
            for n in 1..=block.span as usize {
                let least = _mm256_set1_epi16((n << PHASE_BITS) as u16 as i16);
                let beyond = _mm256_cmpeq_epi16(_mm256_max_epu16(offsets, least), offsets);
                for (j, samples) in samples.iter_mut().enumerate() {
                    *samples = _mm256_blendv_epi8(*samples, load(n + j), beyond);
                }
            }
        }
        let mut sums = [rounding; 2];
        for (half, sum) in sums.iter_mut().enumerate() {
            let mut own = [rounding; 4];
            for (k, own) in own.iter_mut().enumerate() {
                let (low, high) = (offsets[4 * half + k], offsets[4 * half + k + 8]);
                // SAFETY: there is a set of taps for each phase.
                *own = unsafe {
                    two(
                        taps.add(usize::from(low) % PHASES).cast::<i16>(),
                        taps.add(usize::from(high) % PHASES).cast::<i16>(),
                    )
                };
            }
            // From eight taps an output to pairs of taps of all outputs.
            let (a, b) =
                (_mm256_unpacklo_epi32(own[0], own[1]), _mm256_unpacklo_epi32(own[2], own[3]));
            let (c, d) =
                (_mm256_unpackhi_epi32(own[0], own[1]), _mm256_unpackhi_epi32(own[2], own[3]));
            let pairs = [
                _mm256_unpacklo_epi64(a, b),
                _mm256_unpackhi_epi64(a, b),
                _mm256_unpacklo_epi64(c, d),
                _mm256_unpackhi_epi64(c, d),
            ];
            for (j, pair) in pairs.into_iter().enumerate() {
                let (even, odd) = (samples[2 * j], samples[2 * j + 1]);
                let both = match half {
                    0 => _mm256_unpacklo_epi16(even, odd),
                    _ => _mm256_unpackhi_epi16(even, odd),
                };
                *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(both, pair));
            }
            *sum = _mm256_sra_epi32(*sum, by);
        }
        let packed = _mm256_packs_epi32(sums[0], sums[1]);
        let out = &mut out[b * BLOCK..];
        if let Some(out) = out.first_chunk_mut::<BLOCK>() {
            // SAFETY: 32 bytes.
            unsafe { _mm256_storeu_si256(out.as_mut_ptr().cast(), packed) };
        } else {
            let mut all = [0_i16; BLOCK];
            // SAFETY: 32 bytes.
            unsafe { _mm256_storeu_si256(all.as_mut_ptr().cast(), packed) };
            out.copy_from_slice(&all[..out.len()]);
        }
    }
}
