//! NEON: 2 pixels a register.

use std::arch::aarch64::*;

/// # Safety
/// The processor has NEON; arguments are as [`super::best_candidates`] checks.
#[target_feature(enable = "neon")]
pub(super) unsafe fn search(
    left: &[u64],
    right: &[u64],
    origin: usize,
    shifts: &[i32],
    best: &mut [u32],
) {
    for at in (0..left.len()).step_by(4) {
        // SAFETY: `at + 4` lies within `left`.
        let l = unsafe { [vld1q_u64(left.as_ptr().add(at)), vld1q_u64(left.as_ptr().add(at + 2))] };
        let mut b = vdupq_n_u32(u32::MAX);
        for &shift in shifts {
            // SAFETY: the candidate lies inside for the whole block.
            let bits = unsafe {
                let r = right.as_ptr().offset((origin + at) as isize - shift as isize);
                let count = |l: uint64x2_t, r: uint64x2_t| {
                    let bytes = vcntq_u8(vreinterpretq_u8_u64(veorq_u64(l, r)));
                    vpaddlq_u32(vpaddlq_u16(vpaddlq_u8(bytes)))
                };
                vcombine_u32(
                    vmovn_u64(count(l[0], vld1q_u64(r))),
                    vmovn_u64(count(l[1], vld1q_u64(r.add(2)))),
                )
            };
            let key = vorrq_u32(vshlq_n_u32::<16>(bits), vdupq_n_u32((shift - shifts[0]) as u32));
            b = vminq_u32(b, key);
        }
        // SAFETY: `at + 4` lies within `best`.
        unsafe { vst1q_u32(best.as_mut_ptr().add(at), b) };
    }
}
