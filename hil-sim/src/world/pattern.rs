//! Dot patterns: irregular emitter layouts, and fast sums of Gaussian dots.

use super::noise::KeyedRng;

/// A dot: its direction cosines, and its peak at 1 m where the beam has its far-field width.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Dot {
    pub x: f64,
    pub y: f64,
    pub peak: f64,
}

/// Emitter positions in the unit square, irregular but never closer than `min_distance` (relative to
/// the side of the square that each emitter has on average), also across opposite edges, so that
/// copies of the tile join without a seam.
pub(crate) fn emitter_tile(count: usize, min_distance: f64, seed: u64) -> Vec<[f64; 2]> {
    let side = (1.0 / count as f64).sqrt();
    let mut distance = min_distance * side;
    let cells = ((1.0 / distance).floor() as usize).max(1);
    let mut grid: Vec<Vec<usize>> = vec![Vec::new(); cells * cells];
    let mut points: Vec<[f64; 2]> = Vec::with_capacity(count);
    let mut rng = KeyedRng::new(seed);
    let cell_of = |v: f64| ((v * cells as f64) as usize).min(cells - 1);
    let mut misses = 0;
    while points.len() < count {
        let p = [rng.uniform(), rng.uniform()];
        let (cx, cy) = (cell_of(p[0]), cell_of(p[1]));
        let mut is_free = true;
        'search: for oy in [cells - 1, 0, 1] {
            for ox in [cells - 1, 0, 1] {
                let cell = (cy + oy) % cells * cells + (cx + ox) % cells;
                for &other in &grid[cell] {
                    let [dx, dy] = [0, 1].map(|k| {
                        let d: f64 = (p[k] - points[other][k]).abs();
                        d.min(1.0 - d)
                    });
                    if dx * dx + dy * dy < distance * distance {
                        is_free = false;
                        break 'search;
                    }
                }
            }
        }
        if is_free {
            grid[cy * cells + cx].push(points.len());
            points.push(p);
            misses = 0;
        } else {
            misses += 1;
            // A layout that has jammed: give way a little rather than never finish.
            if misses > 5000 {
                distance *= 0.98;
                misses = 0;
            }
        }
    }
    points
}

/// Dots sorted into cells of direction space.
#[derive(Debug, Clone)]
pub(crate) struct DotGrid {
    min: [f64; 2],
    cell: f64,
    columns: usize,
    rows: usize,
    /// Start of each cell's dots, row by row, and one more.
    starts: Vec<u32>,
    dots: Vec<Dot>,
}

/// Directions at which a pattern is wanted, relative to `origin`, with the reciprocal
/// 1 / (2 sigma^2) of the dots there and room for the result.
#[derive(Debug, Clone)]
pub(crate) struct DirectionBlock {
    pub origin: [f64; 2],
    pub x: [f32; BLOCK],
    pub y: [f32; BLOCK],
    pub inverse_two_sigma2: [f32; BLOCK],
    pub sum: [f32; BLOCK],
}

/// Directions evaluated together.
pub(crate) const BLOCK: usize = 64;

/// Exponent beyond which a dot's tail is left out: exp(-10) of a 200 DN dot is 0.01 DN.
const TAIL: f32 = 10.0;

