//! AVX-512 with VNNI: 16 pixels a block, time in the loop.
//!
//! A window of 32 samples holds the taps of all 16 pixels where the disparity varies by at most 8 px
//! over them; a word permutation picks each pixel's taps in pairs. Blocks that vary more take
//! further windows for the pixels not yet done.

use std::arch::x86_64::*;

use super::{Source, Warped};
use crate::dense::{gradient::SQUARE_SHIFT, kernels::Kernels};

/// Sums of squares in their unit.
#[target_feature(enable = "avx512f")]
#[inline]
fn square(sum: __m512i) -> __m512 {
    let rounded = _mm512_add_epi32(sum, _mm512_set1_epi32(1 << (SQUARE_SHIFT - 1)));
    _mm512_cvtepi32_ps(_mm512_srai_epi32::<SQUARE_SHIFT>(rounded))
}

/// Blocks whose windows are placed at a time.
const AHEAD: usize = 32;

/// Where 16 pixels are interpolated.
struct Place {
    /// Disparity in 1/16 px.
    steps: __m512i,
    /// Column of the first tap.
    first: __m512i,
    phase: __m512i,
    valid: __mmask16,
}

/// # Safety
/// The processor has AVX-512; `i + 16` is at most the number of pixels.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq")]
#[inline]
unsafe fn place(source: &Source<'_>, i: usize, width: i32) -> Place {
    let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    // SAFETY: the caller's promise.
    let w = unsafe { _mm512_loadu_ps(source.w.as_ptr().add(i)) };
    let steps = _mm512_cvtps_epi32(_mm512_mul_ps(w, _mm512_set1_ps(16.0)));
    let x = _mm512_add_epi32(lane, _mm512_set1_epi32((source.x0 + i) as i32));
    let at = _mm512_sub_epi32(_mm512_slli_epi32::<4>(x), steps);
    let first = _mm512_sub_epi32(_mm512_srai_epi32::<4>(at), _mm512_set1_epi32(3));
    let phase = _mm512_and_si512(at, _mm512_set1_epi32(15));
    // False for NaN.
    let near = _mm512_set1_ps(super::FARTHEST);
    let known = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(_mm512_abs_ps(w), near);
    let right_of = _mm512_cmpge_epi32_mask(first, _mm512_setzero_si512());
    let left_of = _mm512_cmple_epi32_mask(first, _mm512_set1_epi32(width - 8));
    Place { steps, first, phase, valid: known & right_of & left_of }
}

/// Does whole blocks, and returns the number of pixels done.
///
/// # Safety
/// The processor has the features; rows hold at least 32 samples; slices are as long as
/// [`super::warp_row`] checks.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512vnni")]
pub(super) unsafe fn blocks(kernels: &Kernels, source: &Source<'_>, out: &mut Warped<'_>) -> usize {
    // SAFETY: the caller's promise.
    unsafe {
        match (&out.lg, &out.timed) {
            (None, _) => blocks_with::<false, false>(kernels, source, out),
            (_, None) => blocks_with::<true, false>(kernels, source, out),
            _ => blocks_with::<true, true>(kernels, source, out),
        }
    }
}

