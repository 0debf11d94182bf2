//! Removal of small regions by runs: neighbouring pixels of a row whose disparities differ little are
//! one run, and runs of neighbouring rows that touch with little difference are one region.

use crate::Image;

/// Neighbours that differ by more belong to different surfaces.
const STEP_PX: f32 = 1.5;

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
            // NaN ends a run, as no comparison with it holds.
            while to < row.len() && (row[to] - row[to - 1]).abs() <= STEP_PX {
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
        let mut up = self.rows[y - 1] as usize;
        let (mut down, middle, end) =
            (self.rows[y] as usize, self.rows[y] as usize, self.runs.len());
        while up < middle && down < end {
            let (a, b) = (self.runs[up], self.runs[down]);
            let (from, to) = (a.from.max(b.from), a.to.min(b.to));
            if from < to {
                let (ra, rb) = (self.root(up as u32), self.root(down as u32));
                let touch = |x: u32| (above[x as usize] - row[x as usize]).abs() <= STEP_PX;
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
    use crate::synthetic::Random;

    /// Sizes by flood fill, pixel by pixel.
    fn reference(map: &Image<f32>, least: usize) -> Image<f32> {
        let (w, h) = (map.width(), map.height());
        let mut out = map.clone();
        let mut seen = vec![false; w * h];
        for start in 0..w * h {
            if seen[start] || map.as_slice()[start].is_nan() {
                continue;
            }
            let (mut stack, mut region) = (vec![start], Vec::new());
            seen[start] = true;
            while let Some(at) = stack.pop() {
                region.push(at);
                let (x, y) = (at % w, at / w);
                let around = [
                    (x > 0).then(|| at - 1),
                    (x + 1 < w).then_some(at + 1),
                    (y > 0).then(|| at - w),
                    (y + 1 < h).then_some(at + w),
                ];
                for next in around.into_iter().flatten() {
                    let near = (map.as_slice()[next] - map.as_slice()[at]).abs() <= STEP_PX;
                    if near && !seen[next] {
                        seen[next] = true;
                        stack.push(next);
                    }
                }
            }
            if region.len() < least {
                for at in region {
                    out.as_mut_slice()[at] = f32::NAN;
                }
            }
        }
        out
    }

    #[test]
    fn equals_a_flood_fill() {
        let mut random = Random::new(6);
        for _ in 0..60 {
            let mut map = Image::new(23, 17, 0.0f32);
            for v in map.as_mut_slice() {
                *v = match random.bits() % 4 {
                    0 => f32::NAN,
                    k => 2.0 * k as f32 + random.unit() as f32,
                };
            }
            let want = reference(&map, 6);
            Regions::default().remove(&mut map, 6);
            let bits =
                |m: &Image<f32>| m.as_slice().iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&map), bits(&want));
        }
    }
}
