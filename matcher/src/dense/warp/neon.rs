//! NEON: 8 pixels a block; each pixel's eight taps are one load, summed by pairwise additions.

use std::arch::{aarch64::*, asm};

use super::{FARTHEST, Source, Warped};
use crate::{
    Sample,
    dense::{gradient::SQUARE_SHIFT, kernels::Kernels},
};

/// Pixels of a block.
const BLOCK: usize = 8;

/// Where 4 pixels are interpolated; columns and phases are 0 where they are not.
struct Place {
    /// Disparity in 1/16 px.
    steps: int32x4_t,
    /// Column of the first tap.
    first: int32x4_t,
    phase: int32x4_t,
    valid: uint32x4_t,
}

/// # Safety
/// The processor has NEON; `i + 4` is at most the number of pixels.
#[target_feature(enable = "neon")]
#[inline]
unsafe fn place(source: &Source<'_>, i: usize, width: i32) -> Place {
    // SAFETY: 16 bytes.
    let lane = unsafe { vld1q_s32([0, 1, 2, 3].as_ptr()) };
    // SAFETY: the caller's promise.
    let w = unsafe { vld1q_f32(source.w.as_ptr().add(i)) };
    let steps = vcvtnq_s32_f32(vmulq_n_f32(w, 16.0));
    let x = vaddq_s32(lane, vdupq_n_s32((source.x0 + i) as i32));
    let at = vsubq_s32(vshlq_n_s32::<4>(x), steps);
    let first = vsubq_s32(vshrq_n_s32::<4>(at), vdupq_n_s32(3));
    // False for NaN.
    let known = vcaltq_f32(w, vdupq_n_f32(FARTHEST));
    let inside = vandq_u32(vcgezq_s32(first), vcleq_s32(first, vdupq_n_s32(width - 8)));
    let valid = vandq_u32(known, inside);
    let seen = vreinterpretq_s32_u32(valid);
    let phase = vandq_s32(vandq_s32(at, vdupq_n_s32(15)), seen);
    Place { steps, first: vandq_s32(first, seen), phase, valid }
}

/// Adds the products of the upper four lanes, as `vmlal_high_s16`. Of that the compiler moves the
/// upper taps out of the loop over time, to registers that there are not, and takes an instruction more
/// to get the upper samples.
#[target_feature(enable = "neon")]
#[inline]
fn add_high_products(sum: &mut int32x4_t, a: int16x8_t, b: int16x8_t) {
    // SAFETY: reads and writes what it says, and NEON has it.
    unsafe {
        asm!(
            "smlal2 {sum:v}.4s, {a:v}.8h, {b:v}.8h",
            sum = inout(vreg) *sum,
            a = in(vreg) a,
            b = in(vreg) b,
            options(pure, nomem, nostack, preserves_flags)
        );
    }
}

/// Grey values of `row` in 1/16 grey level at eight places, given by the columns of their first taps.
///
/// # Safety
/// The processor has NEON; eight samples from each column lie within the row.
#[target_feature(enable = "neon")]
#[inline]
pub(super) unsafe fn interpolate(
    row: &[Sample],
    first: &[usize; BLOCK],
    taps: &[int16x8_t; BLOCK],
) -> int16x8_t {
    let mut products = [vdupq_n_s32(0); BLOCK];
    for (product, (first, taps)) in products.iter_mut().zip(first.iter().zip(taps)) {
        // SAFETY: the caller's promise.
        let samples = unsafe { vld1q_s16(row.as_ptr().add(*first)) };
        *product = vmull_s16(vget_low_s16(samples), vget_low_s16(*taps));
        add_high_products(product, samples, *taps);
    }
    let [a, b, c, d, e, f, g, h] = products;
    let low = vpaddq_s32(vpaddq_s32(a, b), vpaddq_s32(c, d));
    let high = vpaddq_s32(vpaddq_s32(e, f), vpaddq_s32(g, h));
    vrshrn_high_n_s32::<16>(vrshrn_n_s32::<16>(low), high)
}

/// Adds the products of eight pixels to their sums.
#[target_feature(enable = "neon")]
#[inline]
fn add_products(sums: &mut [int32x4_t; 2], a: int16x8_t, b: int16x8_t) {
    sums[0] = vmlal_s16(sums[0], vget_low_s16(a), vget_low_s16(b));
    sums[1] = vmlal_high_s16(sums[1], a, b);
}

