//! Which surface a pixel near a depth step shows: decided by the pixel's own grey values over time.
//!
//! A window that straddles a step matches whichever surface fills it with more contrast, so every
//! windowed search moves the step by a pixel or two, mostly towards the farther surface, and extends
//! surfaces beyond their silhouettes. N patterns make a pixel's N grey values a signature of its own.
//! At pixels beside a step or a gap this stage compares them with the right images at the disparity
//! of each surface nearby, continued to the pixel, and keeps the best, or none.
//!
//! A pixel that a surface k covers by the part f shows L = f F + (1 - f) B, and the right image at k's
//! disparity shows f F + (1 - f) B' with another part B' of the background. F and B are independent
//! patterns, so two statistics depend on f alone:
//!
//! ```text
//! light        cov(L, R_k) / (the same inside the surface)    = f^2
//! similarity   cov(L, R_k) / sqrt(var L var R_k)              = f^2 / (f^2 + (1 - f)^2)
//! ```
//!
//! The second where both surfaces are lit alike, the first also beside darkness. Both are pooled over
//! the pixel and its neighbours along the step, as one pixel may be dark by chance in all N patterns.

mod candidates;
mod decide;
mod signature;

use rayon::prelude::*;

use crate::{
    Image, Level, StereoStack,
    lanes::vectorised,
    parallel::{PerThread, Share},
    regions::joined,
};
use candidates::plane;
use decide::Judge;
pub use decide::{FRAMES_MIN, LIGHT_MIN, NEXT_LIGHT_MIN, SIMILARITY_MIN};
pub(crate) use signature::Samples;

/// Disparities of neighbours that differ by more belong to different surfaces.
pub const JUMP_PX: f32 = 1.5;

/// Pixels of one surface in the row along a step differ by less, and by [`STEEP`] more for every pixel
/// between them.
const ALONG_PX: f32 = 2.5;
const STEEP: f32 = 0.75;

/// How deep a surface is peeled: fattening is up to two pixels wide.
pub const PASSES: usize = 2;

/// How far from a step the windows of the usual size reach it.
pub const NEAR_RADIUS: usize = 5;

/// Gaps up to this wide with the same surface on both sides are dark spots.
const BRIDGE_PX: usize = 8;

/// A pixel of [`StepJudge::judge`]'s verdicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Verdict {
    /// Not near a step, or its disparity stands.
    #[default]
    Kept,
    /// Given to another surface; the disparity is that surface's, continued.
    Moved,
    /// Shows no surface nearby; its disparity is NaN now.
    Removed,
}

/// How strictly pixels are judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// How many pixels deep a surface is peeled.
    pub passes: usize,
    /// Least similarity of the grey values over time.
    pub similarity_min: f32,
    /// Least light, as a part of that inside the surface. Not looked at when 0 and the next pixel's light
    /// is known, which saves a third of the work.
    pub light_min: f32,
    /// Least light, as a part of the next pixel's inside the surface.
    pub next_light_min: f32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            passes: PASSES,
            similarity_min: SIMILARITY_MIN,
            light_min: LIGHT_MIN,
            next_light_min: NEXT_LIGHT_MIN,
        }
    }
}

/// Side of the blocks that [`StepJudge::change`] can be kept to.
pub(crate) const BLOCK: usize = 16;

/// Pixels that a task judges.
const TASK: usize = 64;

/// A mark of a pixel beside a step...
const BESIDE: u8 = 1;
/// ...whose disparity was changed.
const CHANGED: u8 = 2;

/// Judges pixels at depth steps; keeps its buffers between frames.
#[derive(Debug)]
pub struct StepJudge {
    level: Level,
    limits: Limits,
    near: Image<u8>,
    beside: Image<u8>,
    /// Pixels to judge in a pass, and what takes their disparity's place.
    open: Vec<u32>,
    proposals: Vec<Option<Option<f32>>>,
    /// Which of those that may be open are beside a step or a gap.
    bare: Vec<bool>,
    changed: Vec<u32>,
    columns: PerThread<Vec<u8>>,
}

impl StepJudge {
    /// A judge that marks steps with the kernels of `level`.
    pub fn new(level: Level) -> Self {
        let none = || Image::new(0, 0, 0);
        Self {
            level: level.usable(),
            limits: Limits::default(),
            near: none(),
            beside: none(),
            open: Vec::new(),
            proposals: Vec::new(),
            bare: Vec::new(),
            changed: Vec::new(),
            columns: PerThread::default(),
        }
    }

