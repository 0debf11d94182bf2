//! ZNSSD's terms per pixel: from windowed sums the right image's gain and offset against the left,
//! and from them the quantity whose windowed fit is the disparity, q = S w - (1 - dw/dx) b.

use super::{gradient::SQUARE_UNIT, moments::PAD};
use crate::{
    Level,
    lanes::{Lanes, WIDEST, dispatch},
};

/// Variance below which a window counts as dark, per sample in (1/16 grey level)^2.
const DARK: f32 = 16.0;

/// What is known of the left images in a row's windows, for both passes (padded rows).
pub(crate) struct LeftWindows<'a> {
    /// One over the number of samples.
    pub per: &'a [f32],
    /// Mean grey value.
    pub mean: &'a [f32],
    /// Sum of squared differences from it; zero where dark.
    pub variance: &'a [f32],
}

/// Brings windowed sums, of valid pixels, of left grey values and of their squares (in
/// [`SQUARE_UNIT`]), to what [`LeftWindows`] has, in place. The sums are over `frames` frames.
pub(crate) fn left_row(level: Level, [n, l, ll]: [&mut [f32]; 3], frames: usize, len: usize) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST));
    assert!(n.len() >= padded && l.len() >= padded && ll.len() >= padded);
    dispatch!(
        level,
        left_lanes(
            n: &mut [f32] = n,
            l: &mut [f32] = l,
            ll: &mut [f32] = ll,
            frames: f32 = frames as f32,
            len: usize = len,
        )
    );
}

#[inline(always)]
fn left_lanes<V: Lanes>(n: &mut [f32], l: &mut [f32], ll: &mut [f32], frames: f32, len: usize) {
    let (zero, one) = (V::splat(0.0), V::splat(1.0));
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values.
        let load = |row: &[f32]| unsafe { V::load(row.as_ptr().add(i)) };
        let (count, sum) = (load(n), load(l));
        let some = V::splat(0.5).lt(count);
        let samples = count.mul(V::splat(frames));
        let per = V::select(some, samples, one).reciprocal();
        let mean = sum.mul(per);
        let variance = mean.neg_mul_add(sum, load(ll).mul(V::splat(SQUARE_UNIT)));
        let lit = V::both(some, samples.mul(V::splat(DARK)).lt(variance));
        // SAFETY: as above.
        unsafe {
            per.store(n.as_mut_ptr().add(i));
            mean.store(l.as_mut_ptr().add(i));
            V::select(lit, variance, zero).store(ll.as_mut_ptr().add(i));
        }
    }
}

/// What a pass sums of the right images, in padded rows; squares and products of grey values in
/// [`SQUARE_UNIT`].
pub(crate) struct Right<'a> {
    /// Windowed sum of warped grey values.
    pub g: &'a [f32],
    /// Of their squares.
    pub gg: &'a [f32],
    /// Sum of gradient times warped grey value, of the pixel alone as all below.
    pub ig: &'a [f32],
    /// Disparity of the warp, rounded as the warp did.
    pub at: &'a [f32],
    /// One where the warp is valid.
    pub valid: &'a [f32],
}

/// What both passes have of a pixel in common, in padded rows.
pub(crate) struct Terms<'a> {
    /// Sum of squared gradients, zero where the pixel does not take part.
    pub s: &'a [f32],
    /// Sum of gradient times left grey value.
    pub il: &'a [f32],
    /// Sum of gradients.
    pub i: &'a [f32],
    /// Disparity before rounding, for its slope; NaN where invalid.
    pub w: &'a [f32],
    /// Half the base over which the slope is taken.
    pub base: usize,
    /// Slopes that rise more than this over the base are steps, and taken as zero.
    pub step: f32,
    /// What is subtracted from disparities for precision.
    pub origin: f32,
}

/// What the second pass gives besides.
pub(crate) struct Besides<'a> {
    /// Windowed sums of products of grey values.
    pub lg: &'a [f32],
    /// The ZNCC made of them; NaN where dark.
    pub zncc: &'a mut [f32],
    /// Where motion is looked for.
    pub timed: Option<TimedTerms<'a>>,
}