/// Does whole blocks, and returns the number of pixels done.
///
/// # Safety
/// The processor has NEON; rows hold at least 8 samples; slices are as long as [`super::warp_row`]
/// checks.
#[target_feature(enable = "neon")]
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
#[target_feature(enable = "neon")]
unsafe fn blocks_with<const LG: bool, const TIMED: bool>(
    kernels: &Kernels,
    source: &Source<'_>,
    out: &mut Warped<'_>,
) -> usize {
    let width = source.right[0].len() as i32;
    // SAFETY: 32 bytes.
    let lanes = unsafe { [vld1q_s32([0, 1, 2, 3].as_ptr()), vld1q_s32([4, 5, 6, 7].as_ptr())] };
    let blocks = source.w.len() / BLOCK;
    for i in (0..blocks * BLOCK).step_by(BLOCK) {
        // SAFETY: `i + 8` is at most the number of pixels.
        let places = unsafe { [place(source, i, width), place(source, i + 4, width)] };
        let (mut first, mut phase) = ([0; BLOCK], [0; BLOCK]);
        let origin = vdupq_n_s32(vgetq_lane_s32::<0>(places[0].first));
        let mut apart = vdupq_n_u32(0);
        for (half, place) in places.iter().enumerate() {
            // SAFETY: both arrays hold eight numbers.
            unsafe {
                vst1q_s32(first.as_mut_ptr().add(4 * half), place.first);
                vst1q_s32(phase.as_mut_ptr().add(4 * half), place.phase);
            }
            let beside = vceqq_s32(place.first, vaddq_s32(origin, lanes[half]));
            let whole = vandq_u32(vceqzq_s32(place.phase), place.valid);
            apart = vorrq_u32(apart, vmvnq_u32(vandq_u32(beside, whole)));
        }
        // Neighbours at one whole disparity, as where a coarse search starts: nothing is interpolated.
        let together = vmaxvq_u32(apart) == 0;
        let any = vmaxvq_u32(vorrq_u32(places[0].valid, places[1].valid)) != 0;
        let first = first.map(|first: i32| first as usize);
        // SAFETY: a phase's taps are 16 bytes.
        let taps = phase
            .map(|phase: i32| unsafe { vld1q_s16(kernels.taps[(phase & 15) as usize].as_ptr()) });
        let zero = [vdupq_n_s32(0); 2];
        let (mut ig, mut g1, mut gg, mut lg, mut igt) = (zero, zero, zero, zero, zero);
        let frames = if any { source.right } else { &[] };
        for (pair, rows) in frames.chunks_exact(2).enumerate() {
            let mut g = [vdupq_n_s16(0); 2];
            for (g, row) in g.iter_mut().zip(rows) {
                *g = if together {
                    // SAFETY: eight samples from the fourth of the first pixel's taps end before the
                    // last pixel's last tap.
                    let samples = unsafe { vld1q_s16(row.as_ptr().add(first[0] + 3)) };
                    // Rounds as the taps of phase 0 do.
                    vrshrq_n_s16::<2>(samples)
                } else {
                    // SAFETY: `first + 8` is at most the row's length.
                    unsafe { interpolate(row, &first, &taps) }
                };
            }
            let word = pair * source.stride + i;
            // SAFETY: `word + 8` lies within the gradients.
            let gradient = unsafe { vld2q_s16(source.gradient.as_ptr().add(word).cast()) };
            add_products(&mut ig, g[0], gradient.0);
            add_products(&mut ig, g[1], gradient.1);
            if LG {
                // SAFETY: as above, within the grey values.
                let grey = unsafe { vld2q_s16(source.grey.as_ptr().add(word).cast()) };
                add_products(&mut lg, g[0], grey.0);
                add_products(&mut lg, g[1], grey.1);
            }
            if TIMED && let Some(timed) = &out.timed {
                // SAFETY: as above, within the weighted gradients.
                let t = unsafe { vld2q_s16(timed.gradient.as_ptr().add(word).cast()) };
                add_products(&mut igt, g[0], t.0);
                add_products(&mut igt, g[1], t.1);
            }
            for g in g {
                g1 = [vaddw_s16(g1[0], vget_low_s16(g)), vaddw_high_s16(g1[1], g)];
                add_products(&mut gg, g, g);
            }
        }
        for (half, place) in places.iter().enumerate() {
            let seen = |v| vandq_s32(v, vreinterpretq_s32_u32(place.valid));
            let float = |v| vcvtq_f32_s32(seen(v));
            let square = |v| {
                let rounded = vaddq_s32(v, vdupq_n_s32(1 << (SQUARE_SHIFT - 1)));
                float(vshrq_n_s32::<{ SQUARE_SHIFT as i32 }>(rounded))
            };
            let at = i + 4 * half;
            // SAFETY: `at + 4` lies within every map.
            unsafe {
                let used = vmulq_n_f32(float(place.steps), 1.0 / 16.0);
                vst1q_f32(out.at.as_mut_ptr().add(at), used);
                vst1q_f32(out.valid.as_mut_ptr().add(at), float(vdupq_n_s32(1)));
                vst1q_f32(out.ig.as_mut_ptr().add(at), float(ig[half]));
                vst1q_f32(out.g.as_mut_ptr().add(at), float(g1[half]));
                vst1q_f32(out.gg.as_mut_ptr().add(at), square(gg[half]));
                if LG && let Some(out) = &mut out.lg {
                    vst1q_f32(out.as_mut_ptr().add(at), square(lg[half]));
                }
                if TIMED && let Some(timed) = &mut out.timed {
                    vst1q_f32(timed.ig.as_mut_ptr().add(at), float(igt[half]));
                }
            }
        }
    }
    blocks * BLOCK
}
