//! Where to look: seeds over the whole range on few pixels, then each block among its neighbours'
//! seeds, and over the whole range again where that finds no match.

use rayon::prelude::*;

use super::{
    Band, CoarseMap, INVALID, clean,
    dark::lit,
    descriptor::{Descriptors, MARGIN},
    hamming::{BLOCK, Shifts, best_candidates, nearest, untaken},
    shared,
};
use crate::{
    DisparityRange, Image, Level, Sample,
    lanes::vectorised,
    parallel::{PerThread, Share},
};

/// Rows between seed rows, and rows of a block.
pub(crate) const SEED_ROWS: usize = 16;
/// A seed that differs in more bits is none.
const SEED_COST: u32 = 14;
/// A seed that differs in no more bits from what a neighbour found is not looked for elsewhere, as long as
/// that is no farther from the neighbour's.
const CLEAR_COST: u32 = 9;
const SEED_SPREAD: i32 = 2;
/// A match that differs in more bits than this is looked for over the whole range...
pub(crate) const UNSURE_COST: u32 = 15;
/// ...and what is found there must differ in no more than this; with few frames, whose tests reach beyond
/// a thin object, in no more than that.
const FOUND_COST: u32 = 11;
const FOUND_COST_FEW: u32 = 13;
/// A right pixel whose match differs in no more bits is that match's, and no unsure pixel's.
const TAKEN_COST: u8 = 11;
/// Fewest frames that are not few.
const FRAMES_MANY: usize = 6;

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
    shifts: Shifts,
    /// Candidates of each block.
    block_shifts: Vec<Shifts>,
    once: Set,
    twice: Set,
    fresh: Set,
    /// Unsure pixels of each block.
    unsure: Vec<u32>,
    /// What unsure pixels of each block found elsewhere; empty where none did.
    found: Vec<Set>,
    free: Free,
}

/// Right pixels of a row that no good match has.
#[derive(Debug, Default)]
struct Free {
    /// Whether a match has it, with places before and after the row.
    taken: Vec<u8>,
    /// How many are free; their descriptors and columns, side by side.
    count: usize,
    descriptors: Vec<u64>,
    columns: Vec<u16>,
}

/// What a search reads.
pub(crate) struct Scene<'a> {
    pub level: Level,
    pub range: DisparityRange,
    pub left: &'a Descriptors,
    pub right: &'a Descriptors,
    /// Left images, to tell dark pixels.
    pub images: &'a [&'a Image<Sample>],
    /// What each camera saw: nothing is looked for elsewhere.
    pub left_mask: Option<&'a Image<u8>>,
    pub right_mask: Option<&'a Image<u8>>,
}

impl Scene<'_> {
    fn count(&self) -> usize {
        (self.range.max_px - self.range.min_px + 1) as usize
    }
}

impl Search {
    /// Fills `map` with each pixel's best candidate.
    pub(crate) fn run(&mut self, scene: &Scene<'_>, map: &mut CoarseMap) {
        self.seed(scene, map.disparity.height());
        let (seeds, scratch) = (&self.seeds, self.scratch.ready());
        map.bands(SEED_ROWS).share(|mut band| {
            scratch.with(|s| search_band(scene, seeds, s, &mut band));
        });
    }

    /// Fills `raw` with each pixel's best candidate, and `map` with that cleaned. Rows whose neighbours
    /// are in the same band are cleaned while their descriptors are still in the cache.
    pub(crate) fn run_clean(
        &mut self,
        scene: &Scene<'_>,
        rows: &PerThread<clean::Rows>,
        raw: &mut CoarseMap,
        map: &mut CoarseMap,
    ) {
        let height = raw.disparity.height();
        self.seed(scene, height);
        let (seeds, scratch) = (&self.seeds, self.scratch.ready());
        raw.bands(SEED_ROWS).zip(map.bands(SEED_ROWS)).share(|(mut band, mut cleaned)| {
            scratch.with(|s| search_band(scene, seeds, s, &mut band));
            rows.with(|rows| clean::inner_rows(scene, height, &band, rows, &mut cleaned));
        });
        map.bands(SEED_ROWS).share(|mut cleaned| {
            rows.with(|rows| clean::outer_rows(scene, raw, rows, &mut cleaned));
        });
    }

