//! The coarse search: a whole-pixel disparity for every pixel, from 64-bit signatures.
//!
//! A brute-force search looks at every candidate for every pixel. Here every second pixel of every
//! 16th row does; each block then tries what the seeds around it found. Where a pixel matches none
//! of that well, some like it search the whole range, so that an object between the seeds is not
//! lost.

mod clean;
mod dark;
pub(crate) mod descriptor;
pub(crate) mod hamming;
mod search;
mod shared;

use rayon::prelude::*;

use crate::{DisparityRange, Image, Level, StereoStack, parallel::PerThread};
pub(crate) use dark::is_dark;
use descriptor::Descriptors;
use search::{Scene, Search};

/// A disparity that is none.
pub const INVALID: i16 = i16::MIN;

/// Whole-pixel disparities and in how many of 64 bits they differ.
#[derive(Debug, Clone)]
pub struct CoarseMap {
    /// Disparity in px, or [`INVALID`].
    pub disparity: Image<i16>,
    /// Bits that differ.
    pub cost: Image<u8>,
}

impl CoarseMap {
    /// An empty map.
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            disparity: Image::new(width, height, INVALID),
            cost: Image::new(width, height, u8::MAX),
        }
    }

    /// Its rows, some at a time.
    fn bands(&mut self, rows: usize) -> impl IndexedParallelIterator<Item = Band<'_>> {
        let width = self.disparity.width();
        let disparities = self.disparity.as_mut_slice().par_chunks_mut(width * rows);
        let costs = self.cost.as_mut_slice().par_chunks_mut(width * rows);
        disparities.zip(costs).enumerate().map(move |(band, (disparity, cost))| Band {
            y: band * rows,
            width,
            disparity,
            cost,
        })
    }

    fn fit(&mut self, width: usize, height: usize) {
        if (self.disparity.width(), self.disparity.height()) != (width, height) {
            *self = Self::new(width, height);
        }
    }
}

/// Rows of a map that a task writes.
struct Band<'a> {
    y: usize,
    width: usize,
    disparity: &'a mut [i16],
    cost: &'a mut [u8],
}

impl Band<'_> {
    fn rows(&self) -> usize {
        self.disparity.len() / self.width
    }

    /// Its `i`th row: disparities and costs.
    fn row(&mut self, i: usize) -> (&mut [i16], &mut [u8]) {
        let (from, width) = (i * self.width, self.width);
        (&mut self.disparity[from..][..width], &mut self.cost[from..][..width])
    }
}

/// The coarse search; keeps its buffers between frames.
#[derive(Debug)]
pub struct Coarse {
    level: Level,
    range: DisparityRange,
    left: Descriptors,
    right: Descriptors,
    scratch: descriptor::Scratch,
    search: Search,
    raw: CoarseMap,
    rows: PerThread<clean::Rows>,
}

impl Coarse {
    /// A search over the given candidates.
    pub fn new(level: Level, range: DisparityRange) -> Self {
        Self {
            level: level.usable(),
            range,
            left: Descriptors::default(),
            right: Descriptors::default(),
            scratch: descriptor::Scratch::default(),
            search: Search::default(),
            raw: CoarseMap::new(0, 0),
            rows: PerThread::default(),
        }
    }

    /// Descriptors of both sides, the first stage of [`Coarse::search`].
    pub fn describe(&mut self, stack: &StereoStack<'_>) {
        self.left.describe(self.level, stack.left, &mut self.scratch);
        self.right.describe(self.level, stack.right, &mut self.scratch);
    }

    /// Fills `map` from the descriptors of the last [`Coarse::describe`], which must have been given
    /// the same checked stack. Without `clean`, no outlier is replaced and no left-right check made.
    pub fn search(&mut self, stack: &StereoStack<'_>, clean: bool, map: &mut CoarseMap) {
        let (width, height) = (stack.width(), stack.height());
        map.fit(width, height);
        self.raw.fit(width, height);
        let scene = Scene {
            level: self.level,
            range: self.range,
            left: &self.left,
            right: &self.right,
            images: stack.left,
            left_mask: stack.left_mask,
            right_mask: stack.right_mask,
        };
        if !clean {
            self.search.run(&scene, map);
            return;
        }
        self.search.run_clean(&scene, self.rows.ready(), &mut self.raw, map);
    }

    /// What [`Coarse::search`] is measured against: every candidate for every pixel.
    pub fn search_all(&mut self, stack: &StereoStack<'_>, map: &mut CoarseMap) {
        let (width, height) = (stack.width(), stack.height());
        map.fit(width, height);
        for y in 0..height {
            let (left, right) = (self.left.row(y), self.right.row(y));
            for x in 0..width {
                let best = (self.range.min_px..=self.range.max_px)
                    .filter(|d| (0..width as i32).contains(&(x as i32 - d)))
                    .map(|d| {
                        let at = (x as i32 - d) as usize + descriptor::MARGIN;
                        ((left[x + descriptor::MARGIN] ^ right[at]).count_ones(), d)
                    })
                    .min();
                map.disparity.set(x, y, best.map_or(INVALID, |b| b.1 as i16));
                map.cost.set(x, y, best.map_or(u8::MAX, |b| b.0 as u8));
            }
        }
    }
}