/// q of gradients that are weighted by time, from sums that hold one weighted gradient each.
pub(crate) struct TimedTerms<'a> {
    /// Sum of weighted gradient times gradient.
    pub s: &'a [f32],
    pub il: &'a [f32],
    pub i: &'a [f32],
    pub ig: &'a [f32],
    /// Zero where the warp is not valid.
    pub q: &'a mut [f32],
}

/// Writes q = S (w - origin) - (1 - dw/dx) b to a padded row, with
/// b = sum I (L - mean L) - ratio sum I (g - mean g), ratio = norm(L) / norm(g) of the pixel's window.
/// Where the warp is not valid, b counts as zero.
pub(crate) fn normalise_row(
    level: Level,
    left: &LeftWindows<'_>,
    right: &Right<'_>,
    terms: &Terms<'_>,
    len: usize,
    q: &mut [f32],
    besides: Option<Besides<'_>>,
) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST) && terms.base <= PAD && q.len() >= padded);
    for row in [left.per, left.mean, left.variance, terms.s, terms.il, terms.i, terms.w] {
        assert!(row.len() >= padded);
    }
    for row in [right.g, right.gg, right.ig, right.at, right.valid] {
        assert!(row.len() >= padded);
    }
    assert!(besides.as_ref().is_none_or(|b| b.lg.len() >= padded && b.zncc.len() >= padded));
    if let Some(t) = besides.as_ref().and_then(|b| b.timed.as_ref()) {
        assert!([t.s, t.il, t.i, t.ig, &t.q[..]].iter().all(|row| row.len() >= padded));
    }
    dispatch!(
        level,
        normalise_lanes(
            left: &LeftWindows<'_> = left,
            right: &Right<'_> = right,
            terms: &Terms<'_> = terms,
            len: usize = len,
            q: &mut [f32] = q,
            besides: Option<Besides<'_>> = besides,
        )
    );
}

#[inline(always)]
fn normalise_lanes<V: Lanes>(
    left: &LeftWindows<'_>,
    right: &Right<'_>,
    terms: &Terms<'_>,
    len: usize,
    q: &mut [f32],
    besides: Option<Besides<'_>>,
) {
    match besides {
        None => {
            let none = Besides { lg: &[], zncc: &mut [], timed: None };
            normalise_with::<V, false, false>(left, right, terms, len, q, none);
        }
        Some(besides) if besides.timed.is_none() => {
            normalise_with::<V, true, false>(left, right, terms, len, q, besides);
        }
        Some(besides) => {
            normalise_with::<V, true, true>(left, right, terms, len, q, besides);
        }
    }
}

