//! Plain Rust.

use std::ops::Range;

use super::{Source, Warped, position};
use crate::dense::{gradient::SQUARE_SHIFT, kernels::Kernels};

fn square(sum: i32) -> f32 {
    (sum.wrapping_add(1 << (SQUARE_SHIFT - 1)) >> SQUARE_SHIFT) as f32
}

pub(super) fn pixels(
    kernels: &Kernels,
    source: &Source<'_>,
    range: Range<usize>,
    out: &mut Warped<'_>,
) {
    let width = source.right[0].len();
    for i in range {
        let (mut ig, mut g1, mut gg, mut lg, mut igt) = (0i32, 0i32, 0i32, 0i32, 0i32);
        let place = position(source.x0 + i, source.w[i], width);
        if let Some((_, first, phase)) = place {
            let taps = &kernels.taps[phase];
            for (pair, rows) in source.right.chunks_exact(2).enumerate() {
                let word = pair * source.stride + i;
                for (half, row) in rows.iter().enumerate() {
                    let sum: i32 = row[first..first + 8]
                        .iter()
                        .zip(taps)
                        .map(|(&v, &c)| i32::from(v) * i32::from(c))
                        .fold(0x8000, i32::wrapping_add);
                    let g = sum >> 16;
                    let of =
                        |word: i32| if half == 0 { i32::from(word as i16) } else { word >> 16 };
                    ig = ig.wrapping_add(of(source.gradient[word]) * g);
                    if let Some(timed) = &out.timed {
                        igt = igt.wrapping_add(of(timed.gradient[word]) * g);
                    }
                    lg = lg.wrapping_add(of(source.grey[word]) * g);
                    g1 = g1.wrapping_add(g);
                    gg = gg.wrapping_add(g * g);
                }
            }
        }
        out.at[i] = place.map_or(0.0, |p| p.0);
        out.valid[i] = if place.is_some() { 1.0 } else { 0.0 };
        out.ig[i] = ig as f32;
        out.g[i] = g1 as f32;
        out.gg[i] = square(gg);
        if let Some(out) = &mut out.lg {
            out[i] = square(lg);
        }
        if let Some(timed) = &mut out.timed {
            timed.ig[i] = igt as f32;
        }
    }
}
