//! ZNSSD's terms per pixel: from windowed sums the right image's gain and offset against the left,
//! and from them the quantity whose windowed fit is the disparity, q = S w - (1 - dw/dx) b.

use super::{gradient::SQUARE_UNIT, moments::PAD};
use crate::{
    Level,
    lanes::{Lanes, WIDEST, dispatch},
};

/// Windowed sums of a row (padded rows); those of squares in [`SQUARE_UNIT`].
pub(crate) struct Windowed<'a> {
    /// Valid pixels.
    pub n: &'a [f32],
    /// Sum of left grey values.
    pub l: &'a [f32],
    /// Sum of their squares.
    pub ll: &'a [f32],
    /// Sum of warped right grey values.
    pub g: &'a [f32],
    /// Sum of their squares.
    pub gg: &'a [f32],
}

/// Variance below which a window counts as dark, per sample in (1/16 grey level)^2.
const DARK: f32 = 16.0;

/// Writes ratio = norm(L) / norm(g) and offset = mean L - ratio mean g per pixel, in padded rows;
/// means are per frame sum, hence `frames`.
pub(crate) fn gain_row(
    level: Level,
    windowed: &Windowed<'_>,
    frames: usize,
    len: usize,
    ratio: &mut [f32],
    offset: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST));
    for row in [windowed.n, windowed.l, windowed.ll, windowed.g, windowed.gg] {
        assert!(row.len() >= padded);
    }
    assert!(ratio.len() >= padded && offset.len() >= padded);
    dispatch!(
        level,
        gain_lanes(
            windowed: &Windowed<'_> = windowed,
            frames: f32 = frames as f32,
            len: usize = len,
            ratio: &mut [f32] = ratio,
            offset: &mut [f32] = offset,
        )
    );
}

#[inline(always)]
fn gain_lanes<V: Lanes>(
    windowed: &Windowed<'_>,
    frames: f32,
    len: usize,
    ratio: &mut [f32],
    offset: &mut [f32],
) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values.
        let load = |row: &[f32]| unsafe { V::load(row.as_ptr().add(i)) };
        let unit = V::splat(SQUARE_UNIT);
        let (n, l, ll) = (load(windowed.n), load(windowed.l), load(windowed.ll).mul(unit));
        let (g, gg) = (load(windowed.g), load(windowed.gg).mul(unit));
        let samples = n.mul(V::splat(frames));
        let some = V::splat(0.5).lt(n);
        let per = V::splat(1.0).div(V::select(some, samples, V::splat(1.0)));
        let (mean_l, mean_g) = (l.mul(per), g.mul(per));
        let var_l = mean_l.neg_mul_add(l, ll);
        let var_g = mean_g.neg_mul_add(g, gg);
        let floor = samples.mul(V::splat(DARK));
        let lit = V::both(V::both(floor.lt(var_l), floor.lt(var_g)), some);
        let quotient = var_l.div(V::select(lit, var_g, V::splat(1.0)));
        let r = V::select(lit, quotient, V::splat(1.0)).sqrt();
        // SAFETY: as above.
        unsafe {
            r.store(ratio.as_mut_ptr().add(i));
            r.neg_mul_add(mean_g, mean_l).store(offset.as_mut_ptr().add(i));
        }
    }
}

/// The per-pixel terms of [`residual_row`], in padded rows.
pub(crate) struct Terms<'a> {
    /// Sum of squared gradients, zero where the pixel does not take part.
    pub s: &'a [f32],
    /// Sum of gradient times left grey value.
    pub il: &'a [f32],
    /// Sum of gradients.
    pub i: &'a [f32],
    /// Sum of gradient times warped right grey value.
    pub ig: &'a [f32],
    /// Gain.
    pub ratio: &'a [f32],
    /// Offset.
    pub offset: &'a [f32],
    /// Disparity of the warp, rounded as the warp did.
    pub at: &'a [f32],
    /// One where the warp is valid.
    pub valid: &'a [f32],
    /// Disparity before rounding, for its slope; NaN where invalid.
    pub w: &'a [f32],
    /// Half the base over which the slope is taken.
    pub base: usize,
    /// Slopes that rise more than this over the base are steps, and taken as zero.
    pub step: f32,
    /// What is subtracted from disparities for precision.
    pub origin: f32,
}

/// Writes q = S (w - origin) - (1 - dw/dx) b to a padded row, with
/// b = sum I (L - mean L) - ratio sum I (g - mean g). Where the warp is not valid, b counts as zero.
pub(crate) fn residual_row(level: Level, terms: &Terms<'_>, len: usize, q: &mut [f32]) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST) && terms.base <= PAD && q.len() >= padded);
    for row in [terms.s, terms.il, terms.i, terms.ig, terms.ratio, terms.offset] {
        assert!(row.len() >= padded);
    }
    for row in [terms.at, terms.valid, terms.w] {
        assert!(row.len() >= padded);
    }
    dispatch!(
        level,
        residual_lanes(
            terms: &Terms<'_> = terms,
            len: usize = len,
            q: &mut [f32] = q,
        )
    );
}

