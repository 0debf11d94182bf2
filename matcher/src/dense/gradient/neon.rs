//! NEON: 8 pixels a block.

use std::arch::aarch64::*;

use super::{SQUARE_SHIFT, Static};
use crate::{Sample, dense::kernels::Kernels};

/// # Safety
/// The processor has NEON; for each block `at`, its pixels lie within `out`, and within every row with
/// 3 samples on both sides.
#[target_feature(enable = "neon")]
pub(super) unsafe fn blocks(
    kernels: &Kernels,
    left: &[&[Sample]],
    x0: usize,
    blocks: impl Iterator<Item = usize>,
    out: &mut Static<'_>,
) {
    let c = kernels.gradient;
    for at in blocks {
        let mut sums = [[vdupq_n_s32(0); 5]; 2];
        for (pair, rows) in left.chunks_exact(2).enumerate() {
            let mut grey = [vdupq_n_s16(0); 2];
            let mut gradient = [vdupq_n_s16(0); 2];
            for f in 0..2 {
                // SAFETY: the caller's promise covers 3 samples on both sides.
                unsafe {
                    let p = rows[f].as_ptr().add(x0 + at);
                    grey[f] = vrshrq_n_s16::<2>(vld1q_s16(p));
                    let near = vqsubq_s16(vld1q_s16(p.offset(1)), vld1q_s16(p.offset(-1)));
                    let middle = vqsubq_s16(vld1q_s16(p.offset(2)), vld1q_s16(p.offset(-2)));
                    let far = vqsubq_s16(vld1q_s16(p.offset(3)), vld1q_s16(p.offset(-3)));
                    gradient[f] = vaddq_s16(
                        vaddq_s16(vqrdmulhq_n_s16(near, c[0]), vqrdmulhq_n_s16(middle, c[1])),
                        vqrdmulhq_n_s16(far, c[2]),
                    );
                }
            }
            let ([g, g_odd], [l, l_odd]) = (gradient, grey);
            for (half, s) in sums.iter_mut().enumerate() {
                let (g_pairs, l_pairs) = match half {
                    0 => (vzip1q_s16(g, g_odd), vzip1q_s16(l, l_odd)),
                    _ => (vzip2q_s16(g, g_odd), vzip2q_s16(l, l_odd)),
                };
                let word = pair * out.stride + at + half * 4;
                // SAFETY: `word + 4` lies within both outputs.
                unsafe {
                    vst1q_s16(out.gradient.as_mut_ptr().add(word).cast(), g_pairs);
                    vst1q_s16(out.grey.as_mut_ptr().add(word).cast(), l_pairs);
                }
                let product = |sum, a, b| match half {
                    0 => vmlal_s16(sum, vget_low_s16(a), vget_low_s16(b)),
                    _ => vmlal_high_s16(sum, a, b),
                };
                s[0] = product(product(s[0], g, g), g_odd, g_odd);
                s[1] = product(product(s[1], g, l), g_odd, l_odd);
                s[2] = vpadalq_s16(s[2], g_pairs);
                s[3] = vpadalq_s16(s[3], l_pairs);
                s[4] = product(product(s[4], l, l), l_odd, l_odd);
            }
        }
        for (half, s) in sums.iter_mut().enumerate() {
            let rounded = vaddq_s32(s[4], vdupq_n_s32(1 << (SQUARE_SHIFT - 1)));
            s[4] = vshrq_n_s32::<{ SQUARE_SHIFT as i32 }>(rounded);
            let maps = [&mut *out.s, &mut *out.il, &mut *out.i, &mut *out.l, &mut *out.ll];
            for (map, s) in maps.into_iter().zip(*s) {
                // SAFETY: `at + 8` lies within every map.
                unsafe { vst1q_f32(map.as_mut_ptr().add(at + half * 4), vcvtq_f32_s32(s)) };
            }
        }
    }
}
