//! The fit: the first row of M^-1 from the moments of S, and the disparity from the moments of q.

use super::moments::{PAD, Powers, vertical};
use crate::{
    Level,
    lanes::{Lanes, WIDEST, dispatch},
};

/// Rows of horizontal moments around an output row: `rows[k]` holds 2 radius + 1 padded rows of the
/// k-th moment.
pub(crate) type MomentRows<'a, const K: usize> = [&'a [&'a [f32]]; K];

/// Parameters of the first-order fit that are stored: those of 1, x, y.
pub(crate) const FIRST: usize = 3;
/// Of the second-order fit: 1, x, y, x^2, xy, y^2.
pub(crate) const SECOND: usize = 6;
/// A pivot below this part of its diagonal makes the window singular.
const SINGULAR: f32 = 1e-4;

/// First row of the inverse of a symmetric positive `m`, whose *last* variable is the constant: the
/// solution of m a = e_last by L D L^T, in which the forward substitution falls away. NaN where
/// singular.
#[inline(always)]
pub(crate) fn inverse_row<V: Lanes, const N: usize>(mut m: [[V; N]; N]) -> [V; N] {
    let zero = V::splat(0.0);
    let mut good = V::splat(-1.0).lt(zero);
    let mut a = [zero; N];
    for k in 0..N {
        // At this point m[k][k] is the pivot; the strict lower part keeps the columns of L.
        let diagonal = m[k][k];
        let mut pivot = diagonal;
        for j in 0..k {
            // m[j][k] holds L[k][j] D[j].
            pivot = m[k][j].neg_mul_add(m[j][k], pivot);
        }
        good = V::both(good, diagonal.mul(V::splat(SINGULAR)).lt(pivot));
        let reciprocal = V::splat(1.0).div(pivot);
        for i in k + 1..N {
            let mut v = m[i][k];
            for j in 0..k {
                v = m[i][j].neg_mul_add(m[j][k], v);
            }
            m[k][i] = v;
            m[i][k] = v.mul(reciprocal);
        }
        if k + 1 == N {
            a[k] = reciprocal;
        }
    }
    for i in (0..N - 1).rev() {
        let mut v = zero;
        for k in i + 1..N {
            v = m[k][i].neg_mul_add(a[k], v);
        }
        a[i] = v;
    }
    let nan = V::splat(f32::NAN);
    a.map(|v| V::select(good, v, nan))
}

/// `S` moments as the second-order matrix over x, y, x^2, xy, y^2, 1: `m[a][b]` is the moment of
/// x^a y^b.
#[inline(always)]
pub(crate) fn second_matrix<V: Lanes>(m: impl Fn(usize, usize) -> V) -> [[V; SECOND]; SECOND] {
    const PHI: [(usize, usize); SECOND] = [(1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (0, 0)];
    std::array::from_fn(|i| std::array::from_fn(|j| m(PHI[i].0 + PHI[j].0, PHI[i].1 + PHI[j].1)))
}

/// `S` moments as the first-order matrix over x, y, 1.
#[inline(always)]
pub(crate) fn first_matrix<V: Lanes>(m: impl Fn(usize, usize) -> V) -> [[V; FIRST]; FIRST] {
    const PHI: [(usize, usize); FIRST] = [(1, 0), (0, 1), (0, 0)];
    std::array::from_fn(|i| std::array::from_fn(|j| m(PHI[i].0 + PHI[j].0, PHI[i].1 + PHI[j].1)))
}

/// Which fits a solve gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fits {
    /// First order.
    First,
    /// First and second.
    Both,
}

/// Writes first rows of M^-1: `rows[0..3]` for x, y, 1 of the first order, `rows[3..9]` for
/// x, y, x^2, xy, y^2, 1 of the second (padded rows).
pub(crate) fn inverse_rows(
    level: Level,
    s: MomentRows<'_, 5>,
    radius: usize,
    powers: &Powers,
    len: usize,
    fits: Fits,
    rows: &mut [&mut [f32]],
) {
    let padded = len + 2 * PAD;
    let (moments, count) = match fits {
        Fits::First => (3, FIRST),
        Fits::Both => (5, FIRST + SECOND),
    };
    assert!(len.is_multiple_of(WIDEST) && rows.len() >= count);
    for rows in &s[..moments] {
        assert!(rows.len() == 2 * radius + 1 && rows.iter().all(|r| r.len() >= padded));
    }
    assert!(rows.iter().all(|r| r.len() >= padded));
    match fits {
        Fits::First => dispatch!(
            level,
            inverse_first(
                s: MomentRows<'_, 5> = s,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                rows: &mut [&mut [f32]] = rows,
            )
        ),
        Fits::Both => dispatch!(
            level,
            inverse_both(
                s: MomentRows<'_, 5> = s,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                rows: &mut [&mut [f32]] = rows,
            )
        ),
    }
}

#[inline(always)]
fn inverse_first<V: Lanes>(
    s: MomentRows<'_, 5>,
    radius: usize,
    powers: &Powers,
    len: usize,
    rows: &mut [&mut [f32]],
) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: checked by `inverse_rows`.
        let (m0, m1, m2) = unsafe {
            (
                vertical::<V, 3>(s[0], radius, powers, i),
                vertical::<V, 2>(s[1], radius, powers, i),
                vertical::<V, 1>(s[2], radius, powers, i),
            )
        };
        let first = inverse_row(first_matrix(|a, b| match a {
            0 => m0[b],
            1 => m1[b],
            _ => m2[b],
        }));
        for (row, v) in rows.iter_mut().zip(first) {
            // SAFETY: as above.
            unsafe { v.store(row.as_mut_ptr().add(i)) };
        }
    }
}

