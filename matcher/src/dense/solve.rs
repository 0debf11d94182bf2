//! The fit: the first row of M^-1 from the moments of S, and the disparity from the moments of q.
//!
//! Moments are summed along y first, straight from the rows of S and q: what is kept between rows is one
//! map each instead of one per moment.

use super::moments::{CHUNK, Columns, PAD, Powers};
use crate::{
    Level,
    lanes::{Lanes, WIDEST, dispatch},
};

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

/// Writes first rows of M^-1 to padded rows: `rows[0..3]` for x, y, 1 of the first order, `rows[3..9]` for
/// x, y, x^2, xy, y^2, 1 of the second. `s` holds the 2 `radius` + 1 padded rows of S around the row.
pub(crate) fn inverse_rows(
    level: Level,
    s: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    fits: Fits,
    rows: &mut [&mut [f32]],
) {
    let padded = len + 2 * PAD;
    let count = if fits == Fits::First { FIRST } else { FIRST + SECOND };
    assert!(len.is_multiple_of(WIDEST) && rows.len() >= count && radius <= PAD);
    assert!(s.len() == 2 * radius + 1 && s.iter().all(|r| r.len() >= padded));
    assert!(rows.iter().all(|r| r.len() >= padded));
    match fits {
        Fits::First => dispatch!(
            level,
            inverse_first_any(
                s: &[&[f32]] = s,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                rows: &mut [&mut [f32]] = rows,
            )
        ),
        Fits::Both => dispatch!(
            level,
            inverse_both_any(
                s: &[&[f32]] = s,
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
    s: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    rows: &mut [&mut [f32]],
) {
    let mut columns = Columns::<3>::new();
    for at in (PAD..PAD + len).step_by(CHUNK) {
        let count = CHUNK.min(PAD + len - at);
        // SAFETY: checked by `inverse_rows`.
        unsafe { columns.fill::<V, R>(s, radius, powers, at, count) };
        for i in (0..count).step_by(V::COUNT) {
            // SAFETY: as above. Powers of x at y^0, y^1 and y^2.
            let (y0, y1, y2) = unsafe {
                (
                    columns.across::<V, 3, R>(0, radius, powers, i),
                    columns.across::<V, 2, R>(1, radius, powers, i),
                    columns.across::<V, 1, R>(2, radius, powers, i),
                )
            };
            let zero = V::splat(0.0);
            let moments = [[y0[0], y1[0], y2[0]], [y0[1], y1[1], zero], [y0[2], zero, zero]];
            for (row, v) in rows.iter_mut().zip(inverse_row(first_matrix(&moments))) {
                // SAFETY: as above.
                unsafe { v.store(row.as_mut_ptr().add(at + i)) };
            }
        }
    }
}

/// Moments of a chunk's pixels up to the fourth power, a row each.
#[repr(align(64))]
struct Moments([[f32; CHUNK]; 15]);

#[inline(always)]
fn inverse_both<V: Lanes, const R: usize>(
    s: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    rows: &mut [&mut [f32]],
) {
    let (to_first, to_second) = rows.split_at_mut(FIRST);
    let mut columns = Columns::<5>::new();
    let mut all = Moments([[0.0; CHUNK]; 15]);
    for at in (PAD..PAD + len).step_by(CHUNK) {
        let count = CHUNK.min(PAD + len - at);
        // SAFETY: checked by `inverse_rows`.
        unsafe { columns.fill::<V, R>(s, radius, powers, at, count) };
        // Moments and solutions in loops of their own: together they are longer than a processor looks
        // ahead, and a solution is a chain of operations that wait for each other.
        for i in (0..count).step_by(V::COUNT) {
            // SAFETY: as above. Powers of x at y^0 to y^4.
            let (y0, y1, y2, y3, y4) = unsafe {
                (
                    columns.across::<V, 5, R>(0, radius, powers, i),
                    columns.across::<V, 4, R>(1, radius, powers, i),
                    columns.across::<V, 3, R>(2, radius, powers, i),
                    columns.across::<V, 2, R>(3, radius, powers, i),
                    columns.across::<V, 1, R>(4, radius, powers, i),
                )
            };
            let to = all.0.as_mut_ptr().cast::<f32>();
            // SAFETY: `i + COUNT` is at most CHUNK.
            unsafe {
                each!(K in 0 1 2 3 4 => { y0[K].store(to.add(K * CHUNK + i)); });
                each!(K in 0 1 2 3 => { y1[K].store(to.add((5 + K) * CHUNK + i)); });
                each!(K in 0 1 2 => { y2[K].store(to.add((9 + K) * CHUNK + i)); });
                each!(K in 0 1 => { y3[K].store(to.add((12 + K) * CHUNK + i)); });
                y4[0].store(to.add(14 * CHUNK + i));
            }
        }
        for i in (0..count).step_by(V::COUNT) {
            // SAFETY: as above.
            let m = |k: usize| unsafe { V::load(all.0[k].as_ptr().add(i)) };
            let z = V::splat(0.0);
            let moments = [
                [m(0), m(5), m(9), m(12), m(14)],
                [m(1), m(6), m(10), m(13), z],
                [m(2), m(7), m(11), z, z],
                [m(3), m(8), z, z, z],
                [m(4), z, z, z, z],
            ];
            for (row, v) in to_first.iter_mut().zip(inverse_row(first_matrix(&moments))) {
                // SAFETY: as above.
                unsafe { v.store(row.as_mut_ptr().add(at + i)) };
            }
            for (row, v) in to_second.iter_mut().zip(inverse_row(second_matrix(&moments))) {
                // SAFETY: as above.
                unsafe { v.store(row.as_mut_ptr().add(at + i)) };
            }
        }
    }
}

/// Disparities (without the origin) from the 2 `radius` + 1 rows of q around the row and rows of M^-1 as
/// [`inverse_rows`] gives them: `out[0]` of first order, `out[1]`, when there, of second.
pub(crate) fn disparities(
    level: Level,
    q: &[&[f32]],
    inverse: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    let padded = len + 2 * PAD;
    let count = if out.len() == 1 { FIRST } else { FIRST + SECOND };
    assert!(len.is_multiple_of(WIDEST) && inverse.len() >= count && !out.is_empty());
    assert!(radius <= PAD && q.len() == 2 * radius + 1 && q.iter().all(|r| r.len() >= padded));
    assert!(inverse.iter().all(|r| r.len() >= padded) && out.iter().all(|r| r.len() >= padded));
    dispatch!(
        level,
        disparities_any(
            q: &[&[f32]] = q,
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
    q: &[&[f32]],
    inverse: &[&[f32]],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    match out {
        [first] => {
            let mut columns = Columns::<2>::new();
            for at in (PAD..PAD + len).step_by(CHUNK) {
                let count = CHUNK.min(PAD + len - at);
                // SAFETY: checked by `disparities`.
                unsafe { columns.fill::<V, R>(q, radius, powers, at, count) };
                for i in (0..count).step_by(V::COUNT) {
                    // SAFETY: as above.
                    unsafe {
                        let y0 = columns.across::<V, 2, R>(0, radius, powers, i);
                        let y1 = columns.across::<V, 1, R>(1, radius, powers, i);
                        let d = first_order(inverse, at + i, &y0, &y1);
                        d.store(first.as_mut_ptr().add(at + i));
                    }
                }
            }
        }
        [first, second, ..] => {
            let mut columns = Columns::<3>::new();
            for at in (PAD..PAD + len).step_by(CHUNK) {
                let count = CHUNK.min(PAD + len - at);
                // SAFETY: checked by `disparities`.
                unsafe { columns.fill::<V, R>(q, radius, powers, at, count) };
                for i in (0..count).step_by(V::COUNT) {
                    // SAFETY: as above.
                    unsafe {
                        let y0 = columns.across::<V, 3, R>(0, radius, powers, i);
                        let y1 = columns.across::<V, 2, R>(1, radius, powers, i);
                        let y2 = columns.across::<V, 1, R>(2, radius, powers, i);
                        let d = first_order(inverse, at + i, &y0, &y1);
                        d.store(first.as_mut_ptr().add(at + i));
                        let row = |k: usize| V::load(inverse.get_unchecked(k).as_ptr().add(at + i));
                        let slopes =
                            row(3).mul_add(y0[1], row(4).mul_add(y1[0], row(8).mul(y0[0])));
                        let curves = row(6).mul_add(y1[1], row(7).mul(y2[0]));
                        let d = row(5).mul_add(y0[2], slopes.add(curves));
                        d.store(second.as_mut_ptr().add(at + i));
                    }
                }
            }
        }
        [] => {}
    }
}

/// The first-order disparity from moments along x at y^0 and y^1.
///
/// # Safety
/// `i + COUNT` lies within the first three rows of `inverse`.
#[inline(always)]
unsafe fn first_order<V: Lanes, const A: usize, const B: usize>(
    inverse: &[&[f32]],
    i: usize,
    y0: &[V; A],
    y1: &[V; B],
) -> V {
    // SAFETY: the caller's promise.
    let row = |k: usize| unsafe { V::load(inverse.get_unchecked(k).as_ptr().add(i)) };
    row(0).mul_add(y0[1], row(1).mul_add(y1[0], row(2).mul(y0[0])))
}

/// The paper's radius is compiled for itself, all others together.
#[inline(always)]
fn inverse_first_any<V: Lanes>(
    s: &[&[f32]],
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
    s: &[&[f32]],
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
    q: &[&[f32]],
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
