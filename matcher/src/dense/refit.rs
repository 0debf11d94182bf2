//! The fit at depth steps: window pixels take part only where their disparity is near the centre's.

use super::{
    moments::{PAD, Powers},
    solve::{Fits, first_matrix, inverse_row, second_matrix},
};
use crate::{
    Level,
    lanes::{Lanes, WIDEST, dispatch},
};

/// Window rows around the output row, 2 radius + 1 each (padded rows).
pub(crate) struct Window<'a> {
    /// Squared gradients; zero where a pixel takes no part.
    pub s: &'a [&'a [f32]],
    /// q of [`super::normalise::residual_row`].
    pub q: &'a [&'a [f32]],
    /// Disparity that tells the surfaces apart; NaN where invalid.
    pub w: &'a [&'a [f32]],
    /// Largest difference from the centre's disparity, continued with the slope there if `sloped`.
    pub limit: f32,
    /// Whether `w` has fractions of a pixel, so that it has slopes.
    pub sloped: bool,
}

/// Pixels over which the slope is taken, to the side where it is less: on the other there may be a step.
const SLOPE_REACH: usize = 2;

/// Overwrites the disparities of the pixels where `flagged` (an unpadded row) is not zero.
#[allow(clippy::too_many_arguments)]
pub(crate) fn refit_row(
    level: Level,
    window: &Window<'_>,
    flagged: &[f32],
    radius: usize,
    powers: &Powers,
    len: usize,
    fits: Fits,
    out: &mut [&mut [f32]],
) {
    let padded = len + 2 * PAD;
    assert!(radius <= PAD && len.is_multiple_of(WIDEST) && flagged.len() >= len);
    for rows in [window.s, window.q, window.w] {
        assert!(rows.len() == 2 * radius + 1 && rows.iter().all(|r| r.len() >= padded));
    }
    assert!(out.iter().all(|o| o.len() >= padded));
    assert!(out.len() >= if fits == Fits::First { 1 } else { 2 });
    if fits == Fits::First {
        dispatch!(
            level,
            refit_first(
                window: &Window<'_> = window,
                flagged: &[f32] = flagged,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                out: &mut [&mut [f32]] = out,
            )
        );
    } else {
        dispatch!(
            level,
            refit_both(
                window: &Window<'_> = window,
                flagged: &[f32] = flagged,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                out: &mut [&mut [f32]] = out,
            )
        );
    }
}

#[inline(always)]
fn refit_first<V: Lanes>(
    window: &Window<'_>,
    flagged: &[f32],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    for at in (0..len).step_by(V::COUNT) {
        // SAFETY: `at + COUNT <= len`.
        let flag = V::splat(0.5).lt(unsafe { V::load(flagged.as_ptr().add(at)) });
        if !V::any(flag) {
            continue;
        }
        // SAFETY: checked by `refit_row`.
        let (s, q) = unsafe { sums::<V, 3, 2>(window, radius, powers, PAD + at) };
        let first = first_fit(&s, &q);
        // SAFETY: as above.
        unsafe { store(flag, first, out[0], PAD + at) };
    }
}

#[inline(always)]
fn refit_both<V: Lanes>(
    window: &Window<'_>,
    flagged: &[f32],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    for at in (0..len).step_by(V::COUNT) {
        // SAFETY: `at + COUNT <= len`.
        let flag = V::splat(0.5).lt(unsafe { V::load(flagged.as_ptr().add(at)) });
        if !V::any(flag) {
            continue;
        }
        // SAFETY: checked by `refit_row`.
        let (s, q) = unsafe { sums::<V, 5, 3>(window, radius, powers, PAD + at) };
        let first = first_fit(&s, &q);
        let second = second_fit(&s, &q);
        // SAFETY: as above.
        unsafe {
            store(flag, first, out[0], PAD + at);
            store(flag, second, out[1], PAD + at);
        }
    }
}

/// Radius of the window for fine shape: ridges 8 px long keep their height in it, which 9 x 9 pixels
/// do not resolve.
pub(crate) const FINE_RADIUS: usize = 2;