    /// The same judge with other limits.
    pub fn with_limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }

    /// Judges the pixels of `disparity_px` (NaN is invalid) beside steps and gaps, changes it where
    /// they show another surface or none, and says which in `verdicts`, of the same size. Where a camera's
    /// view ends is no gap. Does nothing with fewer than [`FRAMES_MIN`] frames. The result does not
    /// depend on the number of threads.
    ///
    /// # Panics
    /// When the images and the checked stack differ in size.
    pub fn judge(
        &mut self,
        stack: &StereoStack<'_>,
        disparity_px: &mut Image<f32>,
        verdicts: &mut Image<Verdict>,
    ) {
        let (width, height) = (stack.width(), stack.height());
        assert_eq!((verdicts.width(), verdicts.height()), (width, height));
        verdicts.as_mut_slice().fill(Verdict::Kept);
        for &i in self.change(stack, disparity_px, None) {
            let gone = disparity_px.as_slice()[i as usize].is_nan();
            verdicts.as_mut_slice()[i as usize] =
                if gone { Verdict::Removed } else { Verdict::Moved };
        }
    }

    /// As [`Self::judge`]; gives the places in `disparity_px` that it changed, in order. With `blocks`
    /// of [`BLOCK`] pixels a side, only those set begin to be looked at: what is peeled may reach beyond,
    /// and the map must be whole in the blocks around.
    pub(crate) fn change(
        &mut self,
        stack: &StereoStack<'_>,
        disparity_px: &mut Image<f32>,
        blocks: Option<&Image<bool>>,
    ) -> &[u32] {
        let (width, height) = (stack.width(), stack.height());
        assert_eq!((disparity_px.width(), disparity_px.height()), (width, height));
        if (self.beside.width(), self.beside.height()) != (width, height) {
            self.beside = Image::new(width, height, 0);
        }
        self.changed.clear();
        if stack.frames() < FRAMES_MIN {
            self.beside.as_mut_slice().fill(0);
            return &self.changed;
        }
        self.mark_beside(stack, disparity_px, blocks);
        self.open.clear();
        for y in 0..height {
            for_columns(blocks, y, width, |from, to| {
                let marks = self.beside.row(y)[from..to].iter().zip(y * width + from..);
                self.open.extend(marks.filter(|(b, _)| **b != 0).map(|(_, i)| i as u32));
            });
        }
        for _ in 0..self.limits.passes {
            let judge = Judge::new(stack, disparity_px, &self.beside, &self.limits);
            self.proposals.resize(self.open.len(), None);
            let level = self.level;
            let parts = self.open.par_chunks(TASK).zip(self.proposals.par_chunks_mut(TASK));
            parts.share(|(open, to)| {
                vectorised!(
                    level,
                    judge_loop(
                        judge: &Judge<'_> = &judge,
                        open: &[u32] = open,
                        to: &mut [Option<Option<f32>>] = to,
                    )
                );
            });
            let first = self.changed.len();
            for (&i, to) in self.open.iter().zip(&self.proposals) {
                let Some(to) = *to else { continue };
                disparity_px.as_mut_slice()[i as usize] = to.unwrap_or(f32::NAN);
                self.beside.as_mut_slice()[i as usize] = CHANGED;
                self.changed.push(i);
            }
            self.open.clear();
            // What the changed pixels hid is beside a step or a gap now.
            for &i in &self.changed[first..] {
                let (x, y) = (i as usize % width, i as usize / width);
                let near = around(x, y, width, height).map(|(nx, ny)| ny * width + nx);
                let near = near.filter(|&n| self.beside.as_slice()[n] != CHANGED);
                self.open.extend(near.map(|n| n as u32));
            }
            self.open.sort_unstable();
            self.open.dedup();
            self.bare.resize(self.open.len(), false);
            let parts = self.open.par_chunks(TASK).zip(self.bare.par_chunks_mut(TASK));
            let map = &*disparity_px;
            parts.share(|(open, bare)| {
                for (&i, bare) in open.iter().zip(bare) {
                    let (x, y) = (i as usize % width, i as usize / width);
                    *bare = is_beside(stack, map, x, y);
                }
            });
            let mut bare = self.bare.iter();
            self.open.retain(|_| bare.next().copied().unwrap_or(false));
            for &i in &self.open {
                self.beside.as_mut_slice()[i as usize] = BESIDE;
            }
            if self.open.is_empty() {
                break;
            }
        }
        self.changed.sort_unstable();
        &self.changed
    }

    /// The pixels (non-zero) near the steps of the last map judged: subsets there may hold another
    /// surface.
    pub fn near(&mut self) -> &Image<u8> {
        self.mark_near(None);
        &self.near
    }

    /// As [`Self::near`], told of the blocks set only.
    pub(crate) fn near_in(&mut self, blocks: &Image<bool>) -> &Image<u8> {
        self.mark_near(Some(blocks));
        &self.near
    }

    /// Marks valid pixels with a step or a gap to one of their four neighbours.
    fn mark_beside(
        &mut self,
        stack: &StereoStack<'_>,
        disparity_px: &Image<f32>,
        blocks: Option<&Image<bool>>,
    ) {
        let (width, height) = (disparity_px.width(), disparity_px.height());
        let level = self.level;
        self.beside.as_mut_slice().par_chunks_mut(width).enumerate().share(|(y, out)| {
            let (above, below) = (y.saturating_sub(1), (y + 1).min(height - 1));
            let rows = [above, y, below].map(|y| disparity_px.row(y));
            out.fill(0);
            for_columns(blocks, y, width, |from, to| {
                vectorised!(
                    level,
                    mark_row(
                        rows: [&[f32]; 3] = rows,
                        from: usize = from,
                        out: &mut [u8] = &mut out[from..to],
                    )
                );
                let marks = out[from..to].iter_mut().zip(from..);
                for (out, x) in marks.filter(|(out, _)| **out != 0) {
                    *out = u8::from(is_beside(stack, disparity_px, x, y));
                }
            });
        });
    }

    /// Marks all pixels within [`NEAR_RADIUS`] of those beside steps, in the blocks set.
    fn mark_near(&mut self, blocks: Option<&Image<bool>>) {
        let (width, height) = (self.beside.width(), self.beside.height());
        if (self.near.width(), self.near.height()) != (width, height) {
            self.near = Image::new(width, height, 0);
        }
        let (level, beside, columns) = (self.level, &self.beside, self.columns.ready());
        self.near.as_mut_slice().par_chunks_mut(width).enumerate().share(|(y, out)| {
            let rows = y.saturating_sub(NEAR_RADIUS)..(y + NEAR_RADIUS + 1).min(height);
            for_columns(blocks, y, width, |from, to| {
                columns.with(|column| {
                    let (left, right) =
                        (from.saturating_sub(NEAR_RADIUS), (to + NEAR_RADIUS).min(width));
                    column.clear();
                    column.resize(to - from + 2 * NEAR_RADIUS, 0);
                    for row in rows.clone() {
                        let marks = beside.row(row)[left..right].iter();
                        let column = &mut column[left + NEAR_RADIUS - from..];
                        column.iter_mut().zip(marks).for_each(|(c, b)| *c |= b);
                    }
                    let out = &mut out[from..to];
                    vectorised!(level, widen(column: &[u8] = column, out: &mut [u8] = out));
                });
            });
        });
    }
}