impl DotGrid {
    pub fn new(dots: Vec<Dot>) -> Self {
        let mut min = [f64::INFINITY; 2];
        let mut max = [f64::NEG_INFINITY; 2];
        for d in &dots {
            min = [min[0].min(d.x), min[1].min(d.y)];
            max = [max[0].max(d.x), max[1].max(d.y)];
        }
        if dots.is_empty() {
            (min, max) = ([0.0; 2], [0.0; 2]);
        }
        let area = (max[0] - min[0]) * (max[1] - min[1]);
        let cell = (area / dots.len().max(1) as f64).sqrt().max(1e-6);
        let columns = ((max[0] - min[0]) / cell) as usize + 1;
        let rows = ((max[1] - min[1]) / cell) as usize + 1;
        let index = |d: &Dot| {
            let column = (((d.x - min[0]) / cell) as usize).min(columns - 1);
            let row = (((d.y - min[1]) / cell) as usize).min(rows - 1);
            row * columns + column
        };
        let mut starts = vec![0_u32; columns * rows + 1];
        for d in &dots {
            starts[index(d) + 1] += 1;
        }
        for i in 0..columns * rows {
            starts[i + 1] += starts[i];
        }
        let mut next = starts.clone();
        let mut sorted = vec![Dot { x: 0.0, y: 0.0, peak: 0.0 }; dots.len()];
        for d in &dots {
            let slot = &mut next[index(d)];
            sorted[*slot as usize] = *d;
            *slot += 1;
        }
        Self { min, cell, columns, rows, starts, dots: sorted }
    }

    /// Dots in all cells that touch a rectangle of direction cosines, as runs of `dots`.
    fn runs(&self, low: [f64; 2], high: [f64; 2]) -> impl Iterator<Item = &[Dot]> {
        let index = |v: f64, k: usize, n: usize| {
            (((v - self.min[k]) / self.cell).floor().max(0.0) as usize).min(n - 1)
        };
        let extent = [self.columns as f64 * self.cell, self.rows as f64 * self.cell];
        let is_outside =
            (0..2).any(|k| !(high[k] >= self.min[k] && low[k] <= self.min[k] + extent[k]));
        let (c0, c1) = (index(low[0], 0, self.columns), index(high[0], 0, self.columns));
        let (r0, r1) = (index(low[1], 1, self.rows), index(high[1], 1, self.rows));
        let rows = if is_outside { 0..0 } else { r0..r1 + 1 };
        rows.map(move |row| {
            let start = self.starts[row * self.columns + c0] as usize;
            let end = self.starts[row * self.columns + c1 + 1] as usize;
            &self.dots[start..end]
        })
    }

    /// Sums the dots at the first `count` directions of the block: `sum` = sum of
    /// peak * exp(-distance^2 / (2 sigma^2)).
    pub fn sum(&self, block: &mut DirectionBlock, count: usize) {
        block.sum = [0.0; BLOCK];
        if count == 0 {
            return;
        }
        // Unused lanes repeat the last direction: they must not widen the search.
        for i in count..BLOCK {
            block.x[i] = block.x[count - 1];
            block.y[i] = block.y[count - 1];
            block.inverse_two_sigma2[i] = block.inverse_two_sigma2[count - 1];
        }
        let range = |v: &[f32; BLOCK]| {
            v.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &v| (l.min(v), h.max(v)))
        };
        let (x0, x1) = range(&block.x);
        let (y0, y1) = range(&block.y);
        let (narrowest, _) = range(&block.inverse_two_sigma2);
        let reach = (TAIL / narrowest).sqrt();
        let [ox, oy] = block.origin;
        let low = [ox + f64::from(x0 - reach), oy + f64::from(y0 - reach)];
        let high = [ox + f64::from(x1 + reach), oy + f64::from(y1 + reach)];
        for run in self.runs(low, high) {
            for dot in run {
                let dx = (dot.x - ox) as f32;
                let dy = (dot.y - oy) as f32;
                // The cells reach further than the rectangle.
                if dx < x0 - reach || dx > x1 + reach || dy < y0 - reach || dy > y1 + reach {
                    continue;
                }
                add_dot(block, dx, dy, dot.peak as f32);
            }
        }
    }
}

/// Adds one dot at all directions of the block; written so that it compiles to SIMD.
fn add_dot(block: &mut DirectionBlock, dx: f32, dy: f32, peak: f32) {
    for i in 0..BLOCK {
        let ex = block.x[i] - dx;
        let ey = block.y[i] - dy;
        let e = (ex * ex + ey * ey) * block.inverse_two_sigma2[i];
        block.sum[i] += peak * exp_negative(e);
    }
}