/// Where the difference of the two orders bends by less and by more than this, in px, the surface is
/// smooth, or finer than a window of the usual size. Between the two both windows are blended.
///
/// On a limb the difference is large as well, but changes slowly, and the usual window has half the noise.
const FINE_PX: (f32, f32) = (0.03, 0.06);
/// The frames with which that is well above noise; with fewer, it has to be more.
const FINE_FRAMES: f32 = 10.0;
/// Half the base of that bend, in px: half a ridge of the length that the usual window loses.
const BEND_REACH: usize = 4;
/// A difference that is so many times larger counts like a bend: ridges along the row do not bend in it.
const PER_BEND: f32 = 5.0;

/// Brings the second order's disparities `second` to those of a window of [`FINE_RADIUS`] where the surface
/// is finer than the usual window, which is told by how they differ from the `first` order's in so many
/// `frames`; `difference` is scratch.
///
/// `window` has the radius [`FINE_RADIUS`], `powers` are that radius's.
pub(crate) fn fine_row(
    level: Level,
    window: &Window<'_>,
    powers: &Powers,
    (len, frames): (usize, usize),
    (first, difference): (&[f32], &mut [f32]),
    second: &mut [f32],
) {
    let padded = len + 2 * PAD;
    const { assert!(FINE_RADIUS <= PAD && BEND_REACH <= PAD) };
    assert!(len.is_multiple_of(WIDEST) && first.len() >= padded && second.len() >= padded);
    for (to, (one, two)) in difference[..padded].iter_mut().zip(first.iter().zip(&*second)) {
        *to = two - one;
    }
    for rows in [window.s, window.q, window.w] {
        assert!(rows.len() == 2 * FINE_RADIUS + 1 && rows.iter().all(|r| r.len() >= padded));
    }
    let noise = (FINE_FRAMES / frames as f32).sqrt().max(1.0);
    dispatch!(
        level,
        fine_lanes(
            window: &Window<'_> = window,
            powers: &Powers = powers,
            limits: (f32, f32) = (FINE_PX.0 * noise, FINE_PX.1 * noise),
            len: usize = len,
            difference: &[f32] = &difference[..padded],
            second: &mut [f32] = second,
        )
    );
}

#[inline(always)]
fn fine_lanes<V: Lanes>(
    window: &Window<'_>,
    powers: &Powers,
    limits: (f32, f32),
    len: usize,
    difference: &[f32],
    second: &mut [f32],
) {
    let zero = V::splat(0.0);
    let low = V::splat(limits.0);
    let per = V::splat(1.0 / (limits.1 - limits.0));
    for at in (0..len).step_by(V::COUNT) {
        // SAFETY: `at + COUNT <= len`, and the rows have `PAD` on either side.
        let e = |i: usize| unsafe { V::load(difference.as_ptr().add(i)) };
        let own = e(PAD + at);
        let beside = e(PAD + at - BEND_REACH).add(e(PAD + at + BEND_REACH));
        let bend = V::splat(0.5).neg_mul_add(beside, own).abs();
        let own = own.abs().mul(V::splat(1.0 / PER_BEND));
        // Beside a gap there is no bend.
        let rough = V::select(own.lt(bend), bend, own);
        if !V::any(low.lt(rough)) {
            continue;
        }
        // SAFETY: checked by `fine_row`.
        let (s, q) = unsafe { sums::<V, 5, 3>(window, FINE_RADIUS, powers, PAD + at) };
        let fine = second_fit(&s, &q);
        // SAFETY: as above.
        let two = unsafe { V::load(second.as_ptr().add(PAD + at)) };
        let part = rough.sub(low).mul(per);
        let part = V::select(part.lt(zero), zero, part);
        let part = V::select(part.lt(V::splat(1.0)), part, V::splat(1.0));
        let blend = part.mul_add(fine.sub(two), two);
        // False where the fine window is singular.
        let known = V::splat(f32::NEG_INFINITY).lt(blend);
        // SAFETY: as above.
        unsafe { V::select(known, blend, two).store(second.as_mut_ptr().add(PAD + at)) };
    }
}

#[inline(always)]
fn second_fit<V: Lanes>(s: &[[V; 5]; 5], q: &[[V; 3]; 3]) -> V {
    let a = inverse_row(second_matrix(s));
    let slopes = a[0].mul_add(q[1][0], a[1].mul_add(q[0][1], a[5].mul(q[0][0])));
    let curves = a[3].mul_add(q[1][1], a[4].mul(q[0][2]));
    a[2].mul_add(q[2][0], slopes.add(curves))
}

