//! Plain Rust.

use std::ops::Range;

use super::{REACH, SQUARE_SHIFT, Static};
use crate::{Sample, dense::kernels::Kernels};

/// Rounded product of fractions in 1/2^15, as `pmulhrsw` and `sqrdmulh` give it.
#[inline(always)]
fn round_product(a: i16, b: i16) -> i16 {
    ((i32::from(a) * i32::from(b) + 0x4000) >> 15) as i16
}

pub(super) fn pixels(
    kernels: &Kernels,
    left: &[&[Sample]],
    x0: usize,
    range: Range<usize>,
    out: &mut Static<'_>,
) {
    let width = left[0].len();
    for at in range {
        let x = x0 + at;
        if x >= width {
            for pair in 0..left.len() / 2 {
                out.gradient[pair * out.stride + at] = 0;
                out.grey[pair * out.stride + at] = 0;
            }
            for map in [&mut out.s, &mut out.il, &mut out.i, &mut out.l, &mut out.ll] {
                map[at] = 0.0;
            }
            continue;
        }
        let (mut s, mut il, mut i1, mut l1, mut ll) = (0i32, 0i32, 0i32, 0i32, 0i32);
        for (pair, rows) in left.chunks_exact(2).enumerate() {
            let mut both = [(0i16, 0i16); 2];
            for (row, (g, l)) in rows.iter().zip(&mut both) {
                *l = row.get(x).map_or(0, |&v| round_product(v, 8192));
                if x >= REACH && x + REACH < width {
                    for (k, &c) in kernels.gradient.iter().enumerate() {
                        let slope = row[x + k + 1].saturating_sub(row[x - k - 1]);
                        *g = g.wrapping_add(round_product(slope, c));
                    }
                }
                let (gw, lw) = (i32::from(*g), i32::from(*l));
                s = s.wrapping_add(gw * gw);
                il = il.wrapping_add(gw * lw);
                i1 = i1.wrapping_add(gw);
                l1 = l1.wrapping_add(lw);
                ll = ll.wrapping_add(lw * lw);
            }
            let join = |lo: i16, hi: i16| i32::from(lo as u16) | i32::from(hi) << 16;
            out.gradient[pair * out.stride + at] = join(both[0].0, both[1].0);
            out.grey[pair * out.stride + at] = join(both[0].1, both[1].1);
        }
        out.s[at] = s as f32;
        out.il[at] = il as f32;
        out.i[at] = i1 as f32;
        out.l[at] = l1 as f32;
        out.ll[at] = (ll.wrapping_add(1 << (SQUARE_SHIFT - 1)) >> SQUARE_SHIFT) as f32;
    }
}
