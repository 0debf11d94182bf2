//! NEON: 16 outputs a block, 8 at a time.

use std::arch::aarch64::*;

use super::{BLOCK, Row};
use crate::rectify::kernel::{PHASE_BITS, PHASES, TAPS};

/// The taps of eight outputs.
///
/// # Safety
/// The processor has NEON; there is a set of taps for each phase.
#[target_feature(enable = "neon")]
#[inline]
unsafe fn taps_of(taps: &[[i16; TAPS]], offsets: &[u16; 8]) -> [int16x8_t; 8] {
    offsets.map(|offset| {
        // SAFETY: the caller's promise; a set of taps is 16 bytes.
        unsafe { vld1q_s16(taps.as_ptr().add(usize::from(offset) % PHASES).cast()) }
    })
}

/// Sums divided by 2^-`by`, rounded and saturated. No kernel's sums come near the ends of 32 bits.
#[target_feature(enable = "neon")]
#[inline]
fn finish(sums: [int32x4_t; 2], by: int32x4_t) -> int16x8_t {
    vqmovn_high_s32(vqmovn_s32(vrshlq_s32(sums[0], by)), vrshlq_s32(sums[1], by))
}

/// # Safety
/// The processor has NEON; arguments are as [`super::along`] checks.
#[target_feature(enable = "neon")]
pub(super) unsafe fn along(
    line: &[i16],
    row: Row<'_>,
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    let by = vdupq_n_s32(-(shift as i32));
    let (places, _) = row.offsets.as_chunks::<8>();
    let (outputs, _) = out.as_chunks_mut::<8>();
    for (k, (offsets, out)) in places.iter().zip(outputs).enumerate() {
        // SAFETY: `first` lies within the line.
        let from = unsafe { line.as_ptr().add(row.blocks[8 * k / BLOCK].first as usize) };
        // SAFETY: the caller's promise.
        let taps = unsafe { taps_of(taps, offsets) };
        let mut products = [by; 8];
        for (product, (offset, taps)) in products.iter_mut().zip(offsets.iter().zip(taps)) {
            // SAFETY: eight samples from there lie within the line's reach.
            let samples = unsafe { vld1q_s16(from.add(usize::from(*offset) >> PHASE_BITS)) };
            let near = vmull_s16(vget_low_s16(samples), vget_low_s16(taps));
            *product = vmlal_high_s16(near, samples, taps);
        }
        let [a, b, c, d, e, f, g, h] = products;
        let low = vpaddq_s32(vpaddq_s32(a, b), vpaddq_s32(c, d));
        let high = vpaddq_s32(vpaddq_s32(e, f), vpaddq_s32(g, h));
        // SAFETY: 16 bytes.
        unsafe { vst1q_s16(out.as_mut_ptr(), finish([low, high], by)) };
    }
}

/// # Safety
/// The processor has NEON; arguments are as [`super::across`] checks.
#[target_feature(enable = "neon")]
pub(super) unsafe fn across(
    lines: &[i16],
    stride: usize,
    row: Row<'_>,
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    let by = vdupq_n_s32(-(shift as i32));
    let (places, _) = row.offsets.as_chunks::<8>();
    for (k, (offsets, out)) in places.iter().zip(out.chunks_mut(8)).enumerate() {
        let block = row.blocks[8 * k / BLOCK];
        // SAFETY: within the first of the block's lines; the block is no longer than a line.
        let from = unsafe { lines.as_ptr().add(block.first as usize * stride + 8 * k) };
        // SAFETY: `span` lines further lie the last taps.
        let load = |line: usize| unsafe { vld1q_s16(from.add(line * stride)) };
        let mut samples = [vdupq_n_s16(0); TAPS];
        for (j, samples) in samples.iter_mut().enumerate() {
            *samples = load(j);
        }
        if block.span > 0 {
            // SAFETY: 16 bytes.
            let offsets = unsafe { vld1q_u16(offsets.as_ptr()) };
            for n in 1..=block.span as usize {
                let beyond = vcgeq_u16(offsets, vdupq_n_u16((n << PHASE_BITS) as u16));
                for (j, samples) in samples.iter_mut().enumerate() {
                    *samples = vbslq_s16(beyond, load(n + j), *samples);
                }
            }
        }
        // SAFETY: the caller's promise.
        let taps = transposed(unsafe { taps_of(taps, offsets) });
        let mut sums = [vdupq_n_s32(0); 2];
        for (samples, taps) in samples.into_iter().zip(taps) {
            sums[0] = vmlal_s16(sums[0], vget_low_s16(samples), vget_low_s16(taps));
            sums[1] = vmlal_high_s16(sums[1], samples, taps);
        }
        let values = finish(sums, by);
        if let Some(out) = out.first_chunk_mut::<8>() {
            // SAFETY: 16 bytes.
            unsafe { vst1q_s16(out.as_mut_ptr(), values) };
        } else {
            let mut all = [0_i16; 8];
            // SAFETY: 16 bytes.
            unsafe { vst1q_s16(all.as_mut_ptr(), values) };
            out.copy_from_slice(&all[..out.len()]);
        }
    }
}

/// From the eight taps of each output to each tap of the eight outputs.
#[target_feature(enable = "neon")]
#[inline]
fn transposed(own: [int16x8_t; 8]) -> [int16x8_t; 8] {
    let wide = |v| vreinterpretq_s32_s16(v);
    let twos = |a, b| (wide(vtrn1q_s16(a, b)), wide(vtrn2q_s16(a, b)));
    // Even and odd taps of two outputs, then every fourth of four, then every eighth.
    let [a, b, c, d, e, f, g, h] = own;
    let (ab, cd, ef, gh) = (twos(a, b), twos(c, d), twos(e, f), twos(g, h));
    let fours = |a, b| {
        let wider = |v| vreinterpretq_s64_s32(v);
        (wider(vtrn1q_s32(a, b)), wider(vtrn2q_s32(a, b)))
    };
    let (even, odd) = (fours(ab.0, cd.0), fours(ab.1, cd.1));
    let (even_high, odd_high) = (fours(ef.0, gh.0), fours(ef.1, gh.1));
    let first = |a, b| vreinterpretq_s16_s64(vtrn1q_s64(a, b));
    let last = |a, b| vreinterpretq_s16_s64(vtrn2q_s64(a, b));
    [
        first(even.0, even_high.0),
        first(odd.0, odd_high.0),
        first(even.1, even_high.1),
        first(odd.1, odd_high.1),
        last(even.0, even_high.0),
        last(odd.0, odd_high.0),
        last(even.1, even_high.1),
        last(odd.1, odd_high.1),
    ]
}