/// [`blocks`], with or without the products of grey values and those with weighted gradients.
///
/// # Safety
/// As there.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512vnni")]
unsafe fn blocks_with<const LG: bool, const TIMED: bool>(
    kernels: &Kernels,
    source: &Source<'_>,
    out: &mut Warped<'_>,
) -> usize {
    let width = source.right[0].len() as i32;
    // Per pair of taps, a register of the 16 phases' coefficient pairs.
    let mut table = [[0i32; 16]; 4];
    for (phase, taps) in kernels.taps.iter().enumerate() {
        for (j, t) in table.iter_mut().enumerate() {
            t[phase] = i32::from(taps[2 * j] as u16) | i32::from(taps[2 * j + 1]) << 16;
        }
    }
    let mut tables = [_mm512_setzero_si512(); 4];
    for (to, t) in tables.iter_mut().zip(&table) {
        // SAFETY: arrays of 64 bytes.
        *to = unsafe { _mm512_loadu_si512(t.as_ptr().cast()) };
    }
    let ones = _mm512_set1_epi16(1);
    let half = _mm512_set1_epi32(0x8000);
    let quarter = _mm512_set1_epi16(8192);
    let blocks = source.w.len() / 16;
    // The windows' places first: finding one takes long, but many at a time overlap.
    let mut bases = [0i32; AHEAD];
    for block in 0..blocks {
        if block % AHEAD == 0 {
            for (k, base) in bases.iter_mut().enumerate().take(blocks - block) {
                // SAFETY: `block + k < blocks`.
                let place = unsafe { place(source, (block + k) * 16, width) };
                *base = _mm512_mask_reduce_min_epi32(place.valid, place.first);
            }
        }
        let i = block * 16;
        // SAFETY: `i + 16` is at most the number of pixels.
        let Place { steps, first, phase, valid } = unsafe { place(source, i, width) };
        let zero = _mm512_setzero_si512();
        let mut taps = [zero; 4];
        for (to, table) in taps.iter_mut().zip(tables) {
            *to = _mm512_permutexvar_epi32(phase, table);
        }
        let (mut ig, mut g1, mut gg, mut lg, mut igt) = (zero, zero, zero, zero, zero);
        // At whole pixels, where a coarse search starts, nothing is interpolated.
        let whole = _mm512_mask_test_epi32_mask(valid, phase, phase) == 0;
        let mut left = valid;
        let mut base = bases[block % AHEAD];
        while left != 0 {
            base = base.min(width - 32);
            let offset = _mm512_sub_epi32(first, _mm512_set1_epi32(base));
            let now = _mm512_mask_cmple_epi32_mask(left, offset, _mm512_set1_epi32(24));
            left &= !now;
            // Both halves of a word hold the offset; then pairs of neighbouring samples.
            let both = _mm512_or_si512(offset, _mm512_slli_epi32::<16>(offset));
            let mut pick = [both; 4];
            for (j, pick) in (0i32..).zip(&mut pick) {
                *pick = _mm512_add_epi16(both, _mm512_set1_epi32((2 * j) | ((2 * j + 1) << 16)));
            }
            // The sample itself, of the even and of the odd frame.
            let itself = _mm512_add_epi16(both, _mm512_set1_epi32(3 | (32 + 3) << 16));
            let (mut ig_now, mut g1_now, mut gg_now) = (zero, zero, zero);
            let (mut lg_now, mut igt_now) = (zero, zero);
            for (pair, rows) in source.right.chunks_exact(2).enumerate() {
                // SAFETY: 0 <= base <= width - 32.
                let windows = unsafe {
                    [
                        _mm512_loadu_si512(rows[0].as_ptr().add(base as usize).cast()),
                        _mm512_loadu_si512(rows[1].as_ptr().add(base as usize).cast()),
                    ]
                };
                let g = if whole {
                    // Rounds as the taps of phase 0 do.
                    let samples = _mm512_permutex2var_epi16(windows[0], itself, windows[1]);
                    _mm512_mulhrs_epi16(samples, quarter)
                } else {
                    let mut sums = [half; 2];
                    for (sum, window) in sums.iter_mut().zip(windows) {
                        for j in 0..4 {
                            let samples = _mm512_permutexvar_epi16(pick[j], window);
                            *sum = _mm512_dpwssd_epi32(*sum, samples, taps[j]);
                        }
                    }
                    let even = _mm512_srli_epi32::<16>(sums[0]);
                    _mm512_mask_blend_epi16(0xAAAA_AAAA, even, sums[1])
                };
                // The images' next row, a line of 32 samples for two blocks.
                if block % 2 == 0 {
                    for row in rows {
                        let next = row.as_ptr().wrapping_add(row.len() + base as usize + 16);
                        _mm_prefetch::<_MM_HINT_T0>(next.cast());
                    }
                }
                let word = pair * source.stride + i;
                // SAFETY: `word + 16` lies within the gradients.
                let gradient =
                    unsafe { _mm512_loadu_si512(source.gradient.as_ptr().add(word).cast()) };
                ig_now = _mm512_dpwssd_epi32(ig_now, g, gradient);
                if LG {
                    // SAFETY: as above, within the grey values.
                    let grey = unsafe { _mm512_loadu_si512(source.grey.as_ptr().add(word).cast()) };
                    lg_now = _mm512_dpwssd_epi32(lg_now, g, grey);
                }
                if TIMED && let Some(timed) = &out.timed {
                    // SAFETY: as above, within the weighted gradients.
                    let t = unsafe { _mm512_loadu_si512(timed.gradient.as_ptr().add(word).cast()) };
                    igt_now = _mm512_dpwssd_epi32(igt_now, g, t);
                }
                g1_now = _mm512_dpwssd_epi32(g1_now, g, ones);
                gg_now = _mm512_dpwssd_epi32(gg_now, g, g);
            }
            ig = _mm512_mask_mov_epi32(ig, now, ig_now);
            g1 = _mm512_mask_mov_epi32(g1, now, g1_now);
            gg = _mm512_mask_mov_epi32(gg, now, gg_now);
            lg = _mm512_mask_mov_epi32(lg, now, lg_now);
            igt = _mm512_mask_mov_epi32(igt, now, igt_now);
            if left != 0 {
                base = _mm512_mask_reduce_min_epi32(left, first);
            }
        }
        let used = _mm512_mul_ps(_mm512_cvtepi32_ps(steps), _mm512_set1_ps(1.0 / 16.0));
        // SAFETY: `i + 16` lies within every map.
        unsafe {
            _mm512_storeu_ps(out.at.as_mut_ptr().add(i), _mm512_maskz_mov_ps(valid, used));
            let one = _mm512_maskz_mov_ps(valid, _mm512_set1_ps(1.0));
            _mm512_storeu_ps(out.valid.as_mut_ptr().add(i), one);
            _mm512_storeu_ps(out.ig.as_mut_ptr().add(i), _mm512_cvtepi32_ps(ig));
            _mm512_storeu_ps(out.g.as_mut_ptr().add(i), _mm512_cvtepi32_ps(g1));
            _mm512_storeu_ps(out.gg.as_mut_ptr().add(i), square(gg));
            if let Some(out) = &mut out.lg {
                _mm512_storeu_ps(out.as_mut_ptr().add(i), square(lg));
            }
            if let Some(timed) = &mut out.timed {
                _mm512_storeu_ps(timed.ig.as_mut_ptr().add(i), _mm512_cvtepi32_ps(igt));
            }
        }
    }
    blocks * 16
}
