//! Hamming costs with NEON: 8 columns at a time, bits counted by CNT.

use std::arch::aarch64::*;

/// The slices are as long as [`super::CostKernel::costs`] asserts.
#[target_feature(enable = "neon")]
pub(super) fn costs(
    words: &[u16],
    planes: &[u16],
    invalid: &[u16],
    first: usize,
    costs: &mut [u16],
) {
    for at in (0..costs.len()).step_by(8) {
        let mut sum = vdupq_n_u16(0);
        for (w, &word) in words.iter().enumerate() {
            // SAFETY: first + at + 8 is at most the plane's length, `invalid`'s.
            let other = unsafe { vld1q_u16(planes.as_ptr().add(w * invalid.len() + first + at)) };
            let differing = veorq_u16(vdupq_n_u16(word), other);
            sum = vpadalq_u8(sum, vcntq_u8(vreinterpretq_u8_u16(differing)));
        }
        // SAFETY: 8 values from there on, in both slices.
        unsafe {
            let invalid = vld1q_u16(invalid.as_ptr().add(first + at));
            vst1q_u16(costs.as_mut_ptr().add(at), vorrq_u16(sum, invalid));
        }
    }
}
