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
/// the values are whole numbers and a window's sum is below 2^24. `threes` is scratch.
pub(crate) fn slide_sum(
    level: Level,
    (enters, leaves): (&[f32], &[f32]),
    radius: usize,
    len: usize,
    (column, threes): (&mut [f32], &mut [f32]),
    out: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!((1..=PAD).contains(&radius) && len.is_multiple_of(WIDEST));
    assert!(enters.len() >= padded && leaves.len() >= padded);
    assert!(column.len() >= padded && threes.len() >= padded && out.len() >= padded);
    dispatch!(
        level,
        slide_lanes(
            enters: &[f32] = enters,
            leaves: &[f32] = leaves,
            radius: usize = radius,
            len: usize = len,
            column: &mut [f32] = column,
            threes: &mut [f32] = threes,
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

/// The second half: sums 2 `radius` + 1 columns per pixel. `threes` is scratch.
pub(crate) fn across_sum(
    level: Level,
    column: &[f32],
    radius: usize,
    len: usize,
    threes: &mut [f32],
    out: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!((1..=PAD).contains(&radius) && len.is_multiple_of(WIDEST));
    assert!(column.len() >= padded && threes.len() >= padded && out.len() >= padded);
    dispatch!(
        level,
        across(
            radius: usize = radius,
            len: usize = len,
            column: &[f32] = column,
            threes: &mut [f32] = threes,
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
    threes: &mut [f32],
    out: &mut [f32],
) {
    if V::AHEAD && V::COUNT == PAD && radius == 4 {
        slide_ahead::<V>(enters, leaves, len, column, out);
        return;
    }
    columns_lanes::<V>(enters, leaves, len, column);
    across::<V>(radius, len, column, threes, out);
}

/// [`slide_lanes`] for nine columns in one go: sums of three columns, and of three of these, from
/// neighbouring vectors of 16 in registers, without loads across cache lines.
#[inline(always)]
fn slide_ahead<V: Lanes>(
    enters: &[f32],
    leaves: &[f32],
    len: usize,
    column: &mut [f32],
    out: &mut [f32],
) {
    let zero = V::splat(0.0);
    let to = column.as_mut_ptr();
    // Column sums of the vector at `i`, brought up to date; pads stay zero.
    let slid = |i: usize| {
        if i >= PAD + len {
            return zero;
        }
        // SAFETY: `i + COUNT <= PAD + len`, as `len` is a multiple of COUNT.
        unsafe {
            let change = V::load(enters.as_ptr().add(i)).sub(V::load(leaves.as_ptr().add(i)));
            let sum = V::load(to.add(i)).add(change);
            sum.store(to.add(i));
            sum
        }
    };
    let three = |before: V, own: V, after: V| {
        // The last lane of the vector before, the first of the one after.
        before.ahead::<15>(own).add(own).add(own.ahead::<1>(after))
    };
    let (mut own, mut after) = (slid(PAD), slid(PAD + V::COUNT));
    let mut threes = [three(zero, zero, own), three(zero, own, after)];
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        let next = slid(i + 2 * V::COUNT);
        let last = three(own, after, next);
        let left = threes[0].ahead::<13>(threes[1]);
        let sum = left.add(threes[1]).add(threes[1].ahead::<3>(last));
        // SAFETY: `i + COUNT <= PAD + len`.
        unsafe { sum.store(out.as_mut_ptr().add(i)) };
        (own, after) = (after, next);
        threes = [threes[1], last];
    }
}

/// Sums over columns: of three, then of threes, which takes six loads a pixel for nine columns.
#[inline(always)]
fn across<V: Lanes>(
    radius: usize,
    len: usize,
    column: &[f32],
    threes: &mut [f32],
    out: &mut [f32],
) {
    if V::AHEAD && V::COUNT == PAD && matches!(radius, 2 | 6) {
        match radius {
            2 => across_ahead::<V, false>(len, column, out),
            _ => across_ahead::<V, true>(len, column, out),
        }
        return;
    }
    // All that fit, the last of them over the one before.
    let last = len + 2 * PAD - 2 - V::COUNT;
    for i in (0..last).step_by(V::COUNT).chain([last]) {
        // SAFETY: `i + 2 + COUNT <= len + 2 PAD`.
        unsafe {
            let load = |at: usize| V::load(column.as_ptr().add(at));
            load(i).add(load(i + 1)).add(load(i + 2)).store(threes.as_mut_ptr().add(i));
        }
    }
    match radius {
        4 => across_threes::<V, 4>(radius, len, column, threes, out),
        _ => across_threes::<V, 0>(radius, len, column, threes, out),
    }
}

/// Sums over five columns, or if `WIDE` over thirteen, from neighbouring vectors of 16 in registers.
#[inline(always)]
fn across_ahead<V: Lanes, const WIDE: bool>(len: usize, column: &[f32], out: &mut [f32]) {
    // SAFETY: `i + COUNT <= len + 2 PAD`.
    let load = |i: usize| unsafe { V::load(column.as_ptr().add(i)) };
    let (mut before, mut own) = (load(0), load(PAD));
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        let after = load(i + V::COUNT);
        let near = before.ahead::<15>(own).add(own).add(own.ahead::<1>(after));
        let next = before.ahead::<14>(own).add(own.ahead::<2>(after));
        let mut sum = near.add(next);
        if WIDE {
            let low = before.ahead::<13>(own).add(before.ahead::<12>(own));
            let lowest = before.ahead::<11>(own).add(before.ahead::<10>(own));
            let high = own.ahead::<3>(after).add(own.ahead::<4>(after));
            let highest = own.ahead::<5>(after).add(own.ahead::<6>(after));
            sum = sum.add(low.add(lowest)).add(high.add(highest));
        }
        // SAFETY: as above.
        unsafe { sum.store(out.as_mut_ptr().add(i)) };
        (before, own) = (own, after);
    }
}

#[inline(always)]
fn across_threes<V: Lanes, const R: usize>(
    radius: usize,
    len: usize,
    column: &[f32],
    threes: &[f32],
    out: &mut [f32],
) {
    let radius = if R == 0 { radius } else { R };
    let side = 2 * radius + 1;
    for i in (PAD..PAD + len).step_by(V::COUNT) {
        let mut sum = V::splat(0.0);
        for three in 0..side / 3 {
            // SAFETY: the last three begin two before the window's last column at most, so that
            // `i + radius - 2 + COUNT <= len + 2 PAD - 2`.
            sum = sum.add(unsafe { V::load(threes.as_ptr().add(i - radius + 3 * three)) });
        }
        for j in side / 3 * 3..side {
            // SAFETY: `i - radius >= 0` and `i + radius + COUNT <= len + 2 PAD`.
            sum = sum.add(unsafe { V::load(column.as_ptr().add(i - radius + j)) });
        }
        // SAFETY: as above.
        unsafe { sum.store(out.as_mut_ptr().add(i)) };
    }
}

/// Sum over the 2 `radius` + 1 `rows` and as many columns. All rows, `column`, `threes` and `out` are
/// padded rows of `PAD + len + PAD` values with zeros in the pads; `column` and `threes` are scratch.
pub(crate) fn box_sum(
    level: Level,
    rows: &[&[f32]],
    radius: usize,
    len: usize,
    (column, threes): (&mut [f32], &mut [f32]),
    out: &mut [f32],
) {
    let padded = len + 2 * PAD;
    assert!((1..=PAD).contains(&radius) && len.is_multiple_of(WIDEST));
    assert!(rows.iter().all(|r| r.len() >= padded));
    assert!(column.len() >= padded && threes.len() >= padded && out.len() >= padded);
    dispatch!(
        level,
        box_lanes(
            rows: &[&[f32]] = rows,
            radius: usize = radius,
            len: usize = len,
            column: &mut [f32] = column,
            threes: &mut [f32] = threes,
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
    threes: &mut [f32],
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
    across::<V>(radius, len, column, threes, out);
}

/// Columns whose vertical moments are at hand at a time: they stay in the first-level cache.
pub(crate) const CHUNK: usize = 256;

/// Vertical moments of a chunk's columns, and of [`PAD`] on both sides.
#[repr(align(64))]
pub(crate) struct Columns<const K: usize>([[f32; CHUNK + 2 * PAD]; K]);

impl<const K: usize> Columns<K> {
    pub(crate) fn new() -> Self {
        Self([[0.0; CHUNK + 2 * PAD]; K])
    }

    /// Fills the columns around the `count` pixels from column `at` of padded rows; a chunk follows the
    /// one before, of [`CHUNK`] pixels, or begins a row at [`PAD`].
    ///
    /// `R` is the radius known to the compiler, or 0.
    ///
    /// # Safety
    /// `at + count + PAD` lies within every row, `count` is a multiple of COUNT and at most [`CHUNK`], and
    /// there are 2 `radius` + 1 rows.
    #[inline(always)]
    pub(crate) unsafe fn fill<V: Lanes, const R: usize>(
        &mut self,
        rows: &[&[f32]],
        radius: usize,
        powers: &Powers,
        at: usize,
        count: usize,
    ) {
        let begun = if at == PAD {
            0
        } else {
            for columns in &mut self.0 {
                columns.copy_within(CHUNK.., 0);
            }
            2 * PAD
        };
        for i in (begun..count + 2 * PAD).step_by(V::COUNT) {
            // SAFETY: the caller's promise.
            let load =
                |row: usize| unsafe { V::load(rows.get_unchecked(row).as_ptr().add(at - PAD + i)) };
            let m: [V; K] = weighted::<V, K, R>(load, radius, powers);
            for (columns, m) in self.0.iter_mut().zip(m) {
                // SAFETY: `i + COUNT <= count + 2 PAD`.
                unsafe { m.store(columns.as_mut_ptr().add(i)) };
            }
        }
    }

    /// Moments along x, of power 0 to L - 1, of the vertical moment `power`, at pixel `i` of the chunk.
    ///
    /// # Safety
    /// `i + COUNT` is at most the chunk's count; `power` is below K.
    #[inline(always)]
    pub(crate) unsafe fn across<V: Lanes, const L: usize, const R: usize>(
        &self,
        power: usize,
        radius: usize,
        powers: &Powers,
        i: usize,
    ) -> [V; L] {
        let radius = if R == 0 { radius } else { R };
        if V::AHEAD && V::COUNT == PAD && R == 4 {
            // SAFETY: the caller's promise; there are COUNT columns more on both sides.
            let [before, own, after] = [0, PAD, 2 * PAD]
                .map(|at| unsafe { V::load(self.0.get_unchecked(power).as_ptr().add(at + i)) });
            let taps = [
                before.ahead::<12>(own),
                before.ahead::<13>(own),
                before.ahead::<14>(own),
                before.ahead::<15>(own),
                own,
                own.ahead::<1>(after),
                own.ahead::<2>(after),
                own.ahead::<3>(after),
                own.ahead::<4>(after),
            ];
            return weighted::<V, L, R>(|j| taps[j], radius, powers);
        }
        // SAFETY: the caller's promise; the radius is at most PAD.
        let load = |j: usize| unsafe {
            V::load(self.0.get_unchecked(power).as_ptr().add(PAD + i - radius + j))
        };
        weighted::<V, L, R>(load, radius, powers)
    }
}

/// m[l] = sum over j of (j / radius)^l value(radius + j).
#[inline(always)]
#[allow(clippy::needless_range_loop)]
fn weighted<V: Lanes, const L: usize, const R: usize>(
    value: impl Fn(usize) -> V,
    radius: usize,
    powers: &Powers,
) -> [V; L] {
    let radius = if R == 0 { radius } else { R };
    let mut m = [V::splat(0.0); L];
    m[0] = value(radius);
    for j in 1..=radius {
        let (after, before) = (value(radius + j), value(radius - j));
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

    /// x moments up to 2 of the y moments up to 2, by chunks.
    #[allow(clippy::needless_range_loop)]
    fn moments<V: Lanes>(
        rows: &[&[f32]],
        radius: usize,
        powers: &Powers,
        len: usize,
        out: &mut [[[f32; 3]; 3]],
    ) {
        let mut columns = Columns::<3>::new();
        for at in (PAD..PAD + len).step_by(CHUNK) {
            let count = CHUNK.min(PAD + len - at);
            // SAFETY: rows hold `len + 2 PAD` values.
            unsafe { columns.fill::<V, 0>(rows, radius, powers, at, count) };
            for i in (0..count).step_by(V::COUNT) {
                for power in 0..3 {
                    // SAFETY: as above.
                    let m = unsafe { columns.across::<V, 3, 0>(power, radius, powers, i) };
                    for (a, m) in m.into_iter().enumerate() {
                        let mut lanes = [0.0f32; WIDEST];
                        // SAFETY: COUNT is at most WIDEST.
                        unsafe { m.store(lanes.as_mut_ptr()) };
                        for (lane, v) in lanes[..V::COUNT].iter().enumerate() {
                            out[at - PAD + i + lane][a][power] = *v;
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn moments_match_the_definition_at_every_level() {
        let mut random = Random::new(6);
        for (radius, len) in [(2usize, 48), (4, 2 * CHUNK + 32), (8, CHUNK + 16)] {
            let rows: Vec<Vec<f32>> = (0..2 * radius + 1)
                .map(|_| {
                    let mut row = vec![0.0; len + 2 * PAD];
                    row[PAD..PAD + len - 7].fill_with(|| random.unit() as f32 * 1000.0);
                    row
                })
                .collect();
            let rows: Vec<&[f32]> = rows.iter().map(|r| &r[..]).collect();
            let powers = powers(radius);
            for level in Level::available() {
                let mut got = vec![[[0.0; 3]; 3]; len];
                dispatch!(
                    level,
                    moments(
                        rows: &[&[f32]] = &rows,
                        radius: usize = radius,
                        powers: &Powers = &powers,
                        len: usize = len,
                        out: &mut [[[f32; 3]; 3]] = &mut got,
                    )
                );
                for (i, got) in got.iter().enumerate() {
                    for (a, got) in got.iter().enumerate() {
                        for (b, got) in got.iter().enumerate() {
                            let unit = |j: usize| (j as f64 - radius as f64) / radius as f64;
                            let side = 0..=2 * radius;
                            let want: f64 = side
                                .clone()
                                .flat_map(|y| side.clone().map(move |x| (x, y)))
                                .map(|(x, y)| {
                                    unit(x).powi(a as i32)
                                        * unit(y).powi(b as i32)
                                        * f64::from(rows[y][PAD + i + x - radius])
                                })
                                .sum();
                            let off = (f64::from(*got) - want).abs();
                            assert!(off < 0.05, "{level} {radius} {i} x^{a} y^{b}: {got}, {want}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn boxes_match_the_definition_at_every_level() {
        let mut random = Random::new(5);
        for radius in [2usize, 4, 6, 8] {
            let len = 48;
            let rows: Vec<Vec<f32>> = (0..2 * radius + 1)
                .map(|_| {
                    let mut row = vec![0.0; len + 2 * PAD];
                    row[PAD..PAD + 41].fill_with(|| random.unit() as f32 * 1000.0);
                    row
                })
                .collect();
            let rows: Vec<&[f32]> = rows.iter().map(|r| &r[..]).collect();
            for level in Level::available() {
                let mut column = vec![0.0; len + 2 * PAD];
                let (mut threes, mut out) = (column.clone(), column.clone());
                box_sum(level, &rows, radius, len, (&mut column, &mut threes), &mut out);
                for i in PAD..PAD + len {
                    let want: f64 = rows
                        .iter()
                        .map(|r| {
                            r[i - radius..=i + radius].iter().map(|&v| f64::from(v)).sum::<f64>()
                        })
                        .sum();
                    assert!((f64::from(out[i]) - want).abs() < 1e-6 * want.abs() + 1e-9);
                }
            }
        }
    }
}
