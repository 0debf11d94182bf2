//! Plain Rust.

use super::{BLOCK, Row};
use crate::rectify::kernel::{PHASE_BITS, PHASES, TAPS};

fn finish(products: impl Iterator<Item = i32>, shift: u32) -> i16 {
    let sum = (1_i32 << (shift - 1)) + products.sum::<i32>();
    (sum >> shift).clamp(i32::from(i16::MIN), i32::from(i16::MAX)) as i16
}

/// First sample and phase of output `k`.
fn place(row: Row<'_>, k: usize) -> (usize, usize) {
    let offset = usize::from(row.offsets[k]);
    (row.blocks[k / BLOCK].first as usize + (offset >> PHASE_BITS), offset % PHASES)
}

pub(super) fn along(line: &[i16], row: Row<'_>, taps: &[[i16; TAPS]], shift: u32, out: &mut [i16]) {
    for (k, out) in out.iter_mut().enumerate() {
        let (first, phase) = place(row, k);
        let pairs = line[first..].iter().zip(&taps[phase]);
        *out = finish(pairs.map(|(s, t)| i32::from(*s) * i32::from(*t)), shift);
    }
}

pub(super) fn across(
    lines: &[i16],
    stride: usize,
    row: Row<'_>,
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    for (k, out) in out.iter_mut().enumerate() {
        let (first, phase) = place(row, k);
        let column = lines[first * stride + k..].iter().step_by(stride);
        let pairs = column.zip(&taps[phase]);
        *out = finish(pairs.map(|(s, t)| i32::from(*s) * i32::from(*t)), shift);
    }
}
