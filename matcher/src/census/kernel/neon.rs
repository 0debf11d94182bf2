//! Census with NEON: 8 pixels at a time.

use std::arch::aarch64::*;

use crate::{Sample, params::RADIUS_LIMIT};

/// The slices are as long as [`super::CensusKernel::run`] asserts.
#[target_feature(enable = "neon")]
pub(super) fn census(rows: &[&[Sample]], radius: usize, thresholds: &[Sample], planes: &mut [u16]) {
    let side = 2 * radius + 1;
    let stride = thresholds.len();
    for x in (0..stride).step_by(8) {
        // SAFETY: x + 8 <= stride, the length of `thresholds`.
        let threshold = unsafe { vld1q_s16(thresholds.as_ptr().add(x)) };
        let mut word = vdupq_n_u16(0);
        let mut k = 0;
        for window in rows.chunks_exact(side) {
            for i in 0..side {
                let column = RADIUS_LIMIT - radius + i + x;
                for row in window {
                    // SAFETY: column + 8 <= 2 RADIUS_LIMIT + stride, at most the row's length.
                    let sample = unsafe { vld1q_s16(row.as_ptr().add(column)) };
                    let above = vcgtq_s16(sample, threshold);
                    word = vorrq_u16(word, vandq_u16(above, vdupq_n_u16(1 << (k % 16))));
                    k += 1;
                    if k % 16 == 0 {
                        // SAFETY: plane k / 16 - 1 is complete inside `planes`.
                        unsafe {
                            vst1q_u16(planes.as_mut_ptr().add((k / 16 - 1) * stride + x), word);
                        }
                        word = vdupq_n_u16(0);
                    }
                }
            }
        }
        if k % 16 != 0 {
            // SAFETY: `planes` has a last plane for the bits left over.
            unsafe { vst1q_u16(planes.as_mut_ptr().add(k / 16 * stride + x), word) };
        }
    }
}
