//! Plain Rust, from column `x` on: other levels' rows end with it.

use super::place;
use crate::coarse::INVALID;

pub(super) fn claim(x: usize, disparity: &[i16], cost: &[u8], claims: &mut [u32]) {
    for (x, (&d, &c)) in (x..).zip(disparity.iter().zip(cost)) {
        if d != INVALID {
            let to = &mut claims[place(x, d)];
            *to = (*to).min(u32::from(c) << 16 | x as u32);
        }
    }
}

pub(super) fn keep(x: usize, claims: &[u32], most: u16, disparity: &mut [i16]) {
    for (x, d) in (x..).zip(disparity).filter(|(_, d)| **d != INVALID) {
        *d = if far(claims, most, x, *d) { INVALID } else { *d };
    }
}

/// Whether the owner of a pixel's right pixel is far away.
#[inline(always)]
pub(super) fn far(claims: &[u32], most: u16, x: usize, disparity: i16) -> bool {
    let owner = claims[place(x, disparity)] as u16;
    owner.abs_diff(x as u16) > most
}

pub(super) fn take(x: usize, disparity: &[i16], cost: &[u8], most: u8, taken: &mut [u8]) {
    for (x, (&d, &c)) in (x..).zip(disparity.iter().zip(cost)) {
        if d != INVALID && c <= most {
            taken[place(x, d)] = 1;
        }
    }
}
