//! Where to look: seeds over the whole range on few pixels, then each block among its neighbours'
//! seeds, and over the whole range again where that finds no match.

use rayon::prelude::*;

use super::{
    CoarseMap, INVALID,
    descriptor::{Descriptors, MARGIN},
    hamming::{BLOCK, best_candidates},
};
use crate::{DisparityRange, Image, Level, Sample, parallel::PerThread};

/// Rows between seed rows, and rows of a block.
pub(crate) const SEED_ROWS: usize = 16;
/// A seed that differs in more bits is none.
const SEED_COST: u32 = 14;
/// A match that differs in more bits than this is looked for over the whole range...
pub(crate) const UNSURE_COST: u32 = 15;
/// ...and what is found there must differ in no more than this; with few frames, whose tests reach beyond
/// a thin object, in no more than that.
const FOUND_COST: u32 = 11;
const FOUND_COST_FEW: u32 = 13;
/// Fewest frames that are not few.
const FRAMES_MANY: usize = 6;
/// Samples over time and the four neighbours span less where no dot is: 3 grey levels.
const DARK: i16 = 3 * crate::SAMPLES_PER_DN8;

/// Candidates as bits.
#[derive(Debug, Default, Clone)]
struct Set {
    words: Vec<u64>,
}

impl Set {
    fn clear(&mut self, count: usize) {
        self.words.clear();
        self.words.resize(count.div_ceil(64), 0);
    }

    fn insert(&mut self, at: usize) {
        self.words[at / 64] |= 1 << (at % 64);
    }

    fn contains(&self, at: usize) -> bool {
        self.words[at / 64] >> (at % 64) & 1 == 1
    }

    /// Bits of the word's lower neighbour shifted in, and of the upper one.
    fn beside(&self, i: usize) -> (u64, u64) {
        let below = if i > 0 { self.words[i - 1] >> 63 } else { 0 };
        let above = self.words.get(i + 1).map_or(0, |w| w << 63);
        (self.words[i] << 1 | below, self.words[i] >> 1 | above)
    }

    /// Calls `f` for every member and its neighbours, in order, below `count`.
    fn widened(&self, count: usize, mut f: impl FnMut(usize)) {
        for i in 0..self.words.len() {
            let (up, down) = self.beside(i);
            let mut bits = self.words[i] | up | down;
            while bits != 0 {
                let at = i * 64 + bits.trailing_zeros() as usize;
                if at < count {
                    f(at);
                }
                bits &= bits - 1;
            }
        }
    }
}

/// The search's buffers.
#[derive(Debug, Default)]
pub(crate) struct Search {
    /// Best disparity of every second pixel of the seed rows; [`INVALID`] where none.
    seeds: Vec<i16>,
    scratch: PerThread<Scratch>,
}

#[derive(Debug, Default)]
struct Scratch {
    even: Vec<u64>,
    odd: Vec<u64>,
    left: Vec<u64>,
    shifts: Vec<i32>,
    best: Vec<u32>,
    once: Set,
    twice: Set,
    fresh: Set,
}

/// What a search reads.
pub(crate) struct Scene<'a> {
    pub level: Level,
    pub range: DisparityRange,
    pub left: &'a Descriptors,
    pub right: &'a Descriptors,
    /// Left images, to tell dark pixels.
    pub images: &'a [&'a Image<Sample>],
}

impl Scene<'_> {
    fn count(&self) -> usize {
        (self.range.max_px - self.range.min_px + 1) as usize
    }
}

impl Search {
    /// Fills `map` with each pixel's best candidate.
    pub(crate) fn run(&mut self, scene: &Scene<'_>, map: &mut CoarseMap) {
        let (width, height) = (map.disparity.width(), map.disparity.height());
        let half = width.div_ceil(2);
        let bands = height.div_ceil(SEED_ROWS);
        self.seeds.resize(half * bands, INVALID);
        let scratch = self.scratch.ready();
        self.seeds.par_chunks_mut(half).enumerate().for_each(|(band, seeds)| {
            let y = (band * SEED_ROWS + SEED_ROWS / 2).min(height - 1);
            scratch.with(|s| seed_row(scene, y, s, seeds));
        });
        let seeds = &self.seeds;
        map.disparity
            .as_mut_slice()
            .par_chunks_mut(width * SEED_ROWS)
            .zip(map.cost.as_mut_slice().par_chunks_mut(width * SEED_ROWS))
            .enumerate()
            .for_each(|(band, (disparity, cost))| {
                let first = band.saturating_sub(1) * half;
                let last = (band + 2).min(bands) * half;
                let mut out = Band { y: band * SEED_ROWS, width, disparity, cost };
                scratch.with(|s| {
                    for x in (0..width).step_by(BLOCK) {
                        search_block(scene, &seeds[first..last], x, s, &mut out);
                    }
                });
            });
    }
}

