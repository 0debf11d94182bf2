//! Windowed sums: boxes and moments, separable, summed directly row by row so that a result depends
//! on its window alone and not on where a sliding sum began.

use crate::{
    Level,
    lanes::{Lanes, WIDEST, dispatch},
};

/// Zeros on both sides of a row buffer: the largest radius, and room for a whole vector.
pub(crate) const PAD: usize = WIDEST;

/// Window coordinates in units of the radius, to the powers 0..=4: `POWERS[k][j]` = (j / radius)^k.
pub(crate) type Powers = [[f32; PAD + 1]; 5];

/// The powers for a radius.
pub(crate) fn powers(radius: usize) -> Powers {
    std::array::from_fn(|k| {
        std::array::from_fn(|j| (j as f64 / radius as f64).powi(k as i32) as f32)
    })
}

/// Moves the sums over a column of rows on by one, and sums 2 `radius` + 1 of them per pixel:
/// `column` += `enters` - `leaves`. Exact, and so independent of where the sliding began, as long as
/// the values are whole numbers and a column's sum is below 2^24.
pub(crate) fn slide_sum(
    level: Level,
    (enters, leaves): (&[f32], &[f32]),
    radius: usize,
    len: usize,
    column: &mut [f32],
    out: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!(radius <= PAD && len.is_multiple_of(WIDEST));
    assert!(enters.len() >= padded && leaves.len() >= padded);
    assert!(column.len() >= padded && out.len() >= padded);
    dispatch!(
        level,
        slide_lanes(
            enters: &[f32] = enters,
            leaves: &[f32] = leaves,
            radius: usize = radius,
            len: usize = len,
            column: &mut [f32] = column,
            out: &mut [f32] = out,
        )
    );
}

/// The first half of [`slide_sum`]: `column` += `enters` - `leaves`.
pub(crate) fn slide_columns(
    level: Level,
    (enters, leaves): (&[f32], &[f32]),
    len: usize,
    column: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!(len.is_multiple_of(WIDEST) && column.len() >= padded);
    assert!(enters.len() >= padded && leaves.len() >= padded);
    dispatch!(
        level,
        columns_lanes(
            enters: &[f32] = enters,
            leaves: &[f32] = leaves,
            len: usize = len,
            column: &mut [f32] = column,
        )
    );
}

/// The second half: sums 2 `radius` + 1 columns per pixel.
pub(crate) fn across_sum(level: Level, column: &[f32], radius: usize, len: usize, out: &mut [f32]) {
    let padded = len + 2 * PAD;
    assert!(radius <= PAD && len.is_multiple_of(WIDEST));
    assert!(column.len() >= padded && out.len() >= padded);
    dispatch!(
        level,
        across(
            radius: usize = radius,
            len: usize = len,
            column: &[f32] = column,
            out: &mut [f32] = out,
        )
    );
}

#[inline(always)]
fn columns_lanes<V: Lanes>(enters: &[f32], leaves: &[f32], len: usize, column: &mut [f32]) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: `i + COUNT <= PAD + len`, as `len` is a multiple of COUNT.
        unsafe {
            let change = V::load(enters.as_ptr().add(i)).sub(V::load(leaves.as_ptr().add(i)));
            V::load(column.as_ptr().add(i)).add(change).store(column.as_mut_ptr().add(i));
        }
    }
}

#[inline(always)]
fn slide_lanes<V: Lanes>(
    enters: &[f32],
    leaves: &[f32],
    radius: usize,
    len: usize,
    column: &mut [f32],
    out: &mut [f32],
) {
    columns_lanes::<V>(enters, leaves, len, column);
    across::<V>(radius, len, column, out);
}

/// Sums over columns.
#[inline(always)]
fn across<V: Lanes>(radius: usize, len: usize, column: &[f32], out: &mut [f32]) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        let mut sum = V::splat(0.0);
        for j in 0..2 * radius + 1 {
            // SAFETY: `i - radius >= 0` and `i + radius + COUNT <= len + 2 PAD`.
            sum = sum.add(unsafe { V::load(column.as_ptr().add(i - radius + j)) });
        }
        // SAFETY: as above.
        unsafe { sum.store(out.as_mut_ptr().add(i)) };
    }
}

/// Sum over the 2 `radius` + 1 `rows` and as many columns. All rows, `column` and `out` are padded
/// rows of `PAD + len + PAD` values with zeros in the pads; `column` is scratch.
pub(crate) fn box_sum(
    level: Level,
    rows: &[&[f32]],
    radius: usize,
    len: usize,
    column: &mut [f32],
    out: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!(radius <= PAD && len.is_multiple_of(WIDEST));
    assert!(rows.iter().all(|r| r.len() >= padded));
    assert!(column.len() >= padded && out.len() >= padded);
    dispatch!(
        level,
        box_lanes(
            rows: &[&[f32]] = rows,
            radius: usize = radius,
            len: usize = len,
            column: &mut [f32] = column,
            out: &mut [f32] = out,
        )
    );
}

#[inline(always)]
fn box_lanes<V: Lanes>(
    rows: &[&[f32]],
    radius: usize,
    len: usize,
    column: &mut [f32],
    out: &mut [f32],
) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        let mut sum = V::splat(0.0);
        for row in rows {
            // SAFETY: `i + COUNT <= PAD + len`, as `len` is a multiple of COUNT.
            sum = sum.add(unsafe { V::load(row.as_ptr().add(i)) });
        }
        // SAFETY: as above.
        unsafe { sum.store(column.as_mut_ptr().add(i)) };
    }
    across::<V>(radius, len, column, out);
}

