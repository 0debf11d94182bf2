//! Removal of small regions by runs: neighbouring pixels of a row that are on one surface are one run,
//! and runs of neighbouring rows that touch on one surface are one region.
//!
//! Wrong matches that pass the other checks come singly or in small clumps, as there is no reason for
//! them to agree; surfaces are large. Near a limb a surface falls away by more than any fixed step from
//! pixel to pixel, but its slope changes little: that joins pixels too. (By a step alone each row of a
//! sphere's polar caps would be a region of its own.)

use crate::Image;

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
    difference.abs() <= STEP_PX
        || (difference.abs() <= STEEP_PX && (bend(a - before) || bend(after - b)))
}

/// Finds regions; keeps its buffers between frames.
#[derive(Debug, Default)]
pub struct Regions {
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

impl Regions {
    /// Sets regions of fewer than `least` pixels to NaN.
    pub fn remove(&mut self, map: &mut Image<f32>, least: usize) {
        let height = map.height();
        self.runs.clear();
        self.rows.clear();
        for y in 0..height {
            self.rows.push(self.runs.len() as u32);
            self.cut(map.row(y));
            if y > 0 {
                self.join(map, y);
            }
        }
        self.rows.push(self.runs.len() as u32);
        for run in 0..self.runs.len() {
            let root = self.root(run as u32);
            if root as usize != run {
                self.runs[root as usize].size += self.runs[run].to - self.runs[run].from;
            }
        }
        for y in 0..height {
            for run in self.rows[y]..self.rows[y + 1] {
                let root = self.root(run);
                if (self.runs[root as usize].size as usize) < least {
                    let Run { from, to, .. } = self.runs[run as usize];
                    map.row_mut(y)[from as usize..to as usize].fill(f32::NAN);
                }
            }
        }
    }

    /// Cuts a row into runs.
    fn cut(&mut self, row: &[f32]) {
        let mut from = 0;
        while from < row.len() {
            if row[from].is_nan() {
                from += 1;
                continue;
            }
            let mut to = from + 1;
            let at = |x: usize| row.get(x).copied().unwrap_or(f32::NAN);
            // NaN ends a run, as no comparison with it holds.
            while to < row.len() && joined(at(to.wrapping_sub(2)), row[to - 1], row[to], at(to + 1))
            {
                to += 1;
            }
            let (parent, size) = (self.runs.len() as u32, (to - from) as u32);
            self.runs.push(Run { from: from as u32, to: to as u32, parent, size });
            from = to;
        }
    }

    /// Joins the runs of row `y` with those above.
    fn join(&mut self, map: &Image<f32>, y: usize) {
        let (above, row) = (map.row(y - 1), map.row(y));
        let at = |x: usize, y: usize| map.get(x, y).unwrap_or(f32::NAN);
        let mut up = self.rows[y - 1] as usize;
        let (mut down, middle, end) =
            (self.rows[y] as usize, self.rows[y] as usize, self.runs.len());
        while up < middle && down < end {
            let (a, b) = (self.runs[up], self.runs[down]);
            let (from, to) = (a.from.max(b.from), a.to.min(b.to));
            if from < to {
                let (ra, rb) = (self.root(up as u32), self.root(down as u32));
                let touch = |x: u32| {
                    let x = x as usize;
                    joined(at(x, y.wrapping_sub(2)), above[x], row[x], at(x, y + 1))
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

#[cfg(test)]
mod tests {
    use super::*;

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
