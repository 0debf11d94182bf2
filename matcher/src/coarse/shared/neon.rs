//! NEON: 16 pixels a block.

use std::arch::aarch64::*;

use super::{SPREAD, place, scalar};
use crate::coarse::INVALID;

const BLOCK: usize = 16;

/// The columns from `x` on.
#[target_feature(enable = "neon")]
#[inline]
fn columns(x: usize) -> [uint16x8_t; 2] {
    // SAFETY: 16 bytes.
    let numbers = unsafe { vld1q_u16([0, 1, 2, 3, 4, 5, 6, 7].as_ptr()) };
    [vaddq_u16(numbers, vdupq_n_u16(x as u16)), vaddq_u16(numbers, vdupq_n_u16(x as u16 + 8))]
}

/// Outcomes of 16 pixels, a byte each.
#[target_feature(enable = "neon")]
#[inline]
fn bytes(mask: [uint16x8_t; 2]) -> uint8x16_t {
    vuzp1q_u8(vreinterpretq_u8_u16(mask[0]), vreinterpretq_u8_u16(mask[1]))
}

/// Four bits a pixel: there is no instruction that gathers the signs of all.
#[target_feature(enable = "neon")]
#[inline]
fn bits(mask: uint8x16_t) -> u64 {
    let nibbles = vshrn_n_u16::<4>(vreinterpretq_u16_u8(mask));
    vget_lane_u64::<0>(vreinterpret_u64_u8(nibbles))
}

/// Which pixels of a block have a disparity.
#[target_feature(enable = "neon")]
#[inline]
fn equal(d: [int16x8_t; 2], value: i16) -> [uint16x8_t; 2] {
    let value = vdupq_n_s16(value);
    [vceqq_s16(d[0], value), vceqq_s16(d[1], value)]
}

/// # Safety
/// The processor has NEON; 16 disparities are readable at `from`.
#[target_feature(enable = "neon")]
#[inline]
unsafe fn load(from: *const i16) -> [int16x8_t; 2] {
    // SAFETY: the caller's promise.
    unsafe { [vld1q_s16(from), vld1q_s16(from.add(8))] }
}

/// # Safety
/// The processor has NEON; as many costs as disparities.
#[target_feature(enable = "neon")]
pub(super) unsafe fn claim(disparity: &[i16], cost: &[u8], claims: &mut [u32]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: the caller's promise.
        let (d, c) = unsafe { (load(disparity.as_ptr().add(x)), vld1q_u8(cost.as_ptr().add(x))) };
        let [low, high] = columns(x);
        let (c_low, c_high) = (vmovl_u8(vget_low_u8(c)), vmovl_high_u8(c));
        // Costs above columns.
        let own = [
            vzip1q_u16(low, c_low),
            vzip2q_u16(low, c_low),
            vzip1q_u16(high, c_high),
            vzip2q_u16(high, c_high),
        ];
        let mut left = !bits(bytes(equal(d, INVALID)));
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize / 4];
            let same = equal(d, v);
            left &= !bits(bytes(same));
            let to = &mut claims[place(x, v)..][..BLOCK];
            let same = [
                vzip1q_u16(same[0], same[0]),
                vzip2q_u16(same[0], same[0]),
                vzip1q_u16(same[1], same[1]),
                vzip2q_u16(same[1], same[1]),
            ];
            for (to, (same, own)) in to.chunks_exact_mut(4).zip(same.into_iter().zip(own)) {
                // The others' are the largest number.
                let own = vreinterpretq_u32_u16(vornq_u16(own, same));
                // SAFETY: 4 claims.
                unsafe { vst1q_u32(to.as_mut_ptr(), vminq_u32(vld1q_u32(to.as_ptr()), own)) };
            }
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize / 4;
            left &= !(15 << (4 * i));
            scalar::claim(x + i, &disparity[x + i..][..1], &cost[x + i..][..1], claims);
        }
    }
    scalar::claim(whole, &disparity[whole..], &cost[whole..], claims);
}

/// # Safety
/// The processor has NEON.
#[target_feature(enable = "neon")]
pub(super) unsafe fn keep(claims: &[u32], most: u16, disparity: &mut [i16]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: a block of the row.
        let d = unsafe { load(disparity.as_ptr().add(x)) };
        let columns = columns(x);
        let mut lost = [vdupq_n_u16(0); 2];
        let mut left = !bits(bytes(equal(d, INVALID)));
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize / 4];
            let same = equal(d, v);
            left &= !bits(bytes(same));
            let from = &claims[place(x, v)..][..BLOCK];
            for half in 0..2 {
                // SAFETY: 8 claims of the 16, as twice as many halves.
                let (low, high) = unsafe {
                    let from = from.as_ptr().add(8 * half).cast::<u16>();
                    (vld1q_u16(from), vld1q_u16(from.add(8)))
                };
                // Columns are the low halves.
                let away = vabdq_u16(vuzp1q_u16(low, high), columns[half]);
                let far = vcgtq_u16(away, vdupq_n_u16(most));
                lost[half] = vorrq_u16(lost[half], vandq_u16(far, same[half]));
            }
        }
        for half in 0..2 {
            let kept = vbslq_s16(lost[half], vdupq_n_s16(INVALID), d[half]);
            // SAFETY: half a block of the row.
            unsafe { vst1q_s16(disparity.as_mut_ptr().add(x + 8 * half), kept) };
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize / 4;
            left &= !(15 << (4 * i));
            scalar::keep(x + i, claims, most, &mut disparity[x + i..][..1]);
        }
    }
    scalar::keep(whole, claims, most, &mut disparity[whole..]);
}

/// # Safety
/// The processor has NEON; as many costs as disparities.
#[target_feature(enable = "neon")]
pub(super) unsafe fn take(disparity: &[i16], cost: &[u8], most: u8, taken: &mut [u8]) {
    let whole = disparity.len() / BLOCK * BLOCK;
    for x in (0..whole).step_by(BLOCK) {
        // SAFETY: the caller's promise.
        let (d, c) = unsafe { (load(disparity.as_ptr().add(x)), vld1q_u8(cost.as_ptr().add(x))) };
        let good = vbicq_u8(vcleq_u8(c, vdupq_n_u8(most)), bytes(equal(d, INVALID)));
        let mut left = bits(good);
        for _ in 0..SPREAD {
            if left == 0 {
                break;
            }
            let v = disparity[x + left.trailing_zeros() as usize / 4];
            let same = vandq_u8(good, bytes(equal(d, v)));
            left &= !bits(same);
            let to = &mut taken[place(x, v)..][..BLOCK];
            // SAFETY: 16 flags.
            unsafe {
                let flags = vorrq_u8(vld1q_u8(to.as_ptr()), vshrq_n_u8::<7>(same));
                vst1q_u8(to.as_mut_ptr(), flags);
            }
        }
        while left != 0 {
            let i = left.trailing_zeros() as usize / 4;
            left &= !(15 << (4 * i));
            taken[place(x + i, disparity[x + i])] = 1;
        }
    }
    scalar::take(whole, &disparity[whole..], &cost[whole..], most, taken);
}