#[inline(always)]
fn inverse_both<V: Lanes>(
    s: MomentRows<'_, 5>,
    radius: usize,
    powers: &Powers,
    len: usize,
    rows: &mut [&mut [f32]],
) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: checked by `inverse_rows`.
        let (m0, m1, m2, m3, m4) = unsafe {
            (
                vertical::<V, 5>(s[0], radius, powers, i),
                vertical::<V, 4>(s[1], radius, powers, i),
                vertical::<V, 3>(s[2], radius, powers, i),
                vertical::<V, 2>(s[3], radius, powers, i),
                vertical::<V, 1>(s[4], radius, powers, i),
            )
        };
        let moment = |a: usize, b: usize| match a {
            0 => m0[b],
            1 => m1[b],
            2 => m2[b],
            3 => m3[b],
            _ => m4[b],
        };
        let first = inverse_row(first_matrix(moment));
        let second = inverse_row(second_matrix(moment));
        for (row, v) in rows.iter_mut().zip(first.into_iter().chain(second)) {
            // SAFETY: as above.
            unsafe { v.store(row.as_mut_ptr().add(i)) };
        }
    }
}

/// Disparities (without the origin) from the moments of q and rows of M^-1 as [`inverse_rows`] gives
/// them: `out[0]` of first order, `out[1]`, when there, of second.
pub(crate) fn disparities(
    level: Level,
    q: MomentRows<'_, 3>,
    inverse: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    let padded = len + 2 * PAD;
    let count = if out.len() == 1 { FIRST } else { FIRST + SECOND };
    assert!(len.is_multiple_of(WIDEST) && inverse.len() >= count && !out.is_empty());
    for rows in q {
        assert!(rows.len() == 2 * radius + 1 && rows.iter().all(|r| r.len() >= padded));
    }
    assert!(inverse.iter().all(|r| r.len() >= padded) && out.iter().all(|r| r.len() >= padded));
    dispatch!(
        level,
        disparities_lanes(
            q: MomentRows<'_, 3> = q,
            inverse: &[&[f32]] = inverse,
            radius: usize = radius,
            powers: &Powers = powers,
            len: usize = len,
            out: &mut [&mut [f32]] = out,
        )
    );
}

#[inline(always)]
fn disparities_lanes<V: Lanes>(
    q: MomentRows<'_, 3>,
    inverse: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    let both = out.len() > 1;
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: checked by `disparities`.
        let row = |k: usize| unsafe { V::load(inverse.get_unchecked(k).as_ptr().add(i)) };
        // SAFETY: as above.
        let (q0, q1, q2) = unsafe {
            (
                vertical::<V, 3>(q[0], radius, powers, i),
                vertical::<V, 2>(q[1], radius, powers, i),
                vertical::<V, 1>(q[2], radius, powers, i),
            )
        };
        let first = row(0).mul_add(q1[0], row(1).mul_add(q0[1], row(2).mul(q0[0])));
        // SAFETY: as above.
        unsafe { first.store(out[0].as_mut_ptr().add(i)) };
        if both {
            let slopes = row(3).mul_add(q1[0], row(4).mul_add(q0[1], row(8).mul(q0[0])));
            let curves = row(6).mul_add(q1[1], row(7).mul(q0[2]));
            let second = row(5).mul_add(q2[0], slopes.add(curves));
            // SAFETY: as above.
            unsafe { second.store(out[1].as_mut_ptr().add(i)) };
        }
    }
}