#[inline(always)]
fn judge_loop(judge: &Judge<'_>, open: &[u32], to: &mut [Option<Option<f32>>]) {
    for (&i, to) in open.iter().zip(to) {
        *to = judge.place(i as usize);
    }
}

/// Whether left pixel (x, y), continued from a neighbour of disparity `own_px`, is outside a camera's
/// view.
#[inline(always)]
fn is_hidden(stack: &StereoStack<'_>, x: usize, y: usize, own_px: f32) -> bool {
    let at = (x as f32 - own_px + 0.5).floor();
    let seen = |mask: Option<&Image<u8>>, x: usize| mask.is_none_or(|m| m.row(y)[x] != 0);
    !(seen(stack.left_mask, x)
        && at >= 0.0
        && at < stack.width() as f32
        && seen(stack.right_mask, at as usize))
}

/// Whether a pixel has a step or a gap to one of its four neighbours.
fn is_beside(stack: &StereoStack<'_>, map: &Image<f32>, x: usize, y: usize) -> bool {
    let own = map.row(y)[x];
    let step = |(nx, ny): (usize, usize)| {
        let other = map.row(ny)[nx];
        is_far(other, own)
            && if other.is_nan() {
                !is_hidden(stack, nx, ny, own) && !is_bridged(map, (x, y), (nx, ny))
            } else {
                !is_steep(map, (x, y), (nx, ny))
            }
    };
    !own.is_nan() && around(x, y, map.width(), map.height()).any(step)
}