    /// Finds the seeds of every band.
    fn seed(&mut self, scene: &Scene<'_>, height: usize) {
        let half = scene.left.width().div_ceil(2);
        self.seeds.resize(half * height.div_ceil(SEED_ROWS), INVALID);
        self.seeds.par_chunks_mut(half).enumerate().share(|(band, seeds)| {
            let y = (band * SEED_ROWS + SEED_ROWS / 2).min(height - 1);
            seed_row(scene, y, seeds);
        });
    }
}

/// Searches a band among its own seeds and those of the bands beside it.
fn search_band(scene: &Scene<'_>, seeds: &[i16], s: &mut Scratch, out: &mut Band<'_>) {
    let half = out.width.div_ceil(2);
    let band = out.y / SEED_ROWS;
    let seeds = &seeds[band.saturating_sub(1) * half..seeds.len().min((band + 2) * half)];
    let blocks = out.width.div_ceil(BLOCK);
    // As many as there can be: bands need different numbers.
    s.block_shifts.resize_with(blocks, || Shifts::with_capacity(scene.count()));
    for block in 0..blocks {
        block_candidates(scene, seeds, block * BLOCK, out.width, s);
    }
    s.unsure.clear();
    s.unsure.resize(blocks, 0);
    // Row by row, as descriptors lie in memory.
    for row in 0..out.rows() {
        for (block, (shifts, unsure)) in s.block_shifts.iter().zip(&mut s.unsure).enumerate() {
            *unsure += match_row(scene, (block * BLOCK, row), shifts, false, out);
        }
    }
    search_unsure(scene, s, out);
}

/// Searches every second pixel of row `y`: every eighth over the whole range, those between first among
/// what those beside them found, and over the whole range where that does not match clearly.
fn seed_row(scene: &Scene<'_>, y: usize, seeds: &mut [i16]) {
    let width = scene.left.width();
    let (left, right) = (&scene.left.row(y)[MARGIN..][..width], &scene.right.row(y)[MARGIN..]);
    let right = &right[..width];
    let anywhere = |i: usize| {
        let found = whole_range(scene, left[2 * i], right, 2 * i);
        found.filter(|(bits, _)| *bits <= SEED_COST).map_or(INVALID, |(_, d)| d as i16)
    };
    (0..seeds.len()).step_by(4).for_each(|i| seeds[i] = anywhere(i));
    for step in [2, 1] {
        for i in (step..seeds.len()).step_by(2 * step) {
            let beside = [seeds[i - step], seeds.get(i + step).copied().unwrap_or(INVALID)];
            let mut found = INVALID;
            vectorised!(
                scene.level,
                seed_beside(
                    value: u64 = left[2 * i],
                    right: &[u64] = right,
                    x: i32 = 2 * i as i32,
                    range: DisparityRange = scene.range,
                    beside: [i16; 2] = beside,
                    found: &mut i16 = &mut found,
                )
            );
            seeds[i] = if found == INVALID { anywhere(i) } else { found };
        }
    }
}

/// What a seed's neighbours found, or almost, if it matches clearly.
#[inline(always)]
fn seed_beside(
    value: u64,
    right: &[u64],
    x: i32,
    range: DisparityRange,
    beside: [i16; 2],
    found: &mut i16,
) {
    let mut least = CLEAR_COST + 1;
    let [first, second] = beside;
    let near = first != INVALID && (i32::from(first) - i32::from(second)).abs() <= 1;
    for d in [first, if near { INVALID } else { second }] {
        if d == INVALID {
            continue;
        }
        let (from, to) = (i32::from(d) - SEED_SPREAD, i32::from(d) + SEED_SPREAD);
        for d in from.max(range.min_px)..=to.min(range.max_px) {
            let Some(other) = right.get((x - d) as usize) else { continue };
            let bits = (value ^ other).count_ones();
            if bits < least {
                (least, *found) = (bits, d as i16);
            }
        }
    }
}

/// The best match of pixel `x` in a row of right descriptors: bits that differ, and the disparity.
fn whole_range(scene: &Scene<'_>, value: u64, right: &[u64], x: usize) -> Option<(u32, i32)> {
    let place = |d: i32| (x as i64 - i64::from(d)).clamp(0, right.len() as i64) as usize;
    let (from, to) = (place(scene.range.max_px), place(scene.range.min_px - 1));
    let (bits, at) = nearest(scene.level, value, right.get(from..to)?)?;
    Some((bits, x as i32 - (from + at) as i32))
}

