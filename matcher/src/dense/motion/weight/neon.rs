//! NEON: 4 pixels a register.

use std::arch::aarch64::*;

use super::Weighted;

/// # Safety
/// The processor has NEON; slices are as long as [`super::weigh`] checks.
#[target_feature(enable = "neon")]
pub(super) unsafe fn weigh(
    gradient: &[i32],
    grey: &[i32],
    times: &[i32; 8],
    out: &mut Weighted<'_>,
) {
    let len = out.ilt.len();
    for x in (0..len).step_by(4) {
        // Of even and odd frames apart.
        let mut sums = [[vdupq_n_s32(0); 2]; 3];
        let mut plain = vdupq_n_s32(0);
        for (pair, time) in (0..gradient.len() / len).zip(times) {
            let at = pair * len + x;
            // SAFETY: `at + 4` lies within all words.
            let (g, l) = unsafe {
                (
                    vld1q_s16(gradient.as_ptr().add(at).cast()),
                    vld1q_s16(grey.as_ptr().add(at).cast()),
                )
            };
            let weighted = vqrdmulhq_s16(g, vreinterpretq_s16_s32(vdupq_n_s32(*time)));
            // SAFETY: as above.
            unsafe { vst1q_s16(out.gradient.as_mut_ptr().add(at).cast(), weighted) };
            for (sum, with) in sums.iter_mut().zip([l, g, weighted]) {
                sum[0] = vmlal_s16(sum[0], vget_low_s16(weighted), vget_low_s16(with));
                sum[1] = vmlal_high_s16(sum[1], weighted, with);
            }
            plain = vpadalq_s16(plain, weighted);
        }
        let [ilt, st, stt] = sums.map(|[low, high]| vpaddq_s32(low, high));
        let maps = [&mut *out.ilt, &mut *out.it, &mut *out.st, &mut *out.stt];
        for (map, sum) in maps.into_iter().zip([ilt, plain, st, stt]) {
            // SAFETY: `x + 4` lies within every sum.
            unsafe { vst1q_f32(map.as_mut_ptr().add(x), vcvtq_f32_s32(sum)) };
        }
    }
}
