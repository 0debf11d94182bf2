//! The kernels, written once for every width of vector.

// Indices run over several arrays at once, as in the formulas.
#![allow(clippy::needless_range_loop)]

use std::mem::MaybeUninit;

use super::{Constants, Reference, WarpSums, lanes::Lanes};
use crate::{
    bspline::{LANES, TAPS_MAX},
    icgn::{
        prepare::{MARGIN, Prepared, SUMS, Sum},
        window::{PIXELS_MAX, Place, Window},
    },
};

/// Warps the right stack by the shape function's parameters `t` (u relative to the place's column)
/// and correlates it with the left one. K: parameters used, 3 or 6.
///
/// # Safety
/// The window fits about the place ([`Window::fits`]), the place was made by [`Place::new`] for this
/// `prepared`, and `t` is finite.
#[inline(always)]
pub(super) unsafe fn warp_sums<V: Lanes, const TAPS: usize, const K: usize>(
    prepared: &Prepared,
    window: &Window,
    place: Place,
    t: [f32; 6],
    constants: &Constants,
) -> WarpSums {
    let mut column = [const { MaybeUninit::<i32>::uninit() }; PIXELS_MAX];
    let mut weights = [const { MaybeUninit::<f32>::uninit() }; TAPS_MAX * PIXELS_MAX];
    let (column, weights) = (column.as_mut_ptr().cast::<i32>(), weights.as_mut_ptr().cast::<f32>());
    // Positions and spline weights, a vector of pixels at a time.
    for p in (0..window.padded()).step_by(V::N) {
        // SAFETY: p + V::N is at most `padded`, at most PIXELS_MAX; positions are clamped to the
        // image's width.
        unsafe {
            let phi = |k: usize| V::load(window.phi[k].as_ptr().add(p));
            let mut at = phi(1).add(V::splat(t[0]));
            for k in 1..K {
                at = phi(k).mul_add(V::splat(t[k]), at);
            }
            at = at.max(V::splat(place.limits.0)).min(V::splat(place.limits.1));
            let whole = at.floor();
            let fraction = at.sub(whole);
            whole.mul(V::splat(LANES as f32)).store_whole(column.add(p));
            for tap in 0..TAPS {
                let mut weight = V::splat(constants.polynomials[TAPS - 1][tap]);
                for power in (0..TAPS - 1).rev() {
                    weight = weight.mul_add(fraction, V::splat(constants.polynomials[power][tap]));
                }
                weight.store(weights.add(tap * PIXELS_MAX + p));
            }
        }
    }
    let mut sums = WarpSums::default();
    for first in (0..prepared.frames).step_by(V::N) {
        let zero = V::splat(0.0);
        let (mut g1, mut g2, mut lg) = (zero, zero, zero);
        let mut ig = [zero; K];
        for p in 0..window.count {
            // SAFETY: the window fits, so its pixels are inside the left arrays; right columns are
            // clamped to one pixel beyond the image, and TAPS / 2 more are inside the margins. Columns
            // and weights of all `count` pixels were written above.
            unsafe {
                let left = (place.left + first).wrapping_add_signed(window.left_at[p] as isize);
                let right = (place.right + first - (TAPS / 2 - 1) * LANES)
                    .wrapping_add_signed(window.right_at[p] as isize + *column.add(p) as isize);
                let right = prepared.right.as_ptr().add(right);
                let mut g = V::load(right).mul(V::splat(*weights.add(p)));
                for tap in 1..TAPS {
                    let c = V::load(right.add(tap * LANES));
                    g = c.mul_add(V::splat(*weights.add(tap * PIXELS_MAX + p)), g);
                }
                g1 = g1.add(g);
                g2 = g.mul_add(g, g2);
                lg = V::load(prepared.left.as_ptr().add(left)).mul_add(g, lg);
                let product = V::load(prepared.gradient.as_ptr().add(left)).mul(g);
                ig[0] = ig[0].add(product);
                for k in 1..K {
                    ig[k] = product.mul_add(V::splat(window.phi[k][p]), ig[k]);
                }
            }
        }
        sums.g += g1.sum();
        sums.gg += g2.sum();
        sums.lg += lg.sum();
        for k in 0..K {
            sums.ig[k] += ig[k].sum();
        }
    }
    sums
}