/// Whether the gap that begins at a pixel's neighbour ends at the same surface within [`BRIDGE_PX`]: a
/// dark spot, not a silhouette.
fn is_bridged(map: &Image<f32>, (x, y): (usize, usize), (nx, ny): (usize, usize)) -> bool {
    let along = |k: usize| {
        // From x by k steps towards nx.
        let go = |from: usize, to: usize| (from + k * to).checked_sub(k * from);
        map.get(go(x, nx)?, go(y, ny)?)
    };
    let Some((k, end)) =
        (2..=BRIDGE_PX + 1).map_while(|k| Some((k as i32, along(k)?))).find(|(_, d)| !d.is_nan())
    else {
        return false;
    };
    let own = map.row(y)[x];
    let (dx, dy) = (k * (nx as i32 - x as i32), k * (ny as i32 - y as i32));
    // A steep surface goes on as a plane.
    [own, plane(map, x, y, own).at(dx, dy)].iter().any(|d| (end - d).abs() <= 2.0 * JUMP_PX)
}

/// Whether two neighbours are on different surfaces, or one of them on none.
#[inline(always)]
fn is_far(a: f32, b: f32) -> bool {
    let joined = (a - b).abs() <= JUMP_PX;
    !joined
}

/// Whether a pixel and its neighbour that is far from it are on one steep surface, whose slope goes on
/// beyond one of them.
fn is_steep(map: &Image<f32>, (x, y): (usize, usize), (nx, ny): (usize, usize)) -> bool {
    let at = |x: Option<usize>, y: Option<usize>| {
        x.zip(y).and_then(|(x, y)| map.get(x, y)).unwrap_or(f32::NAN)
    };
    let before = at((2 * x).checked_sub(nx), (2 * y).checked_sub(ny));
    let after = at((2 * nx).checked_sub(x), (2 * ny).checked_sub(y));
    joined(before, map.row(y)[x], map.row(ny)[nx], after)
}

/// Calls `work` with the ranges of columns of row `y` in blocks that are set; with the whole row without
/// blocks.
pub(crate) fn for_columns(
    blocks: Option<&Image<bool>>,
    y: usize,
    width: usize,
    mut work: impl FnMut(usize, usize),
) {
    let Some(blocks) = blocks else { return work(0, width) };
    let mut from = 0;
    for run in blocks.row(y / BLOCK).chunk_by(|a, b| a == b) {
        if run[0] {
            work(from * BLOCK, ((from + run.len()) * BLOCK).min(width));
        }
        from += run.len();
    }
}

/// Marks, in `out`, the middle row's valid pixels from column `from` on that have a step or a gap to one
/// of their four neighbours.
#[inline(always)]
fn mark_row(rows: [&[f32]; 3], from: usize, out: &mut [u8]) {
    let width = rows[1].len();
    let to = from + out.len();
    let [above, row, below] = rows.map(|r| &r[from..to]);
    for x in 0..out.len() {
        let own = row[x];
        out[x] = u8::from(!own.is_nan() & (is_far(above[x], own) | is_far(below[x], own)));
    }
    let left = from.max(1);
    let pairs = rows[1][left - 1..].iter().zip(&rows[1][left..to]);
    for (out, (left, own)) in out[left - from..].iter_mut().zip(pairs) {
        *out |= u8::from(is_far(*left, *own) & !own.is_nan());
    }
    let pairs = rows[1][(from + 1).min(width)..].iter().zip(row);
    for (out, (right, own)) in out.iter_mut().zip(pairs) {
        *out |= u8::from(is_far(*right, *own) & !own.is_nan());
    }
}

/// Marks what is within [`NEAR_RADIUS`] of a mark; `column` has that much beyond either end.
#[inline(always)]
fn widen(column: &[u8], out: &mut [u8]) {
    let width = out.len();
    out.fill(0);
    for k in 0..=2 * NEAR_RADIUS {
        let column = &column[k..k + width];
        for x in 0..width {
            out[x] |= column[x];
        }
    }
}

/// The up to four neighbours of a pixel.
pub(crate) fn around(
    x: usize,
    y: usize,
    width: usize,
    height: usize,
) -> impl Iterator<Item = (usize, usize)> {
    [
        (x > 0).then(|| (x - 1, y)),
        (x + 1 < width).then_some((x + 1, y)),
        (y > 0).then(|| (x, y - 1)),
        (y + 1 < height).then_some((x, y + 1)),
    ]
    .into_iter()
    .flatten()
}
