//! Cleaning of the coarse map: lone outliers take their neighbours' disparity where they match it as
//! well, and of several left pixels that claim one right pixel only the best match keeps it.

use std::ops::Range;

use super::{
    Band, CoarseMap, INVALID,
    descriptor::MARGIN,
    search::{Scene, UNSURE_COST},
    shared,
};
use crate::{Level, lanes::vectorised};

/// An outlier that matches better than its neighbours' disparity by more bits stays: a thin object.
const THIN_BITS: u32 = 5;
/// Left pixels this near may share a right pixel: a surface seen at a slant.
const SHARED_PX: u16 = 2;

/// Pixels that are passed over together where none is an outlier.
const BLOCK: usize = 32;

/// A row's buffers.
#[derive(Debug, Default)]
pub(crate) struct Rows {
    median: Vec<i16>,
    suspect: Vec<u8>,
    claims: Vec<u32>,
}

/// Cleans those rows of a band of raw matches whose neighbours are in it.
pub(super) fn inner_rows(
    scene: &Scene<'_>,
    height: usize,
    raw: &Band<'_>,
    buffers: &mut Rows,
    out: &mut Band<'_>,
) {
    let width = raw.width;
    let row = |y: usize| &raw.disparity[(y - raw.y) * width..][..width];
    for i in 0..raw.rows() {
        let y = raw.y + i;
        if is_inner(y, raw.y..raw.y + raw.rows(), height) {
            let around = [row(y.saturating_sub(1)), row(y), row((y + 1).min(height - 1))];
            let costs = &raw.cost[i * width..][..width];
            clean_row(scene, y, around, costs, buffers, out.row(i));
        }
    }
}

/// Cleans the rows of a band that [`inner_rows`] leaves.
pub(super) fn outer_rows(
    scene: &Scene<'_>,
    raw: &CoarseMap,
    buffers: &mut Rows,
    out: &mut Band<'_>,
) {
    let height = raw.disparity.height();
    let rows = out.y..out.y + out.rows();
    let row = |y: usize| raw.disparity.row(y);
    for y in rows.clone().filter(|y| !is_inner(*y, rows.clone(), height)) {
        let around = [row(y.saturating_sub(1)), row(y), row((y + 1).min(height - 1))];
        clean_row(scene, y, around, raw.cost.row(y), buffers, out.row(y - out.y));
    }
}

/// Whether the rows above and below `y` are among `rows`, or outside the image.
fn is_inner(y: usize, rows: Range<usize>, height: usize) -> bool {
    (y > rows.start || y == 0) && (y + 1 < rows.end || y + 1 == height)
}

/// Writes row `y`, without outliers and without those that another left pixel's match excludes, from the
/// raw rows above, at and below it.
fn clean_row(
    scene: &Scene<'_>,
    y: usize,
    around: [&[i16]; 3],
    costs: &[u8],
    Rows { median, suspect, claims }: &mut Rows,
    (disparity, cost): (&mut [i16], &mut [u8]),
) {
    let (level, width) = (scene.level, disparity.len());
    median.resize(width, 0);
    suspect.resize(width, 0);
    disparity.copy_from_slice(around[1]);
    cost.copy_from_slice(costs);
    medians(level, around, median);
    vectorised!(
        level,
        suspect_loop(
            median: &[i16] = median,
            disparity: &[i16] = disparity,
            cost: &[u8] = cost,
            suspect: &mut [u8] = suspect,
        )
    );
    vectorised!(
        level,
        settle_loop(
            rows: (&[u64], &[u64]) = (scene.left.row(y), scene.right.row(y)),
            median: &[i16] = median,
            suspect: &[u8] = suspect,
            disparity: &mut [i16] = disparity,
            cost: &mut [u8] = cost,
        )
    );
    left_right(level, disparity, cost, claims);
}

/// The left-right check: a right pixel belongs to the left pixel that matches it best; others that
/// claim it from farther away are occluded or wrong, and become invalid.
fn left_right(level: Level, disparity: &mut [i16], cost: &[u8], claims: &mut Vec<u32>) {
    claims.clear();
    claims.resize(disparity.len() + 2 * shared::BLOCK, u32::MAX);
    shared::claim(level, disparity, cost, claims);
    shared::keep(level, claims, SHARED_PX, disparity);
}

/// Non-zero where a disparity is another than its neighbours' or matches badly.
#[inline(always)]
fn suspect_loop(median: &[i16], disparity: &[i16], cost: &[u8], suspect: &mut [u8]) {
    for (((s, m), d), c) in suspect.iter_mut().zip(median).zip(disparity).zip(cost) {
        let (low, high) = (m.saturating_sub(1), m.saturating_add(1));
        *s = u8::from(*d < low) | u8::from(*d > high) | u8::from(u32::from(*c) > UNSURE_COST);
    }
}

