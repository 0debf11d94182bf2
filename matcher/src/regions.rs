//! Removal of small regions by runs: neighbouring pixels of a row that are on one surface are one run,
//! and runs of neighbouring rows that touch on one surface are one region.
//!
//! Wrong matches that pass the other checks come singly or in small clumps, as there is no reason for
//! them to agree; surfaces are large. Near a limb a surface falls away by more than any fixed step from
//! pixel to pixel, but its slope changes little: that joins pixels too. (By a step alone each row of a
//! sphere's polar caps would be a region of its own.)

use rayon::prelude::*;

use crate::{Image, Level, lanes::vectorised, parallel::Share};

/// Neighbours that differ by less are on one surface.
pub const STEP_PX: f32 = 1.5;
/// So are neighbours that differ by less than this, if the slope between them continues beyond one of
/// them to within [`BEND_PX`].
pub const STEEP_PX: f32 = 4.0;
/// Change of the slope from pixel to pixel on one surface.
pub const BEND_PX: f32 = 1.0;

/// Whether neighbours `a` and `b` are on one surface, given what is beyond them: `before` a and `after`
/// b. NaN is on none.
pub(crate) fn joined(before: f32, a: f32, b: f32, after: f32) -> bool {
    let difference = b - a;
    let bend = |other: f32| (difference - other).abs() <= BEND_PX;
    // Without branches, for vectors.
    let continues = bend(a - before) | bend(after - b);
    (difference.abs() <= STEP_PX) | ((difference.abs() <= STEEP_PX) & continues)
}

/// What a pixel is in its row: the first of a run, joined with the pixel before, or none.
const FIRST: u8 = 0;
const JOINED: u8 = 1;
const NONE: u8 = 2;
/// Pixels that are passed over together within a run.
const BLOCK: usize = 32;
/// Rows of a task.
const BAND: usize = 64;

/// Finds regions; keeps its buffers between frames.
#[derive(Debug)]
pub struct Regions {
    level: Level,
    bands: Vec<Band>,
    all: Runs,
}

/// A band of rows by itself.
#[derive(Debug, Default)]
struct Band {
    /// What each pixel of the row in work is.
    flags: Vec<u8>,
    found: Runs,
}

/// Runs of some rows.
#[derive(Debug, Default)]
struct Runs {
    runs: Vec<Run>,
    /// First run of each row, and the end.
    rows: Vec<u32>,
}

#[derive(Debug, Clone, Copy)]
struct Run {
    from: u32,
    to: u32,
    parent: u32,
    size: u32,
}

impl Default for Regions {
    fn default() -> Self {
        Self::new(Level::best())
    }
}

impl Regions {
    /// Without memory yet.
    pub fn new(level: Level) -> Self {
        Self { level: level.usable(), bands: Vec::new(), all: Runs::default() }
    }

    /// Sets regions of fewer than `least` pixels to NaN.
    pub fn remove(&mut self, map: &mut Image<f32>, least: usize) {
        let (level, height) = (self.level, map.height());
        let count = height.div_ceil(BAND);
        self.bands.resize_with(count.max(self.bands.len()), Band::default);
        let whole = &*map;
        self.bands[..count].par_iter_mut().enumerate().share(|(band, Band { flags, found })| {
            flags.resize(whole.width(), NONE);
            found.clear();
            let top = band * BAND;
            for y in top..(top + BAND).min(height) {
                flag_row(level, whole.row(y), flags);
                cut(flags, &mut found.runs);
                found.rows.push(found.runs.len() as u32);
                if y > top {
                    found.join(whole, y, y - top);
                }
            }
        });
        let all = &mut self.all;
        all.clear();
        for (band, Band { found, .. }) in self.bands[..count].iter().enumerate() {
            let before = all.runs.len() as u32;
            let moved = |run: &Run| Run { parent: run.parent + before, ..*run };
            all.runs.extend(found.runs.iter().map(moved));
            all.rows.extend(found.rows[1..].iter().map(|end| end + before));
            if band > 0 {
                all.join(map, band * BAND, band * BAND);
            }
        }
        for run in 0..all.runs.len() {
            let root = all.root(run as u32);
            if root as usize != run {
                all.runs[root as usize].size += all.runs[run].to - all.runs[run].from;
            }
        }
        for y in 0..height {
            for run in all.rows[y]..all.rows[y + 1] {
                let root = all.root(run);
                if (all.runs[root as usize].size as usize) < least {
                    let Run { from, to, .. } = all.runs[run as usize];
                    map.row_mut(y)[from as usize..to as usize].fill(f32::NAN);
                }
            }
        }
    }
}

impl Runs {
    /// Takes all rows away.
    fn clear(&mut self) {
        self.runs.clear();
        self.rows.clear();
        self.rows.push(0);
    }

    /// Joins the runs of the map's row `y`, the `row`th here, with those above.
    fn join(&mut self, map: &Image<f32>, y: usize, row: usize) {
        let [up, middle, end] = [row - 1, row, row + 1].map(|row| self.rows[row] as usize);
        let (above, line) = (map.row(y - 1), map.row(y));
        let at = |x: usize, y: usize| map.get(x, y).unwrap_or(f32::NAN);
        let (mut up, mut down) = (up, middle);
        while up < middle && down < end {
            let (a, b) = (self.runs[up], self.runs[down]);
            let (from, to) = (a.from.max(b.from), a.to.min(b.to));
            if from < to {
                let (ra, rb) = (self.root(up as u32), self.root(down as u32));
                let touch = |x: u32| {
                    let x = x as usize;
                    joined(at(x, y.wrapping_sub(2)), above[x], line[x], at(x, y + 1))
                };
                if ra != rb && (from..to).any(touch) {
                    let (low, high) = (ra.min(rb), ra.max(rb));
                    self.runs[high as usize].parent = low;
                }
            }
            if a.to < b.to {
                up += 1;
            } else {
                down += 1;
            }
        }
    }

