//! The coarse search: every candidate of every pixel, row by row.
//!
//! A row's costs never leave the cache: the pixel's line of costs goes straight into winner takes
//! all, the parabola, and the right image's own winners for the left-right check. Points that fail a
//! check get a second try with a larger window ([`crate::retry`]).

use rayon::prelude::*;

use crate::{
    Image, Level, Params,
    census::{CensusKernel, CensusRow, PaddedStack},
    cost::{CostKernel, CostLine, NO_CANDIDATE},
    parabola, retry, wta,
};

/// Result of the search, on the left canvas.
#[derive(Debug, Clone)]
pub struct Coarse {
    /// Disparity with the parabola's fraction; NaN where no match passed the checks.
    pub disparity_px: Image<f32>,
    /// Similarity 1 - cost of that match (eq 4); NaN where the disparity is.
    pub similarity: Image<f32>,
}

/// A match of one pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Point {
    pub disparity_px: f32,
    pub similarity: f32,
}

/// Rows and lines that a task needs, reused from row to row.
#[derive(Debug, Default)]
struct Scratch {
    left: CensusRow,
    right: CensusRow,
    line: CostLine,
    best_cost: Vec<u16>,
    best_x: Vec<u16>,
    found: Vec<Option<(Point, wta::Winner)>>,
    again: Vec<usize>,
    retry: retry::Scratch,
}

/// Finds for every left pixel the right pixel with the most similar descriptor.
///
/// # Panics
/// When the stacks differ in size, or are wider than 65 535 pixels.
pub fn search(left: &PaddedStack, right: &PaddedStack, params: &Params, level: Level) -> Coarse {
    let (width, height) = (left.width(), left.height());
    assert_eq!((width, height, left.frames()), (right.width(), right.height(), right.frames()));
    assert!(width <= u16::MAX as usize);
    let mut coarse = Coarse {
        disparity_px: Image::new(width, height, f32::NAN),
        similarity: Image::new(width, height, f32::NAN),
    };
    coarse
        .disparity_px
        .as_mut_slice()
        .par_chunks_mut(width)
        .zip(coarse.similarity.as_mut_slice().par_chunks_mut(width))
        .enumerate()
        .for_each_init(Scratch::default, |scratch, (y, (disparity, similarity))| {
            search_row(scratch, left, right, y, params, level, |x, point: Point| {
                disparity[x] = point.disparity_px;
                similarity[x] = point.similarity;
            });
        });
    coarse
}

/// Searches row `y` and hands each accepted match to `accept`.
fn search_row(
    scratch: &mut Scratch,
    left: &PaddedStack,
    right: &PaddedStack,
    y: usize,
    params: &Params,
    level: Level,
    mut accept: impl FnMut(usize, Point),
) {
    let (census, kernel) = (CensusKernel::new(level), CostKernel::new(level));
    let width = left.width();
    let Scratch { left: left_row, right: right_row, line, best_cost, best_x, found, again, retry } =
        scratch;
    let radius = params.advanced.census_radius;
    left_row.fill(left, y, radius, census);
    right_row.fill(right, y, radius, census);
    best_cost.clear();
    best_cost.resize(right_row.stride(), NO_CANDIDATE);
    best_x.clear();
    best_x.resize(right_row.stride(), 0);
    found.clear();
    for x in 0..width {
        found.push(None);
        if left_row.invalid()[x] != 0 {
            continue;
        }
        line.fill(left_row, x, right_row, candidates(x, params), kernel);
        let columns = line.first()..line.first() + line.costs().len();
        let (cost, at) = (&mut best_cost[columns.clone()], &mut best_x[columns]);
        kernel.keep_best(line.costs(), x as u16, cost, at);
        found[x] =
            wta::winner(line, kernel).map(|w| (point(x, line, w, left_row.bits_inside()), w));
    }
    again.clear();
    let margin = params.advanced.uniqueness * left_row.bits_inside() as f32;
    for (x, &found) in found.iter().enumerate() {
        let Some((point, winner)) = found else { continue };
        let back = best_x[winner.column] as f32 - winner.column as f32;
        let consistent = (back - point.disparity_px).abs() <= params.advanced.left_right_px;
        let reliable = point.similarity > params.advanced.retry_similarity;
        if reliable && consistent && winner.is_unique(margin) {
            accept(x, point);
        } else {
            again.push(x);
        }
    }
    if !again.is_empty() {
        retry::retry_row(retry, left, right, y, again, params, level, accept);
    }
}

/// Right columns of left column `x`'s candidate disparities.
pub(crate) fn candidates(x: usize, params: &Params) -> std::ops::Range<i64> {
    let range = params.disparity;
    x as i64 - range.max_px as i64..x as i64 - range.min_px as i64 + 1
}

/// The match that `winner` stands for, refined by the parabola.
pub(crate) fn point(x: usize, line: &CostLine, winner: wta::Winner, bits: usize) -> Point {
    let column = winner.column as i64;
    // Disparity falls as the column rises.
    let (below, above) = (line.at(column + 1), line.at(column - 1));
    let fraction = if below == NO_CANDIDATE || above == NO_CANDIDATE {
        0.0
    } else {
        parabola::offset(below as f32, winner.cost as f32, above as f32)
    };
    Point {
        disparity_px: (x as i64 - column) as f32 + fraction,
        similarity: 1.0 - winner.cost as f32 / bits as f32,
    }
}