/// Decides between the suspects' own disparities and their neighbours' median.
#[inline(always)]
fn settle_loop(
    (left, right): (&[u64], &[u64]),
    median: &[i16],
    suspect: &[u8],
    disparity: &mut [i16],
    cost: &mut [u8],
) {
    let width = median.len();
    let (left, right) = (&left[MARGIN..][..width], &right[MARGIN..][..width]);
    for (block, suspects) in suspect.chunks(BLOCK).enumerate() {
        if suspects.iter().fold(0, |any, s| any | s) == 0 {
            continue;
        }
        for (x, _) in (block * BLOCK..).zip(suspects).filter(|(_, s)| **s != 0) {
            let bits = |d: i32| {
                let at = usize::try_from(x as i32 - d).ok()?;
                Some((left[x] ^ right.get(at)?).count_ones())
            };
            settle(median[x], bits, &mut disparity[x], &mut cost[x]);
        }
    }
}

/// Decides between a pixel's own disparity and its neighbours' `median`.
#[inline(always)]
fn settle(median: i16, bits: impl Fn(i32) -> Option<u32>, disparity: &mut i16, cost: &mut u8) {
    let middle = i32::from(median);
    // In a loop, which is compiled with the caller's instructions: iterators' closures are not always.
    let mut around: Option<(u32, i32)> = None;
    for d in middle - 1..=middle + 1 {
        let here = if median == INVALID { None } else { bits(d) };
        if let Some(bits) = here
            && around.is_none_or(|(least, _)| bits < least)
        {
            around = Some((bits, d));
        }
    }
    let own = if *disparity == INVALID { u32::MAX } else { u32::from(*cost) };
    match around {
        Some((bits, d)) if bits <= own.saturating_add(THIN_BITS) => {
            *disparity = d as i16;
            *cost = bits as u8;
        }
        _ => {}
    }
    // Nothing that differs in so many bits is a match; neighbours cannot make it one.
    if u32::from(*cost) > UNSURE_COST + THIN_BITS {
        *disparity = INVALID;
        *cost = u8::MAX;
    }
}

fn medians(level: Level, [above, row, below]: [&[i16]; 3], out: &mut [i16]) {
    let width = out.len();
    for x in [0, width - 1] {
        let (a, b) = (x.saturating_sub(1), (x + 1).min(width - 1));
        out[x] = median([
            above[a], above[x], above[b], row[a], row[x], row[b], below[a], below[x], below[b],
        ]);
    }
    if width < 3 {
        return;
    }
    vectorised!(
        level,
        medians_loop(
            above: &[i16] = above,
            row: &[i16] = row,
            below: &[i16] = below,
            out: &mut [i16] = &mut out[1..width - 1],
        )
    );
}

#[inline(always)]
fn medians_loop(above: &[i16], row: &[i16], below: &[i16], out: &mut [i16]) {
    let n = out.len();
    let (a0, a1, a2) = (&above[..n], &above[1..n + 1], &above[2..n + 2]);
    let (b0, b1, b2) = (&row[..n], &row[1..n + 1], &row[2..n + 2]);
    let (c0, c1, c2) = (&below[..n], &below[1..n + 1], &below[2..n + 2]);
    for i in 0..n {
        out[i] = median([a0[i], a1[i], a2[i], b0[i], b1[i], b2[i], c0[i], c1[i], c2[i]]);
    }
}

/// Median of nine: columns sorted, then the median of the largest low, middle middle and smallest
/// high.
#[inline(always)]
fn median(v: [i16; 9]) -> i16 {
    let sort = |a: i16, b: i16, c: i16| {
        let (lo, hi) = (a.min(b), a.max(b));
        (lo.min(c), lo.max(hi.min(c)), hi.max(c))
    };
    let middle = |a: i16, b: i16, c: i16| a.min(b).max(a.max(b).min(c));
    let (l0, m0, h0) = sort(v[0], v[3], v[6]);
    let (l1, m1, h1) = sort(v[1], v[4], v[7]);
    let (l2, m2, h2) = sort(v[2], v[5], v[8]);
    middle(l0.max(l1).max(l2), middle(m0, m1, m2), h0.min(h1).min(h2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Random;

    #[test]
    fn median_is_the_fifth_of_nine() {
        let mut random = Random::new(4);
        for _ in 0..2000 {
            let v: [i16; 9] = std::array::from_fn(|_| (random.bits() % 12) as i16);
            let mut sorted = v;
            sorted.sort_unstable();
            assert_eq!(median(v), sorted[4]);
        }
    }

    #[test]
    fn a_right_pixel_keeps_one_owner() {
        let mut map = CoarseMap::new(12, 1);
        // Pixels 4 and 9 claim right pixel 3; 9 matches better.
        map.disparity.set(4, 0, 1);
        map.cost.set(4, 0, 9);
        map.disparity.set(9, 0, 6);
        map.cost.set(9, 0, 2);
        let CoarseMap { disparity, cost } = &mut map;
        left_right(Level::best(), disparity.as_mut_slice(), cost.as_slice(), &mut Vec::new());
        assert_eq!(map.disparity.get(4, 0), Some(INVALID));
        assert_eq!(map.disparity.get(9, 0), Some(6));
    }
}
