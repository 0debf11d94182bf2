//! NEON: 32 pixels at a time, eight outcomes a byte.

use std::arch::aarch64::*;

use super::Rows;

/// Pixels at a time, in two registers.
const BLOCK: usize = 32;

/// # Safety
/// The processor has NEON; `out` is a multiple of 32 long, and every row is at least as long.
#[target_feature(enable = "neon")]
pub(super) unsafe fn blocks(rows: &Rows<'_>, out: &mut [u64]) {
    for at in (0..out.len()).step_by(BLOCK) {
        // SAFETY: the caller's promise.
        let load = |row: &[i8]| unsafe {
            let from = row.as_ptr().add(at);
            [vld1q_s8(from), vld1q_s8(from.add(16))]
        };
        let mean = load(rows.than[0]);
        let mut bytes = [[vdupq_n_u8(0); 2]; 8];
        for (i, byte) in bytes.iter_mut().enumerate() {
            for k in (8 * i..8 * i + 8).rev() {
                let than = if k < rows.means { mean } else { load(rows.than[k]) };
                let codes = load(rows.codes[k]);
                for half in 0..2 {
                    // The last bit of the outcome, behind those before it.
                    let above = vcgtq_s8(codes[half], than[half]);
                    byte[half] = vsliq_n_u8::<1>(above, byte[half]);
                }
            }
        }
        for half in 0..2 {
            let [a, b, c, d, e, f, g, h] = bytes.map(|byte| byte[half]);
            // From bytes to pairs of bytes of a pixel, to pairs of pairs and so on.
            let (ab, cd, ef, gh) = (pairs(a, b), pairs(c, d), pairs(e, f), pairs(g, h));
            for eight in 0..2 {
                let (low, high) = (fours(ab[eight], cd[eight]), fours(ef[eight], gh[eight]));
                for four in 0..2 {
                    let (low, high) = (low[four], high[four]);
                    let to = at + 16 * half + 8 * eight + 4 * four;
                    // SAFETY: the caller's promise: `to + 4` lies within the row.
                    unsafe {
                        let to = out.as_mut_ptr().add(to).cast::<u32>();
                        vst1q_u32(to, vzip1q_u32(low, high));
                        vst1q_u32(to.add(4), vzip2q_u32(low, high));
                    }
                }
            }
        }
    }
}

/// Bytes of sixteen pixels in pairs, eight pixels a register.
#[target_feature(enable = "neon")]
#[inline]
fn pairs(a: uint8x16_t, b: uint8x16_t) -> [uint16x8_t; 2] {
    [vreinterpretq_u16_u8(vzip1q_u8(a, b)), vreinterpretq_u16_u8(vzip2q_u8(a, b))]
}

/// Pairs of eight pixels in pairs, four pixels a register.
#[target_feature(enable = "neon")]
#[inline]
fn fours(a: uint16x8_t, b: uint16x8_t) -> [uint32x4_t; 2] {
    [vreinterpretq_u32_u16(vzip1q_u16(a, b)), vreinterpretq_u32_u16(vzip2q_u16(a, b))]
}
