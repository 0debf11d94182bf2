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

use crate::{Image, Level, StereoStack, lanes::vectorised, parallel::PerThread, regions::joined};
use candidates::plane;
use decide::Judge;
pub use decide::{FRAMES_MIN, LIGHT_MIN, NEXT_LIGHT_MIN, SIMILARITY_MIN};

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

/// Judges pixels at depth steps; keeps its buffers between frames.
#[derive(Debug)]
pub struct StepJudge {
    level: Level,
    near: Image<u8>,
    beside: Image<u8>,
    /// Pixels to judge in a pass, and what takes their disparity's place.
    open: Vec<u32>,
    proposals: Vec<Option<Option<f32>>>,
    columns: PerThread<Vec<u8>>,
}

impl StepJudge {
    /// A judge that marks steps with the kernels of `level`.
    pub fn new(level: Level) -> Self {
        let none = || Image::new(0, 0, 0);
        Self {
            level: level.usable(),
            near: none(),
            beside: none(),
            open: Vec::new(),
            proposals: Vec::new(),
            columns: PerThread::default(),
        }
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
        assert_eq!((disparity_px.width(), disparity_px.height()), (width, height));
        assert_eq!((verdicts.width(), verdicts.height()), (width, height));
        verdicts.as_mut_slice().fill(Verdict::Kept);
        if (self.near.width(), self.near.height()) != (width, height) {
            self.beside = Image::new(width, height, 0);
            self.near = Image::new(width, height, 0);
        }
        if stack.frames() < FRAMES_MIN {
            self.beside.as_mut_slice().fill(0);
            return;
        }
        self.mark_beside(stack, disparity_px);
        self.open.clear();
        let marks = self.beside.as_slice().iter().enumerate();
        self.open.extend(marks.filter(|(_, b)| **b != 0).map(|(i, _)| i as u32));
        for _ in 0..PASSES {
            let judge = Judge { stack, disparity_px, beside: &self.beside };
            self.proposals.resize(self.open.len(), None);
            self.open.par_iter().zip(&mut self.proposals).with_min_len(64).for_each(|(&i, to)| {
                *to = judge.pixel(i as usize % width, i as usize / width);
            });
            let mut changed = 0;
            for k in 0..self.open.len() {
                let Some(to) = self.proposals[k] else { continue };
                let i = self.open[k] as usize;
                disparity_px.as_mut_slice()[i] = to.unwrap_or(f32::NAN);
                verdicts.as_mut_slice()[i] = to.map_or(Verdict::Removed, |_| Verdict::Moved);
                self.open[changed] = i as u32;
                changed += 1;
            }
            if changed == 0 {
                break;
            }
            self.open.truncate(changed);
            // What the changed pixels hid is beside a step or a gap now.
            for k in 0..changed {
                let (x, y) = (self.open[k] as usize % width, self.open[k] as usize / width);
                for (nx, ny) in around(x, y, width, height) {
                    let n = ny * width + nx;
                    if verdicts.as_slice()[n] == Verdict::Kept
                        && is_beside(stack, disparity_px, nx, ny)
                    {
                        self.beside.as_mut_slice()[n] = 1;
                        self.open.push(n as u32);
                    }
                }
            }
            self.open.drain(..changed);
            self.open.sort_unstable();
            self.open.dedup();
        }
    }

    /// The pixels (non-zero) near the steps of the last map judged: subsets there may hold another
    /// surface.
    pub fn near(&mut self) -> &Image<u8> {
        self.mark_near();
        &self.near
    }

    /// Marks valid pixels with a step or a gap to one of their four neighbours.
    fn mark_beside(&mut self, stack: &StereoStack<'_>, disparity_px: &Image<f32>) {
        let (width, height) = (disparity_px.width(), disparity_px.height());
        let level = self.level;
        self.beside.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            let (above, below) = (y.saturating_sub(1), (y + 1).min(height - 1));
            vectorised!(
                level,
                mark_row(
                    rows: [&[f32]; 3] = [above, y, below].map(|y| disparity_px.row(y)),
                    out: &mut [u8] = out,
                )
            );
            for (x, out) in out.iter_mut().enumerate().filter(|(_, out)| **out != 0) {
                *out = u8::from(is_beside(stack, disparity_px, x, y));
            }
        });
    }

    /// Marks all pixels within [`NEAR_RADIUS`] of those beside steps.
    fn mark_near(&mut self) {
        let (width, height) = (self.beside.width(), self.beside.height());
        let (level, beside, columns) = (self.level, &self.beside, self.columns.ready());
        self.near.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            columns.with(|column| {
                column.clear();
                column.resize(width + 2 * NEAR_RADIUS, 0);
                for row in y.saturating_sub(NEAR_RADIUS)..(y + NEAR_RADIUS + 1).min(height) {
                    let marks = column[NEAR_RADIUS..].iter_mut().zip(beside.row(row));
                    marks.for_each(|(c, b)| *c |= b);
                }
                vectorised!(level, widen(column: &[u8] = column, out: &mut [u8] = out));
            });
        });
    }
}

/// Whether left pixel (x, y), continued from a neighbour of disparity `own_px`, is outside a camera's
/// view.
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

/// Marks the middle row's valid pixels with a step or a gap to one of their four neighbours.
#[inline(always)]
fn mark_row(rows: [&[f32]; 3], out: &mut [u8]) {
    let width = out.len();
    let [above, row, below] = rows.map(|r| &r[..width]);
    for x in 0..width {
        let own = row[x];
        out[x] = u8::from(!own.is_nan() & (is_far(above[x], own) | is_far(below[x], own)));
    }
    for x in 1..width {
        let step = is_far(row[x - 1], row[x]);
        out[x] |= u8::from(step & !row[x].is_nan());
        out[x - 1] |= u8::from(step & !row[x - 1].is_nan());
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