/// Horizontal moments of one padded row: `out[k][i]` = sum over j of (j / radius)^k row[i + j].
pub(crate) fn horizontal(
    level: Level,
    row: &[f32],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    let padded = len + 2 * PAD;
    assert!(radius <= PAD && len.is_multiple_of(WIDEST) && row.len() >= padded);
    assert!(out.iter().all(|o| o.len() >= padded));
    match out.len() {
        3 => dispatch!(
            level,
            horizontal3(
                row: &[f32] = row,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                out: &mut [&mut [f32]] = out,
            )
        ),
        5 => dispatch!(
            level,
            horizontal5(
                row: &[f32] = row,
                radius: usize = radius,
                powers: &Powers = powers,
                len: usize = len,
                out: &mut [&mut [f32]] = out,
            )
        ),
        k => unreachable!("{k} moments"),
    }
}

#[inline(always)]
fn horizontal3<V: Lanes>(
    row: &[f32],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    horizontal_lanes::<V, 3>(row, radius, powers, len, out);
}

#[inline(always)]
fn horizontal5<V: Lanes>(
    row: &[f32],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    horizontal_lanes::<V, 5>(row, radius, powers, len, out);
}

#[inline(always)]
#[allow(clippy::needless_range_loop)]
fn horizontal_lanes<V: Lanes, const K: usize>(
    row: &[f32],
    radius: usize,
    powers: &Powers,
    len: usize,
    out: &mut [&mut [f32]],
) {
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        // SAFETY: `i + COUNT <= PAD + len`.
        let load = |at: usize| unsafe { V::load(row.as_ptr().add(at)) };
        let mut h = [V::splat(0.0); K];
        h[0] = load(i);
        for j in 1..=radius {
            // `i - radius >= 0` and `i + radius + COUNT <= len + 2 PAD`.
            let (after, before) = (load(i + j), load(i - j));
            let (even, odd) = (after.add(before), after.sub(before));
            h[0] = h[0].add(even);
            for k in 1..K {
                let with = if k % 2 == 0 { even } else { odd };
                h[k] = with.mul_add(V::splat(powers[k][j]), h[k]);
            }
        }
        for (o, h) in out.iter_mut().zip(h) {
            // SAFETY: as above.
            unsafe { h.store(o.as_mut_ptr().add(i)) };
        }
    }
}

/// Vertical moments at pixel `i` of horizontal moments `k`: `m[l]` = sum over j of
/// (j / radius)^l rows[radius + j][i].
///
/// `R` is the radius known to the compiler, or 0.
///
/// # Safety
/// `i + COUNT` lies within every row, and there are 2 `radius` + 1 rows.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
pub(crate) unsafe fn vertical<V: Lanes, const L: usize, const R: usize>(
    rows: &[&[f32]],
    radius: usize,
    powers: &Powers,
    i: usize,
) -> [V; L] {
    let radius = if R == 0 { radius } else { R };
    // SAFETY: the caller's promise.
    let load = |row: usize| unsafe { V::load(rows.get_unchecked(row).as_ptr().add(i)) };
    let mut m = [V::splat(0.0); L];
    m[0] = load(radius);
    for j in 1..=radius {
        let (after, before) = (load(radius + j), load(radius - j));
        let even = after.add(before);
        m[0] = m[0].add(even);
        if L > 1 {
            let odd = after.sub(before);
            for l in 1..L {
                let with = if l % 2 == 0 { even } else { odd };
                m[l] = with.mul_add(V::splat(powers[l][j]), m[l]);
            }
        }
    }
    m
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Random;

    #[test]
    fn boxes_and_moments_match_the_definition_at_every_level() {
        let mut random = Random::new(5);
        for radius in [2usize, 4, 8] {
            let len = 48;
            let rows: Vec<Vec<f32>> = (0..2 * radius + 1)
                .map(|_| {
                    let mut row = vec![0.0; len + 2 * PAD];
                    row[PAD..PAD + 41].fill_with(|| random.unit() as f32 * 1000.0);
                    row
                })
                .collect();
            let rows: Vec<&[f32]> = rows.iter().map(|r| &r[..]).collect();
            let powers = powers(radius);
            for level in Level::available() {
                let mut column = vec![0.0; len + 2 * PAD];
                let mut out = column.clone();
                box_sum(level, &rows, radius, len, &mut column, &mut out);
                let mut h: Vec<Vec<f32>> = vec![vec![0.0; len + 2 * PAD]; 5];
                let mut to: Vec<&mut [f32]> = h.iter_mut().map(|h| &mut h[..]).collect();
                horizontal(level, rows[0], radius, &powers, len, &mut to);
                for i in PAD..PAD + len {
                    let want: f64 = rows
                        .iter()
                        .map(|r| {
                            r[i - radius..=i + radius].iter().map(|&v| f64::from(v)).sum::<f64>()
                        })
                        .sum();
                    assert!((f64::from(out[i]) - want).abs() < 1e-6 * want.abs() + 1e-9);
                    for (k, h) in h.iter().enumerate() {
                        let want: f64 = (0..=2 * radius)
                            .map(|j| {
                                let t = (j as f64 - radius as f64) / radius as f64;
                                t.powi(k as i32) * f64::from(rows[0][i + j - radius])
                            })
                            .sum();
                        assert!((f64::from(h[i]) - want).abs() < 0.01, "{level} {radius} {k}");
                    }
                }
            }
        }
    }
}