/// Rows of the result that a task writes.
struct Band<'a> {
    y: usize,
    width: usize,
    disparity: &'a mut [i16],
    cost: &'a mut [u8],
}

/// Searches every second pixel of row `y` over the whole range.
fn seed_row(scene: &Scene<'_>, y: usize, s: &mut Scratch, seeds: &mut [i16]) {
    let (min, max) = (i64::from(scene.range.min_px), i64::from(scene.range.max_px));
    let width = scene.left.width() as i64;
    let right = scene.right.row(y);
    s.even.clear();
    s.even.extend(right.iter().step_by(2));
    s.odd.clear();
    s.odd.extend(right.iter().skip(1).step_by(2));
    s.left.clear();
    s.left.extend(scene.left.row(y)[MARGIN..].iter().step_by(2));
    s.left.truncate(seeds.len().next_multiple_of(BLOCK));
    s.left.resize(seeds.len().next_multiple_of(BLOCK), 0);
    let mut best = [0u32; BLOCK];
    for block in (0..seeds.len()).step_by(BLOCK) {
        let x = 2 * block as i64;
        // Where at least one of the block's pixels has a counterpart.
        let reach = 2 * BLOCK as i64 - 2;
        let from = min.max(x - (width - 1));
        let to = max.min(x + reach);
        let mut winner = [u64::MAX; BLOCK];
        for (parity, row) in [(0, &s.even), (1, &s.odd)] {
            s.shifts.clear();
            let first = from + (from - parity).rem_euclid(2);
            let shift = |d: i64| ((d + parity) / 2) as i32;
            s.shifts.extend((first..=to).step_by(2).map(shift));
            let origin = MARGIN / 2 + block;
            best_candidates(
                scene.level,
                &s.left[block..block + BLOCK],
                row,
                origin,
                &s.shifts,
                &mut best,
            );
            for (w, b) in winner.iter_mut().zip(best) {
                let d = first + 2 * i64::from(b & 0xFFFF);
                *w = (*w).min(u64::from(b >> 16) << 32 | (d - min) as u64);
            }
        }
        for (i, (seed, w)) in seeds[block..].iter_mut().zip(winner).enumerate() {
            let d = (w & 0xFFFF_FFFF) as i64 + min;
            let counterpart = x + 2 * i as i64 - d;
            let good = (w >> 32) as u32 <= SEED_COST && (0..width).contains(&counterpart);
            *seed = if good { d as i16 } else { INVALID };
        }
    }
}

/// Searches a block of [`BLOCK`] x [`SEED_ROWS`] pixels from column `x`.
fn search_block(scene: &Scene<'_>, seeds: &[i16], x: usize, s: &mut Scratch, out: &mut Band<'_>) {
    let count = scene.count();
    let min = scene.range.min_px;
    let half = out.width.div_ceil(2);
    s.once.clear(count);
    s.twice.clear(count);
    let from = (x / 2).saturating_sub(BLOCK / 4);
    let to = (x / 2 + BLOCK / 2 + BLOCK / 4).min(half);
    for row in seeds.chunks_exact(half) {
        for &seed in row[from..to].iter().filter(|&&d| d != INVALID) {
            let at = (i32::from(seed) - min) as usize;
            if s.once.contains(at) {
                s.twice.insert(at);
            } else {
                s.once.insert(at);
            }
        }
    }
    // A single seed that no other supports is chance.
    s.fresh.clear(count);
    for i in 0..s.once.words.len() {
        let (up, down) = s.once.beside(i);
        s.fresh.words[i] = s.once.words[i] & (s.twice.words[i] | up | down);
    }
    std::mem::swap(&mut s.once, &mut s.fresh);
    let rows = out.disparity.len() / out.width;
    shifts_for(scene, &s.once, x, out.width, &mut s.shifts);
    let mut unsure = 0;
    for row in 0..rows {
        let mut best = [0; BLOCK];
        match_row(scene, out.y + row, x, &s.shifts, &mut best);
        unsure += write_row(&s.shifts, row, x, &best, false, out);
    }
    if unsure == 0 {
        return;
    }
    // Every fourth of the unsure pixels looks everywhere; what they find, all others try.
    s.fresh.clear(count);
    let mut found = 0;
    for row in (0..rows).step_by(2) {
        // Rows in turn look at even and at odd columns: a wire aslant may lie on one kind alone.
        for column in (row / 2 % 2..BLOCK.min(out.width - x)).step_by(2) {
            if u32::from(out.cost[row * out.width + x + column]) <= UNSURE_COST {
                continue;
            }
            let y = out.y + row;
            if is_dark(scene.images, x + column, y) {
                continue;
            }
            if let Some(d) = search_pixel(scene, x + column, y, &mut s.left, &mut s.best) {
                let at = (d - min) as usize;
                if !s.once.contains(at) {
                    s.fresh.insert(at);
                    found += 1;
                }
            }
        }
    }
    if found == 0 {
        return;
    }
    shifts_for(scene, &s.fresh, x, out.width, &mut s.shifts);
    for row in 0..rows {
        let mut best = [0; BLOCK];
        match_row(scene, out.y + row, x, &s.shifts, &mut best);
        write_row(&s.shifts, row, x, &best, true, out);
    }
}