/// What a block of [`BLOCK`] columns from `x` tries: what the seeds around it found, and almost.
fn block_candidates(scene: &Scene<'_>, seeds: &[i16], x: usize, width: usize, s: &mut Scratch) {
    let count = scene.count();
    let min = scene.range.min_px;
    let half = width.div_ceil(2);
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
    shifts_for(scene, &s.fresh, x, width, &mut s.block_shifts[x / BLOCK]);
}

/// Looks for the unsure pixels of a band over the whole range: every fourth of them does, and what they
/// find, all pixels of their block try.
///
/// Each looks only among the right pixels of its row that nothing matches well. A pixel that only the left
/// camera sees finds few of them; one of a thin object finds the object's.
fn search_unsure(scene: &Scene<'_>, s: &mut Scratch, out: &mut Band<'_>) {
    if s.unsure.iter().all(|unsure| *unsure == 0) {
        return;
    }
    let count = scene.count();
    let empty = || Set { words: Vec::with_capacity(count.div_ceil(64)) };
    s.found.resize_with(s.unsure.len(), empty);
    s.found.iter_mut().for_each(|found| found.words.clear());
    for row in (0..out.rows()).step_by(2) {
        let y = out.y + row;
        let costs = &out.cost[row * out.width..][..out.width];
        let left_mask = scene.left_mask.map(|mask| mask.row(y));
        let mut ready = false;
        for (block, _) in s.unsure.iter().enumerate().filter(|(_, unsure)| **unsure > 0) {
            let x = block * BLOCK;
            let any = costs[x..].iter().take(BLOCK).fold(0, |most, c| most.max(*c));
            if u32::from(any) <= UNSURE_COST {
                continue;
            }
            // Rows in turn look at even and at odd columns: a wire aslant may lie on one kind alone.
            let columns = (row / 2 % 2..BLOCK.min(out.width - x)).step_by(2);
            let unsure = |column: &usize| {
                u32::from(costs[x + column]) > UNSURE_COST
                    && left_mask.is_none_or(|mask| mask[x + column] != 0)
            };
            let mut columns = columns.filter(unsure).peekable();
            if columns.peek().is_none() {
                continue;
            }
            let lit = lit(scene.level, scene.images, (x, y), columns.clone());
            for column in columns.filter(|column| lit >> column & 1 != 0) {
                if !ready {
                    let disparities = &out.disparity[row * out.width..][..out.width];
                    s.free.fill(scene, y, disparities, costs);
                    ready = true;
                }
                let value = scene.left.row(y)[MARGIN + x + column];
                if let Some(d) = s.free.search(scene, x + column, value) {
                    let found = &mut s.found[block];
                    if found.words.is_empty() {
                        found.clear(count);
                    }
                    found.insert((d - scene.range.min_px) as usize);
                }
            }
        }
    }
    for (block, found) in s.found.iter().enumerate().filter(|(_, found)| !found.words.is_empty()) {
        shifts_for(scene, found, block * BLOCK, out.width, &mut s.shifts);
        for row in 0..out.rows() {
            match_row(scene, (block * BLOCK, row), &s.shifts, true, out);
        }
    }
}

impl Free {
    /// Takes the row's matches.
    fn fill(&mut self, scene: &Scene<'_>, y: usize, disparities: &[i16], costs: &[u8]) {
        let width = disparities.len();
        self.taken.clear();
        self.taken.resize(width + 2 * shared::BLOCK, 0);
        let taken = &mut self.taken[shared::BLOCK..][..width];
        if let Some(mask) = scene.right_mask {
            taken.iter_mut().zip(mask.row(y)).for_each(|(to, seen)| *to = u8::from(*seen == 0));
        }
        shared::take(scene.level, disparities, costs, TAKEN_COST, &mut self.taken);
        let taken = &self.taken[shared::BLOCK..][..width];
        let row = &scene.right.row(y)[MARGIN..][..width];
        self.count = untaken(scene.level, taken, row, &mut self.descriptors, &mut self.columns);
    }