    fn root(&mut self, mut run: u32) -> u32 {
        while self.runs[run as usize].parent != run {
            let parent = self.runs[run as usize].parent;
            self.runs[run as usize].parent = self.runs[parent as usize].parent;
            run = parent;
        }
        run
    }
}

/// Tells what each pixel of a row is.
fn flag_row(level: Level, row: &[f32], flags: &mut [u8]) {
    let n = row.len();
    let at = |x: usize| row.get(x).copied().unwrap_or(f32::NAN);
    let flag = |x: usize| {
        let before = |k: usize| x.checked_sub(k).map_or(f32::NAN, at);
        flag(before(2), before(1), at(x), at(x + 1))
    };
    if n > 3 {
        vectorised!(level, flag_loop(row: &[f32] = row, flags: &mut [u8] = &mut flags[2..n - 1]));
    }
    for x in (0..n.min(2)).chain(n.saturating_sub(1).max(2)..n) {
        flags[x] = flag(x);
    }
}

/// Flags of the pixels that have two before and one after them.
#[inline(always)]
fn flag_loop(row: &[f32], flags: &mut [u8]) {
    let n = flags.len();
    let (before, a, b, after) = (&row[..n], &row[1..n + 1], &row[2..n + 2], &row[3..n + 3]);
    for i in 0..n {
        flags[i] = flag(before[i], a[i], b[i], after[i]);
    }
}

/// What the pixel of value `b` is, after one of value `a`.
#[inline(always)]
fn flag(before: f32, a: f32, b: f32, after: f32) -> u8 {
    let known = if joined(before, a, b, after) { JOINED } else { FIRST };
    if b.is_nan() { NONE } else { known }
}

/// Adds a row's runs.
fn cut(flags: &[u8], runs: &mut Vec<Run>) {
    let mut from = 0;
    while from < flags.len() {
        if flags[from] == NONE {
            from = end_of(flags, from, NONE);
            continue;
        }
        let to = end_of(flags, from + 1, JOINED);
        let (parent, size) = (runs.len() as u32, (to - from) as u32);
        runs.push(Run { from: from as u32, to: to as u32, parent, size });
        from = to;
    }
}

/// The first place from `at` that is not `flag`.
fn end_of(flags: &[u8], mut at: usize, flag: u8) -> usize {
    while let Some(block) = flags[at..].first_chunk::<BLOCK>() {
        if block.iter().fold(0, |other, f| other | (f ^ flag)) != 0 {
            break;
        }
        at += BLOCK;
    }
    at + flags[at..].iter().take_while(|f| **f == flag).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Random;

    #[test]
    fn small_regions_go_and_large_ones_stay() {
        let mut map = Image::new(20, 10, f32::NAN);
        for y in 0..10 {
            (0..12).for_each(|x| map.set(x, y, 5.0));
        }
        for x in 14..18 {
            map.set(x, 4, 9.0);
            map.set(x, 5, 9.5);
        }
        map.set(3, 3, 50.0);
        let mut cleaned = map.clone();
        Regions::default().remove(&mut cleaned, 9);
        assert!(cleaned.row(4)[15].is_nan() && cleaned.row(3)[3].is_nan());
        assert_eq!(cleaned.row(9)[11], 5.0);
        let mut kept = map.clone();
        Regions::default().remove(&mut kept, 8);
        assert_eq!(kept.row(4)[15], 9.0);
    }

    /// The rule, pixel by pixel.
    #[test]
    fn runs_are_cut_where_the_rule_says_at_every_level() {
        let mut random = Random::new(8);
        for n in [1usize, 2, 3, 4, 5, 31, 33, 34, 100, 331] {
            let row: Vec<f32> = (0..n)
                .map(|i| match random.bits() % 40 {
                    0 => f32::NAN,
                    1 => 50.0,
                    k => 0.1 * k as f32 + (i / 60) as f32 * 2.9,
                })
                .collect();
            let at = |x: usize| row.get(x).copied().unwrap_or(f32::NAN);
            let mut want: Vec<(u32, u32)> = Vec::new();
            for x in 0..n {
                let before = if x > 1 { at(x - 2) } else { f32::NAN };
                let joins = x > 0 && joined(before, at(x - 1), at(x), at(x + 1));
                match want.last_mut() {
                    Some(last) if joins => last.1 = x as u32 + 1,
                    _ if at(x).is_nan() => {}
                    _ => want.push((x as u32, x as u32 + 1)),
                }
            }
            for level in Level::available() {
                let (mut flags, mut runs) = (vec![9; n], Vec::new());
                flag_row(level, &row, &mut flags);
                cut(&flags, &mut runs);
                let got: Vec<(u32, u32)> = runs.iter().map(|r| (r.from, r.to)).collect();
                assert_eq!(got, want, "{level} {n}");
            }
        }
    }

    #[test]
    fn a_limb_is_one_region() {
        // The cap of a sphere: steeper towards the top, row by row.
        let mut map = Image::new(30, 16, f32::NAN);
        for y in 0..16 {
            (0..30).for_each(|x| map.set(x, y, 20.0 * ((y + 1) as f32 / 16.0).sqrt()));
        }
        assert!(map.row(1)[0] - map.row(0)[0] > STEP_PX);
        let whole = map.clone();
        Regions::default().remove(&mut map, 60);
        assert_eq!(map.as_slice(), whole.as_slice());
    }
}