/// exp(-e) for e >= 0, zero beyond [`TAIL`], within 4e-6 of exact, without branches.
#[inline(always)]
fn exp_negative(e: f32) -> f32 {
    let t = -e.min(TAIL) * std::f32::consts::LOG2_E;
    // Splits into integer and fraction in [-0.5, 0.5] by adding a large number.
    const ROUNDER: f32 = 12_582_912.0;
    let shifted = t + ROUNDER;
    let whole = shifted - ROUNDER;
    let f = t - whole;
    // Taylor series of 2^f.
    let p = 1.333_355_8e-3_f32;
    let p = p * f + 9.618_129e-3;
    let p = p * f + 5.550_411e-2;
    let p = p * f + 2.402_265e-1;
    let p = p * f + 6.931_472e-1;
    let p = p * f + 1.0;
    let scale = f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000));
    let inside = if e < TAIL { 1.0 } else { 0.0 };
    p * scale * inside
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn emitters_keep_their_distance_across_the_seam() {
        let tile = emitter_tile(800, 0.62, 5);
        assert_eq!(tile.len(), 800);
        let mut closest = f64::INFINITY;
        for (i, a) in tile.iter().enumerate() {
            for b in &tile[..i] {
                let d = [0, 1].map(|k| {
                    let d: f64 = (a[k] - b[k]).abs();
                    d.min(1.0 - d)
                });
                closest = closest.min(d[0].hypot(d[1]));
            }
        }
        assert!(closest >= 0.62 / 800.0_f64.sqrt() * 0.9, "{closest}");
        assert_ne!(tile, emitter_tile(800, 0.62, 6));
    }

    #[test]
    fn exp_is_close_to_exact() {
        for i in 0..2000 {
            let e = i as f32 * 0.00499;
            assert!((exp_negative(e) - (-e).exp()).abs() < 4e-6, "{e}");
        }
        assert_eq!(exp_negative(10.5), 0.0);
        assert_eq!(exp_negative(f32::INFINITY), 0.0);
    }

    #[test]
    fn block_sums_equal_the_plain_sum_over_all_dots() {
        let mut rng = KeyedRng::new(17);
        let dots: Vec<Dot> = (0..3000)
            .map(|_| Dot {
                x: rng.symmetric() * 0.1,
                y: rng.symmetric() * 0.1,
                peak: rng.uniform(),
            })
            .collect();
        let grid = DotGrid::new(dots.clone());
        for case in 0..50 {
            // Also blocks that lie half or wholly outside the pattern, and partly filled ones.
            let origin = [rng.symmetric() * 0.12, rng.symmetric() * 0.12];
            let count = 1 + (case * 13) % BLOCK;
            let mut block = DirectionBlock {
                origin,
                x: [0.0; BLOCK],
                y: [0.0; BLOCK],
                inverse_two_sigma2: [0.0; BLOCK],
                sum: [0.0; BLOCK],
            };
            for i in 0..count {
                block.x[i] = rng.symmetric() as f32 * 0.004;
                block.y[i] = rng.symmetric() as f32 * 0.004;
                let sigma = 0.001 * (1.0 + rng.uniform());
                block.inverse_two_sigma2[i] = (0.5 / (sigma * sigma)) as f32;
            }
            grid.sum(&mut block, count);
            for i in 0..count {
                let expected: f64 = dots
                    .iter()
                    .map(|d| {
                        let dx = origin[0] + f64::from(block.x[i]) - d.x;
                        let dy = origin[1] + f64::from(block.y[i]) - d.y;
                        let e = (dx * dx + dy * dy) * f64::from(block.inverse_two_sigma2[i]);
                        d.peak * (-e).exp()
                    })
                    .sum();
                assert!((f64::from(block.sum[i]) - expected).abs() < 3e-4, "{case} {i}");
            }
        }
    }
}