    /// The whole range for pixel `x`; `None` where nothing matches well.
    fn search(&self, scene: &Scene<'_>, x: usize, value: u64) -> Option<i32> {
        let place = |d: i32| x as i64 - i64::from(d);
        let columns = &self.columns[..self.count];
        let from = columns.partition_point(|c| i64::from(*c) < place(scene.range.max_px));
        let to = columns.partition_point(|c| i64::from(*c) <= place(scene.range.min_px));
        let (bits, at) = nearest(scene.level, value, &self.descriptors[from..to])?;
        let most = if scene.images.len() < FRAMES_MANY { FOUND_COST_FEW } else { FOUND_COST };
        (bits <= most).then(|| x as i32 - i32::from(self.columns[from + at]))
    }
}

/// Disparities of a set and their neighbours that have a counterpart for some pixel of the block.
fn shifts_for(scene: &Scene<'_>, set: &Set, x: usize, width: usize, shifts: &mut Shifts) {
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

/// Matches [`BLOCK`] pixels of a band's row from column `x`; with `better`, takes only what costs less than
/// what is there. Returns how many pixels are unsure.
fn match_row(
    scene: &Scene<'_>,
    (x, row): (usize, usize),
    shifts: &Shifts,
    better: bool,
    out: &mut Band<'_>,
) -> u32 {
    let (y, from) = (out.y + row, row * out.width + x);
    let columns = BLOCK.min(out.width - x);
    let left = &scene.left.row(y)[MARGIN + x..][..BLOCK];
    let mut best = [0; BLOCK];
    best_candidates(scene.level, left, scene.right.row(y), MARGIN + x, shifts, &mut best);
    let disparity = &mut out.disparity[from..][..columns];
    let cost = &mut out.cost[from..][..columns];
    let at = (x as i32, out.width as i32);
    let mut unsure = 0;
    // Loops of a known length have no remainder, which would not be by vectors.
    let whole = disparity.first_chunk_mut::<BLOCK>().zip(cost.first_chunk_mut::<BLOCK>());
    if let Some((disparity, cost)) = whole {
        write_row(scene.level, &best, shifts.first(), at, better, disparity, cost, &mut unsure);
        return unsure;
    }
    let (mut disparities, mut costs) = ([INVALID; BLOCK], [0; BLOCK]);
    disparities[..columns].copy_from_slice(disparity);
    costs[..columns].copy_from_slice(cost);
    let (to, costs_to) = (&mut disparities, &mut costs);
    write_row(scene.level, &best, shifts.first(), at, better, to, costs_to, &mut unsure);
    disparity.copy_from_slice(&disparities[..columns]);
    cost.copy_from_slice(&costs[..columns]);
    cost.iter().filter(|c| u32::from(**c) > UNSURE_COST).count() as u32
}

/// Takes over the best candidates of a block's row, which begins at column `at.0` of `at.1`.
#[allow(clippy::too_many_arguments)]
fn write_row(
    level: Level,
    best: &[u32; BLOCK],
    first: i32,
    at: (i32, i32),
    better: bool,
    disparity: &mut [i16; BLOCK],
    cost: &mut [u8; BLOCK],
    unsure: &mut u32,
) {
    vectorised!(
        level,
        write_loop(
            best: &[u32; BLOCK] = best,
            first: i32 = first,
            at: (i32, i32) = at,
            better: bool = better,
            disparity: &mut [i16; BLOCK] = disparity,
            cost: &mut [u8; BLOCK] = cost,
            unsure: &mut u32 = unsure,
        )
    );
}

#[inline(always)]
fn write_loop(
    best: &[u32; BLOCK],
    first: i32,
    (x, width): (i32, i32),
    better: bool,
    disparity: &mut [i16; BLOCK],
    cost: &mut [u8; BLOCK],
    unsure: &mut u32,
) {
    if !better {
        disparity.fill(INVALID);
        cost.fill(u8::MAX);
    }
    let mut count = 0;
    for i in 0..BLOCK {
        let shift = first + (best[i] & 0xFFFF) as i32;
        let inside = ((x + i as i32 - shift) as u32) < width as u32;
        // Without candidates all bits are ones.
        let bits = best[i] >> 16;
        let take = inside & (bits < u32::from(cost[i]));
        cost[i] = if take { bits as u8 } else { cost[i] };
        disparity[i] = if take { shift as i16 } else { disparity[i] };
        count += u32::from(u32::from(cost[i]) > UNSURE_COST);
    }
    *unsure += count;
}
