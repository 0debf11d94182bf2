//! Which pixels no dot ever lights: there is nothing to find.

use super::hamming::BLOCK;
use crate::{Image, Level, SAMPLES_PER_DN8, Sample, lanes::vectorised};

/// Samples over time and the four neighbours two pixels away span less where no dot is: 3 grey levels.
const DARK: i16 = 3 * SAMPLES_PER_DN8;

/// Which of the block of pixels that begins at `x`, `y` are lit, as bits; only those of `columns` count.
pub(super) fn lit(
    level: Level,
    images: &[&Image<Sample>],
    (x, y): (usize, usize),
    columns: impl Iterator<Item = usize> + Clone,
) -> u32 {
    let (width, height) = (images[0].width(), images[0].height());
    // At the left and the right end some of a block's pixels are looked at one by one.
    let inside = if width < BLOCK + 4 { 0..0 } else { 2..width - 2 };
    let from = x.min(inside.end.saturating_sub(BLOCK)).max(inside.start);
    let (mut low, mut high) = ([i16::MAX; BLOCK], [i16::MIN; BLOCK]);
    // Most that are lit at all are so in their own row.
    for rows in [&[y][..], &[y.saturating_sub(2), (y + 2).min(height - 1)]] {
        let mut bits = 0;
        if !inside.is_empty() {
            vectorised!(
                level,
                extremes_loop(
                    images: &[&Image<Sample>] = images,
                    x: usize = from,
                    rows: &[usize] = rows,
                    beside: bool = rows.len() == 1,
                    low: &mut [i16; BLOCK] = &mut low,
                    high: &mut [i16; BLOCK] = &mut high,
                )
            );
        }
        for column in columns.clone() {
            let x = x + column;
            let is_lit = match x.checked_sub(from).filter(|_| inside.contains(&x)) {
                Some(i) => high[i].saturating_sub(low[i]) >= DARK,
                None => !is_dark(images, x, y),
            };
            bits |= u32::from(is_lit) << column;
        }
        if columns.clone().all(|column| bits >> column & 1 != 0) || rows.len() > 1 {
            return bits;
        }
    }
    0
}

/// Widens the ranges of a block's samples by those of some rows; of pixels two to either side, with
/// `beside`.
#[inline(always)]
fn extremes_loop(
    images: &[&Image<Sample>],
    x: usize,
    rows: &[usize],
    beside: bool,
    low: &mut [i16; BLOCK],
    high: &mut [i16; BLOCK],
) {
    for image in images {
        for &y in rows {
            let row = image.row(y);
            let starts = if beside { [x - 2, x, x + 2] } else { [x; 3] };
            for start in &starts[..if beside { 3 } else { 1 }] {
                let samples = &row[*start..][..BLOCK];
                for i in 0..BLOCK {
                    low[i] = low[i].min(samples[i]);
                    high[i] = high[i].max(samples[i]);
                }
            }
        }
    }
}

/// Whether no dot ever lights the pixel or its neighbours two pixels away.
pub(crate) fn is_dark(images: &[&Image<Sample>], x: usize, y: usize) -> bool {
    span(images, x, y) < DARK
}

fn span(images: &[&Image<Sample>], x: usize, y: usize) -> i16 {
    let (width, height) = (images[0].width(), images[0].height());
    let columns = [x.saturating_sub(2), x, (x + 2).min(width - 1)];
    let rows = [y.saturating_sub(2), (y + 2).min(height - 1)];
    let (mut low, mut high) = (i16::MAX, i16::MIN);
    for image in images {
        let row = image.row(y);
        let beside = columns.map(|c| row[c]);
        for v in beside.into_iter().chain(rows.map(|r| image.row(r)[x])) {
            (low, high) = (low.min(v), high.max(v));
        }
    }
    high.saturating_sub(low)
}
