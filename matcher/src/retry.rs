//! The second try with a larger window, for points that the first could not match reliably.
//!
//! The paper tries points of low similarity again; we also try those that fail uniqueness or the
//! left-right check, and hold the second match to the same two checks. Both sides' descriptors have
//! the larger window there, so that the check compares like with like.

use crate::{
    Level, Params,
    census::{CensusKernel, CensusRow, PaddedStack},
    cost::{CostKernel, CostLine},
    search::{Point, candidates, point},
    wta,
};

/// Least similarity of a match by the larger window. Of some hundred unrelated candidates the best is
/// at 0.6 to 0.7 by chance; a match is above 0.75 even in noise of a tenth of the dots' height.
pub const SIMILARITY_MIN: f32 = 0.7;

/// Rows and lines that a task needs, reused from row to row.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    left: CensusRow,
    right: CensusRow,
    line: CostLine,
}

/// Matches the columns `again` of row `y` once more and hands each accepted match to `accept`.
#[allow(clippy::too_many_arguments)]
pub(crate) fn retry_row(
    scratch: &mut Scratch,
    left: &PaddedStack,
    right: &PaddedStack,
    y: usize,
    again: &[usize],
    params: &Params,
    level: Level,
    mut accept: impl FnMut(usize, Point),
) {
    let (census, kernel) = (CensusKernel::new(level), CostKernel::new(level));
    let Scratch { left: left_row, right: right_row, line } = scratch;
    let radius = params.advanced.retry_radius;
    left_row.fill(left, y, radius, census);
    right_row.fill(right, y, radius, census);
    let margin = params.advanced.uniqueness * left_row.bits_inside() as f32;
    for &x in again {
        line.fill(left_row, x, right_row, candidates(x, params), kernel);
        let Some(winner) = wta::winner(line, kernel).filter(|w| w.is_unique(margin)) else {
            continue;
        };
        let point = point(x, line, winner, left_row.bits_inside());
        if point.similarity < SIMILARITY_MIN {
            continue;
        }
        // The right pixel's own best partner: left columns of the same disparities.
        let range = params.disparity;
        let column = winner.column as i64;
        let partners = column + range.min_px as i64..column + range.max_px as i64 + 1;
        line.fill(right_row, winner.column, left_row, partners, kernel);
        let Some(back) = wta::winner(line, kernel) else { continue };
        let back = back.column as f32 - winner.column as f32;
        if (back - point.disparity_px).abs() <= params.advanced.left_right_px {
            accept(x, point);
        }
    }
}