/// Disparities of a set and their neighbours that have a counterpart for some pixel of the block.
fn shifts_for(scene: &Scene<'_>, set: &Set, x: usize, width: usize, shifts: &mut Vec<i32>) {
    let (min, count) = (scene.range.min_px, scene.count());
    shifts.clear();
    let from = x as i32 - (width as i32 - 1);
    let to = x as i32 + BLOCK as i32 - 1;
    set.widened(count, |at| {
        let d = min + at as i32;
        if (from..=to).contains(&d) {
            shifts.push(d);
        }
    });
}

fn match_row(scene: &Scene<'_>, y: usize, x: usize, shifts: &[i32], best: &mut [u32; BLOCK]) {
    let left = &scene.left.row(y)[MARGIN + x..][..BLOCK];
    best_candidates(scene.level, left, scene.right.row(y), MARGIN + x, shifts, best);
}

/// Stores a block's row; with `better`, only where the cost is lower. Returns the unsure pixels.
fn write_row(
    shifts: &[i32],
    row: usize,
    x: usize,
    best: &[u32; BLOCK],
    better: bool,
    out: &mut Band<'_>,
) -> usize {
    let columns = BLOCK.min(out.width - x);
    let at = row * out.width + x;
    let disparity = &mut out.disparity[at..at + columns];
    let cost = &mut out.cost[at..at + columns];
    let mut unsure = 0;
    for (i, (d, c)) in disparity.iter_mut().zip(cost).enumerate() {
        let bits = best[i] >> 16;
        let shift = shifts.get((best[i] & 0xFFFF) as usize).copied();
        let shift = shift.filter(|&s| (0..out.width as i32).contains(&((x + i) as i32 - s)));
        match shift {
            Some(shift) if !better || bits < u32::from(*c) => {
                *d = shift as i16;
                *c = bits as u8;
            }
            None if !better => {
                *d = INVALID;
                *c = u8::MAX;
            }
            _ => {}
        }
        unsure += usize::from(u32::from(*c) > UNSURE_COST);
    }
    unsure
}

/// Whether no dot ever lights the pixel or its neighbours two pixels away.
pub(crate) fn is_dark(images: &[&Image<Sample>], x: usize, y: usize) -> bool {
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
    high.saturating_sub(low) < DARK
}

/// The whole range for one pixel; `None` where nothing matches well.
fn search_pixel(
    scene: &Scene<'_>,
    x: usize,
    y: usize,
    left: &mut Vec<u64>,
    best: &mut Vec<u32>,
) -> Option<i32> {
    let width = scene.left.width() as i64;
    let from = (x as i64 - i64::from(scene.range.max_px)).max(0);
    let to = (x as i64 - i64::from(scene.range.min_px)).min(width - 1);
    if from > to {
        return None;
    }
    let count = (to - from + 1) as usize;
    let row = scene.right.row(y);
    let origin = MARGIN + from as usize;
    let padded = count.next_multiple_of(BLOCK);
    left.clear();
    left.resize(padded, scene.left.row(y)[MARGIN + x]);
    best.resize(padded, 0);
    best_candidates(scene.level, left, row, origin, &[0], best);
    let lowest = best[..count].iter().copied().min()?;
    let most = if scene.images.len() < FRAMES_MANY { FOUND_COST_FEW } else { FOUND_COST };
    if lowest >> 16 > most {
        return None;
    }
    let at = best[..count].iter().position(|&b| b == lowest)?;
    Some((x as i64 - (from + at as i64)) as i32)
}