#[inline(always)]
fn residual_lanes<V: Lanes>(terms: &Terms<'_>, len: usize, q: &mut [f32]) {
    let zero = V::splat(0.0);
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values and the base is at most PAD.
        let load = |row: &[f32], at: usize| unsafe { V::load(row.as_ptr().add(at)) };
        let (s, valid) = (load(terms.s, i), V::splat(0.5).lt(load(terms.valid, i)));
        let rise = load(terms.w, i + terms.base).sub(load(terms.w, i - terms.base));
        let gentle = rise.abs().lt(V::splat(terms.step));
        let slope = V::select(gentle, rise.mul(V::splat(0.5 / terms.base as f32)), zero);
        let residual = load(terms.offset, i).neg_mul_add(
            load(terms.i, i),
            load(terms.ratio, i).neg_mul_add(load(terms.ig, i), load(terms.il, i)),
        );
        let b = V::select(valid, residual, zero);
        let w = V::select(valid, load(terms.at, i), load(terms.w, i));
        let from = w.sub(V::splat(terms.origin)).mul(s);
        let value = V::splat(1.0).sub(slope).neg_mul_add(b, from);
        let used = zero.lt(s);
        // SAFETY: as above.
        unsafe { V::select(used, value, zero).store(q.as_mut_ptr().add(i)) };
    }
}

/// ZNCC of a row from the windowed sums, with `lg` that of the products; NaN where dark.
pub(crate) fn zncc_row(
    level: Level,
    windowed: &Windowed<'_>,
    lg: &[f32],
    frames: usize,
    len: usize,
    zncc: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST) && lg.len() >= padded && zncc.len() >= padded);
    for row in [windowed.n, windowed.l, windowed.ll, windowed.g, windowed.gg] {
        assert!(row.len() >= padded);
    }
    dispatch!(
        level,
        zncc_lanes(
            windowed: &Windowed<'_> = windowed,
            lg: &[f32] = lg,
            frames: f32 = frames as f32,
            len: usize = len,
            zncc: &mut [f32] = zncc,
        )
    );
}

#[inline(always)]
fn zncc_lanes<V: Lanes>(
    windowed: &Windowed<'_>,
    lg: &[f32],
    frames: f32,
    len: usize,
    zncc: &mut [f32],
) {
    let one = V::splat(1.0);
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values.
        let load = |row: &[f32]| unsafe { V::load(row.as_ptr().add(i)) };
        let unit = V::splat(SQUARE_UNIT);
        let (n, l, ll) = (load(windowed.n), load(windowed.l), load(windowed.ll).mul(unit));
        let (g, gg, lg) = (load(windowed.g), load(windowed.gg).mul(unit), load(lg).mul(unit));
        let samples = n.mul(V::splat(frames));
        let some = V::splat(0.5).lt(n);
        let per = one.div(V::select(some, samples, one));
        let covariance = l.mul(per).neg_mul_add(g, lg);
        let var_l = l.mul(per).neg_mul_add(l, ll);
        let var_g = g.mul(per).neg_mul_add(g, gg);
        let floor = samples.mul(V::splat(DARK));
        let lit = V::both(V::both(floor.lt(var_l), floor.lt(var_g)), some);
        let norms = V::select(lit, var_l, one).sqrt().mul(V::select(lit, var_g, one).sqrt());
        let value = V::select(lit, covariance.div(norms), V::splat(f32::NAN));
        // SAFETY: as above.
        unsafe { V::select(one.lt(value), one, value).store(zncc.as_mut_ptr().add(i)) };
    }
}

/// out = a b, padded rows.
pub(crate) fn product_row(level: Level, a: &[f32], b: &[f32], len: usize, out: &mut [f32]) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST));
    assert!(a.len() >= padded && b.len() >= padded && out.len() >= padded);
    dispatch!(
        level,
        product_lanes(
            a: &[f32] = a,
            b: &[f32] = b,
            len: usize = len,
            out: &mut [f32] = out,
        )
    );
}

#[inline(always)]
fn product_lanes<V: Lanes>(a: &[f32], b: &[f32], len: usize, out: &mut [f32]) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: rows hold `len + 2 PAD` values.
        unsafe {
            let v = V::load(a.as_ptr().add(i)).mul(V::load(b.as_ptr().add(i)));
            v.store(out.as_mut_ptr().add(i));
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