/// Columns' powers: `POWERS[a][lane]` has to be shifted by the radius, see [`reference`].
const fn powers(radius: usize) -> [[f32; LANES]; 5] {
    let mut table = [[1f32; LANES]; 5];
    let mut a = 1;
    while a < 5 {
        let mut lane = 0;
        while lane < LANES {
            table[a][lane] = table[a - 1][lane] * (lane as f32 - radius as f32);
            lane += 1;
        }
        a += 1;
    }
    table
}

static POWERS: [[[f32; LANES]; 5]; 8] =
    [powers(0), powers(1), powers(2), powers(3), powers(4), powers(5), powers(6), powers(7)];

/// Sums over the reference subset about (x, y).
///
/// # Safety
/// The window fits about (x, y).
#[inline(always)]
pub(super) unsafe fn reference<V: Lanes, const K: usize>(
    prepared: &Prepared,
    window: &Window,
    x: usize,
    y: usize,
) -> Reference {
    let order = if K == 3 { 1 } else { 2 };
    let zero = V::splat(0.0);
    // moments[b][a]: sum of I^2 x^a y^b.
    let mut moments = [[zero; 5]; 5];
    let (mut il, mut i1) = ([[zero; 3]; 3], [[zero; 3]; 3]);
    let (mut l1, mut l2) = (zero, zero);
    let powers = &POWERS[window.radius];
    let pitch = prepared.sums_pitch();
    for row in 0..2 * window.radius + 1 {
        let dy = row as f32 - window.radius as f32;
        let row_at = (MARGIN + y + row - window.radius) * SUMS * pitch + MARGIN + x - window.radius;
        for lane in (0..2 * window.radius + 1).step_by(V::N) {
            // SAFETY: the window's rows are inside the margins, and the array has LANES values of
            // slack after its last row.
            let load = |sum: Sum| unsafe {
                V::load(prepared.sums.as_ptr().add(row_at + sum as usize * pitch + lane))
            };
            // SAFETY: LANES is a multiple of V::N.
            let mask = unsafe { V::load(window.mask[row].as_ptr().add(lane)) };
            // SAFETY: as above.
            let power = |a: usize| unsafe { V::load(powers[a].as_ptr().add(lane)) };
            let add = |to: &mut [[V; 3]; 3], value: V| {
                for a in 0..=order {
                    let value = if a == 0 { value } else { value.mul(power(a)) };
                    let mut factor = 1.0;
                    for b in 0..=order - a {
                        to[b][a] = value.mul_add(V::splat(factor), to[b][a]);
                        factor *= dy;
                    }
                }
            };
            let ii = load(Sum::II).mul(mask);
            for a in 0..=2 * order {
                let value = if a == 0 { ii } else { ii.mul(power(a)) };
                let mut factor = 1.0;
                for b in 0..=2 * order - a {
                    moments[b][a] = value.mul_add(V::splat(factor), moments[b][a]);
                    factor *= dy;
                }
            }
            add(&mut il, load(Sum::IL).mul(mask));
            add(&mut i1, load(Sum::I).mul(mask));
            l1 = load(Sum::L).mul_add(mask, l1);
            l2 = load(Sum::LL).mul_add(mask, l2);
        }
    }
    // Exponents and factor of each derivative of the shape function.
    const PHI: [(usize, usize, f64); 6] =
        [(0, 0, 1.0), (1, 0, 1.0), (0, 1, 1.0), (2, 0, 0.5), (0, 2, 0.5), (1, 1, 1.0)];
    let mut sums = [[0f64; 5]; 5];
    for a in 0..=2 * order {
        for b in 0..=2 * order - a {
            sums[b][a] = moments[b][a].sum() as f64;
        }
    }
    let mut reference =
        Reference { l: l1.sum() as f64, ll: l2.sum() as f64, ..Reference::default() };
    for k in 0..K {
        let (a, b, c) = PHI[k];
        reference.il[k] = c * il[b][a].sum() as f64;
        reference.i[k] = c * i1[b][a].sum() as f64;
        for j in 0..=k {
            let (a2, b2, c2) = PHI[j];
            reference.hessian[k][j] = c * c2 * sums[b + b2][a + a2];
        }
    }
    reference
}
