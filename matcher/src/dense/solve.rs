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

/// Repeats a block with a constant in place of a loop variable, so that the matrices below live in
/// registers.
macro_rules! each {
    ($name:ident in $($value:literal)* => $body:block) => {
        $({
            #[allow(unused, clippy::absurd_extreme_comparisons)]
            const $name: usize = $value;
            $body
        })*
    };
}

/// First row of the inverse of a symmetric positive `m` (its lower part is read), whose *last*
/// variable is the constant: the solution of m a = e_last by L D L^T, in which the forward
/// substitution falls away. NaN where singular.
#[inline(always)]
#[allow(clippy::absurd_extreme_comparisons)]
pub(crate) fn inverse_row<V: Lanes, const N: usize>(mut m: [[V; N]; N]) -> [V; N] {
    const { assert!(N <= 6) };
    let one = V::splat(1.0);
    let mut good = V::splat(0.0).lt(one);
    let mut diagonal = [one; N];
    for (i, d) in diagonal.iter_mut().enumerate() {
        *d = m[i][i].mul(V::splat(SINGULAR));
    }
    each!(K in 0 1 2 3 4 5 => {
        if K < N {
            good = V::both(good, diagonal[K].lt(m[K][K]));
            let reciprocal = m[K][K].reciprocal();
            each!(I in 1 2 3 4 5 => {
                if I > K && I < N {
                    let factor = m[I][K].mul(reciprocal);
                    each!(J in 1 2 3 4 5 => {
                        if J > K && J <= I {
                            m[I][J] = factor.neg_mul_add(m[J][K], m[I][J]);
                        }
                    });
                    // The upper part keeps L.
                    m[K][I] = factor;
                }
            });
            if K + 1 == N {
                m[K][K] = reciprocal;
            }
        }
    });
    let mut a = [V::splat(0.0); N];
    a[N - 1] = m[N - 1][N - 1];
    each!(R in 1 2 3 4 5 => {
        if R < N {
            let i = N - 1 - R;
            each!(K in 1 2 3 4 5 => {
                if K > i && K < N {
                    a[i] = m[i][K].neg_mul_add(a[K], a[i]);
                }
            });
        }
    });
    for v in &mut a {
        *v = V::select(good, *v, V::splat(f32::NAN));
    }
    a
}

/// Powers of x and y of each variable, the constant last.
const PHI_SECOND: [(usize, usize); SECOND] = [(1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (0, 0)];
const PHI_FIRST: [(usize, usize); FIRST] = [(1, 0), (0, 1), (0, 0)];

/// Lower part of the second-order matrix over x, y, x^2, xy, y^2, 1, from moments of S: `m[a][b]` is
/// that of x^a y^b.
#[inline(always)]
#[allow(clippy::absurd_extreme_comparisons)]
pub(crate) fn second_matrix<V: Lanes>(m: &[[V; 5]; 5]) -> [[V; SECOND]; SECOND] {
    let mut matrix = [[V::splat(0.0); SECOND]; SECOND];
    each!(I in 0 1 2 3 4 5 => {
        each!(J in 0 1 2 3 4 5 => {
            if J <= I {
                const A: usize = PHI_SECOND[I].0 + PHI_SECOND[J].0;
                const B: usize = PHI_SECOND[I].1 + PHI_SECOND[J].1;
                matrix[I][J] = m[A][B];
            }
        });
    });
    matrix
}

/// Lower part of the first-order matrix over x, y, 1.
#[inline(always)]
#[allow(clippy::absurd_extreme_comparisons)]
pub(crate) fn first_matrix<V: Lanes, const K: usize>(m: &[[V; K]; K]) -> [[V; FIRST]; FIRST] {
    let mut matrix = [[V::splat(0.0); FIRST]; FIRST];
    each!(I in 0 1 2 => {
        each!(J in 0 1 2 => {
            if J <= I {
                const A: usize = PHI_FIRST[I].0 + PHI_FIRST[J].0;
                const B: usize = PHI_FIRST[I].1 + PHI_FIRST[J].1;
                matrix[I][J] = m[A][B];
            }
        });
    });
    matrix
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
            inverse_first_any(
                s: MomentRows<'_, 5> = s,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                rows: &mut [&mut [f32]] = rows,
            )
        ),
        Fits::Both => dispatch!(
            level,
            inverse_both_any(
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
fn inverse_first<V: Lanes, const R: usize>(
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
                vertical::<V, 3, R>(s[0], radius, powers, i),
                vertical::<V, 2, R>(s[1], radius, powers, i),
                vertical::<V, 1, R>(s[2], radius, powers, i),
            )
        };
        let zero = V::splat(0.0);
        let first = inverse_row(first_matrix(&[m0, [m1[0], m1[1], zero], [m2[0], zero, zero]]));
        for (row, v) in rows.iter_mut().zip(first) {
            // SAFETY: as above.
            unsafe { v.store(row.as_mut_ptr().add(i)) };
        }
    }
}

#[inline(always)]
fn inverse_both<V: Lanes, const R: usize>(
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
                vertical::<V, 5, R>(s[0], radius, powers, i),
                vertical::<V, 4, R>(s[1], radius, powers, i),
                vertical::<V, 3, R>(s[2], radius, powers, i),
                vertical::<V, 2, R>(s[3], radius, powers, i),
                vertical::<V, 1, R>(s[4], radius, powers, i),
            )
        };
        let z = V::splat(0.0);
        let moments = [
            m0,
            [m1[0], m1[1], m1[2], m1[3], z],
            [m2[0], m2[1], m2[2], z, z],
            [m3[0], m3[1], z, z, z],
            [m4[0], z, z, z, z],
        ];
        let first = inverse_row(first_matrix(&moments));
        let second = inverse_row(second_matrix(&moments));
        let (to_first, to_second) = rows.split_at_mut(FIRST);
        for (row, v) in to_first.iter_mut().zip(first) {
            // SAFETY: as above.
            unsafe { v.store(row.as_mut_ptr().add(i)) };
        }
        for (row, v) in to_second.iter_mut().zip(second) {
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
        disparities_any(
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
fn disparities_lanes<V: Lanes, const R: usize>(
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
                vertical::<V, 3, R>(q[0], radius, powers, i),
                vertical::<V, 2, R>(q[1], radius, powers, i),
                vertical::<V, 1, R>(q[2], radius, powers, i),
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

/// The paper's radius is compiled for itself, all others together.
#[inline(always)]
fn inverse_first_any<V: Lanes>(
    s: MomentRows<'_, 5>,
    radius: usize,
    powers: &Powers,
    len: usize,
    rows: &mut [&mut [f32]],
) {
    match radius {
        4 => inverse_first::<V, 4>(s, radius, powers, len, rows),
        _ => inverse_first::<V, 0>(s, radius, powers, len, rows),
    }
}

#[inline(always)]
fn inverse_both_any<V: Lanes>(
    s: MomentRows<'_, 5>,
    radius: usize,
    powers: &Powers,
    len: usize,
    rows: &mut [&mut [f32]],
) {
    match radius {
        4 => inverse_both::<V, 4>(s, radius, powers, len, rows),
        _ => inverse_both::<V, 0>(s, radius, powers, len, rows),
    }
}

#[inline(always)]
fn disparities_any<V: Lanes>(
    q: MomentRows<'_, 3>,
    inverse: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    match radius {
        4 => disparities_lanes::<V, 4>(q, inverse, radius, powers, len, out),
        _ => disparities_lanes::<V, 0>(q, inverse, radius, powers, len, out),
    }
}
