//! NEON: 4 pixels at a time, those with a point brought to the front by a table.

use std::arch::aarch64::*;

use super::{
    Part, Row, Sources,
    front::{FRONT, LANES},
    plain,
};

const _: () = assert!(size_of::<nalgebra::Point3<f32>>() == 3 * size_of::<f32>());

/// # Safety
/// The processor has NEON; there is as much of everything as [`super::pack_row`] checks.
#[target_feature(enable = "neon")]
pub(super) unsafe fn pack_row(
    row: &Row,
    from: &Sources<'_>,
    part: &mut Part<'_>,
    mut at: usize,
) -> usize {
    let infinity = vdupq_n_f32(row.disparity_at_infinity_px);
    // SAFETY: 16 bytes each.
    let (numbers, bits) =
        unsafe { (vld1q_s32([0, 1, 2, 3].as_ptr()), vld1q_u32([1, 2, 4, 8].as_ptr())) };
    let n = from.disparity_px.len();
    let mut x = 0;
    // Whole vectors are written, of which what lies behind the points does not count.
    while x + LANES <= n && at + LANES <= part.points.len() {
        // SAFETY: within the row.
        let d = unsafe { vld1q_f32(from.disparity_px.as_ptr().add(x)) };
        let parallax = vsubq_f32(d, infinity);
        let set = vaddvq_u32(vandq_u32(vcgtzq_f32(parallax), bits)) as usize;
        if set != 0 {
            // SAFETY: 16 bytes; there are as many sets.
            let order = unsafe { vld1q_u8(FRONT[set & 15].as_ptr()) };
            let front = |v| vreinterpretq_f32_u8(vqtbl1q_u8(vreinterpretq_u8_f32(v), order));
            let scale = vdivq_f32(vdupq_n_f32(1.0), parallax);
            let column = vcvtq_f32_s32(vaddq_s32(numbers, vdupq_n_s32(x as i32)));
            let component = |k: usize| {
                // Not fused, so that every level gives the same.
                let along = vmulq_f32(vdupq_n_f32(row.step[k]), column);
                let ray = vaddq_f32(vdupq_n_f32(row.first[k]), along);
                front(vmulq_f32(ray, scale))
            };
            let points = float32x4x3_t(component(0), component(1), component(2));
            // SAFETY: four of everything are read, within the row, and written, from `at` on, where
            // there is place for them; a point is three numbers.
            unsafe {
                vst3q_f32(part.points.as_mut_ptr().add(at).cast::<f32>(), points);
                let zncc = vld1q_f32(from.zncc.as_ptr().add(x));
                vst1q_f32(part.zncc.as_mut_ptr().add(at), front(zncc));
                if let Some(rate) = from.rate {
                    let rate = vld1q_f32(rate.as_ptr().add(x));
                    vst1q_f32(part.rate.as_mut_ptr().add(at), front(rate));
                }
                // A grey value is every fourth byte.
                let grey = from.intensity.as_ptr().add(x).cast::<u32>().read_unaligned();
                let wide = vmovl_u16(vget_low_u16(vmovl_u8(vcreate_u8(u64::from(grey)))));
                let packed = vreinterpretq_u16_u8(vqtbl1q_u8(vreinterpretq_u8_u32(wide), order));
                let packed = vmovn_u16(vcombine_u16(
                    vmovn_u32(vreinterpretq_u32_u16(packed)),
                    vdup_n_u16(0),
                ));
                let to = part.intensity.as_mut_ptr().add(at).cast::<u32>();
                to.write_unaligned(vget_lane_u32::<0>(vreinterpret_u32_u8(packed)));
            }
            at += set.count_ones() as usize;
        }
        x += LANES;
    }
    if x < n { plain::pack_row(row, from, part, x, at) } else { at }
}