#[inline(always)]
fn first_fit<V: Lanes, const K: usize, const L: usize>(s: &[[V; K]; K], q: &[[V; L]; L]) -> V {
    let a = inverse_row(first_matrix(s));
    a[0].mul_add(q[1][0], a[1].mul_add(q[0][1], a[2].mul(q[0][0])))
}

/// # Safety
/// `i + COUNT` lies within `row`.
#[inline(always)]
unsafe fn store<V: Lanes>(flag: V::Mask, value: V, row: &mut [f32], i: usize) {
    // SAFETY: the caller's promise.
    unsafe {
        let to = row.as_mut_ptr().add(i);
        V::select(flag, value, V::load(to)).store(to);
    }
}

/// Moments of S up to degree K - 1 and of q up to L - 1 over the centre's surface: `s[a][b]` is that
/// of x^a y^b.
///
/// # Safety
/// `i - radius` and `i + radius + COUNT` lie within the rows, of which there are 2 radius + 1.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn sums<V: Lanes, const K: usize, const L: usize>(
    window: &Window<'_>,
    radius: usize,
    powers: &Powers,
    i: usize,
) -> ([[V; K]; K], [[V; L]; L]) {
    let zero = V::splat(0.0);
    let limit = V::splat(window.limit);
    // SAFETY: the caller's promise, here and below.
    let load = |row: &[f32], at: usize| unsafe { V::load(row.as_ptr().add(at)) };
    let centre = load(window.w[radius], i);
    let (mut slope_x, mut slope_y) = (zero, zero);
    if window.sloped {
        let side = |other: V| {
            let slope = other.sub(centre).mul(V::splat(1.0 / SLOPE_REACH as f32));
            // Infinite where nothing is known.
            V::select(slope.abs().lt(V::splat(f32::INFINITY)), slope, V::splat(f32::INFINITY))
        };
        let less = |ahead: V, behind: V| {
            let behind = zero.sub(behind);
            let slope = V::select(ahead.abs().lt(behind.abs()), ahead, behind);
            V::select(slope.abs().lt(V::splat(f32::INFINITY)), slope, zero)
        };
        let (row, reach) = (window.w[radius], SLOPE_REACH);
        slope_x = less(side(load(row, i + reach)), side(load(row, i - reach)));
        let (below, above) = (window.w[radius + reach], window.w[radius - reach]);
        slope_y = less(side(load(below, i)), side(load(above, i)));
    }
    let (mut s, mut q) = ([[zero; K]; K], [[zero; L]; L]);
    for row in 0..2 * radius + 1 {
        let (mut sh, mut qh) = ([zero; K], [zero; L]);
        let offset = |at: usize| V::splat(at as f32 - radius as f32);
        let beside = slope_y.mul_add(offset(row), centre);
        for column in 0..2 * radius + 1 {
            let at = i - radius + column;
            let continued = slope_x.mul_add(offset(column), beside);
            let near = load(window.w[row], at).sub(continued).abs().lt(limit);
            let sv = V::select(near, load(window.s[row], at), zero);
            let qv = V::select(near, load(window.q[row], at), zero);
            for k in 0..K {
                sh[k] = sv.mul_add(V::splat(signed(powers, k, column, radius)), sh[k]);
            }
            for k in 0..L {
                qh[k] = qv.mul_add(V::splat(signed(powers, k, column, radius)), qh[k]);
            }
        }
        for a in 0..K {
            for b in 0..K - a {
                s[a][b] = sh[a].mul_add(V::splat(signed(powers, b, row, radius)), s[a][b]);
            }
        }
        for a in 0..L {
            for b in 0..L - a {
                q[a][b] = qh[a].mul_add(V::splat(signed(powers, b, row, radius)), q[a][b]);
            }
        }
    }
    (s, q)
}

/// ((at - radius) / radius)^k
#[inline(always)]
fn signed(powers: &Powers, k: usize, at: usize, radius: usize) -> f32 {
    if at >= radius {
        powers[k][at - radius]
    } else if k.is_multiple_of(2) {
        powers[k][radius - at]
    } else {
        -powers[k][radius - at]
    }
}