#[inline(always)]
fn normalise_with<V: Lanes, const ZNCC: bool, const TIMED: bool>(
    left: &LeftWindows<'_>,
    right: &Right<'_>,
    terms: &Terms<'_>,
    len: usize,
    q: &mut [f32],
    mut besides: Besides<'_>,
) {
    let (zero, one, unit) = (V::splat(0.0), V::splat(1.0), V::splat(SQUARE_UNIT));
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values and the base is at most PAD.
        let load = |row: &[f32], at: usize| unsafe { V::load(row.as_ptr().add(at)) };
        let (per, mean, variance) = (load(left.per, i), load(left.mean, i), load(left.variance, i));
        let g = load(right.g, i);
        let mean_g = g.mul(per);
        let variance_g = mean_g.neg_mul_add(g, load(right.gg, i).mul(unit));
        let lit = V::both(zero.lt(variance), V::splat(DARK).lt(variance_g.mul(per)));
        // One over the product of both norms gives their ratio, and the similarity.
        let scale = V::select(lit, variance.mul(variance_g), one).reciprocal_sqrt();
        let ratio = V::select(lit, variance.mul(scale), one);
        let offset = ratio.neg_mul_add(mean_g, mean);
        if ZNCC {
            let covariance = mean.neg_mul_add(g, load(besides.lg, i).mul(unit));
            let value = V::select(lit, covariance.mul(scale), V::splat(f32::NAN));
            let value = V::select(one.lt(value), one, value);
            // SAFETY: as above.
            unsafe { value.store(besides.zncc.as_mut_ptr().add(i)) };
        }
        let (s, valid) = (load(terms.s, i), V::splat(0.5).lt(load(right.valid, i)));
        let rise = load(terms.w, i + terms.base).sub(load(terms.w, i - terms.base));
        let gentle = rise.abs().lt(V::splat(terms.step));
        let slope = V::select(gentle, rise.mul(V::splat(0.5 / terms.base as f32)), zero);
        let residual = offset
            .neg_mul_add(load(terms.i, i), ratio.neg_mul_add(load(right.ig, i), load(terms.il, i)));
        let b = V::select(valid, residual, zero);
        let w = V::select(valid, load(right.at, i), load(terms.w, i));
        let from = w.sub(V::splat(terms.origin)).mul(s);
        let value = one.sub(slope).neg_mul_add(b, from);
        let used = zero.lt(s);
        // SAFETY: as above.
        unsafe { V::select(used, value, zero).store(q.as_mut_ptr().add(i)) };
        if TIMED && let Some(timed) = &mut besides.timed {
            let residual = offset.neg_mul_add(
                load(timed.i, i),
                ratio.neg_mul_add(load(timed.ig, i), load(timed.il, i)),
            );
            let from = w.sub(V::splat(terms.origin)).mul(load(timed.s, i));
            let value = V::select(valid, one.sub(slope).neg_mul_add(residual, from), zero);
            // SAFETY: as above.
            unsafe { value.store(timed.q.as_mut_ptr().add(i)) };
        }
    }
}

/// The static sums of pixels whose first warp is valid, zero elsewhere: `out` = `sums` times `valid`,
/// padded rows.
pub(crate) fn used_row(
    level: Level,
    valid: &[f32],
    sums: [&[f32]; 3],
    len: usize,
    out: [&mut [f32]; 3],
) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST) && valid.len() >= padded);
    assert!(sums.iter().all(|r| r.len() >= padded) && out.iter().all(|r| r.len() >= padded));
    dispatch!(
        level,
        used_lanes(
            valid: &[f32] = valid,
            sums: [&[f32]; 3] = sums,
            len: usize = len,
            out: [&mut [f32]; 3] = out,
        )
    );
}

#[inline(always)]
fn used_lanes<V: Lanes>(valid: &[f32], sums: [&[f32]; 3], len: usize, out: [&mut [f32]; 3]) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values.
        unsafe {
            let valid = V::load(valid.as_ptr().add(i));
            for k in 0..3 {
                V::load(sums[k].as_ptr().add(i)).mul(valid).store(out[k].as_mut_ptr().add(i));
            }
        }
    }
}

/// The first fit as the next start: `fit` + origin where it is within `reach` of the start `w0`,
/// else `w0`.
pub(crate) fn restart_row(
    level: Level,
    fit: &[f32],
    w0: &[f32],
    (origin, reach): (f32, f32),
    len: usize,
    w1: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST));
    assert!(fit.len() >= padded && w0.len() >= padded && w1.len() >= padded);
    dispatch!(
        level,
        restart_lanes(
            fit: &[f32] = fit,
            w0: &[f32] = w0,
            origin: f32 = origin,
            reach: f32 = reach,
            len: usize = len,
            w1: &mut [f32] = w1,
        )
    );
}

#[inline(always)]
fn restart_lanes<V: Lanes>(
    fit: &[f32],
    w0: &[f32],
    origin: f32,
    reach: f32,
    len: usize,
    w1: &mut [f32],
) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values.
        unsafe {
            let start = V::load(w0.as_ptr().add(i));
            let found = V::load(fit.as_ptr().add(i)).add(V::splat(origin));
            let near = found.sub(start).abs().lt(V::splat(reach));
            V::select(near, found, start).store(w1.as_mut_ptr().add(i));
        }
    }
}
