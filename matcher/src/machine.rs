//! What one core of this machine does at most, by two short measurements: figures that let a frame's
//! time on one machine be compared with another's.

use std::{hint::black_box, time::Instant};

use crate::{
    Level,
    coarse::hamming::{BLOCK, Shifts, best_candidates},
    lanes::{Lanes, dispatch},
};

/// Figures of one core at a SIMD level.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MachineFigures {
    /// Brute-force comparisons of 64-bit descriptors, in 10^9 per second: exclusive or, population
    /// count and minimum, as the coarse search does them.
    pub popcount_g_per_s: f64,
    /// Fused multiply-adds of `f32` in 10^9 operations per second, two a multiply-add.
    pub fma_gflop_per_s: f64,
}

/// Repeats of each measurement; the fastest counts.
const REPEATS: usize = 7;

/// Measures for about ten milliseconds.
pub fn measure(level: Level) -> MachineFigures {
    let level = level.usable();
    MachineFigures { popcount_g_per_s: popcount(level), fma_gflop_per_s: fma(level) }
}

fn fastest(operations: f64, mut work: impl FnMut()) -> f64 {
    let seconds = (0..REPEATS).map(|_| {
        let start = Instant::now();
        work();
        start.elapsed().as_secs_f64()
    });
    operations / seconds.fold(f64::INFINITY, f64::min) * 1e-9
}

/// A row of 640 pixels against 520 candidates.
fn popcount(level: Level) -> f64 {
    const PIXELS: usize = 20 * BLOCK;
    const CANDIDATES: usize = 520;
    let word = |i: usize| (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let left: Vec<u64> = (0..PIXELS).map(word).collect();
    let right: Vec<u64> = (0..PIXELS + CANDIDATES).map(|i| word(i + 7)).collect();
    let mut shifts = Shifts::default();
    shifts.fill(0, CANDIDATES);
    let mut best = vec![0; PIXELS];
    fastest((PIXELS * CANDIDATES) as f64, || {
        best_candidates(level, black_box(&left), &right, CANDIDATES, &shifts, &mut best);
        black_box(&best);
    })
}

/// Steps of the loop below.
const STEPS: usize = 20_000;
/// Sums side by side, to hide an addition's latency.
const SUMS: usize = 10;

fn fma(level: Level) -> f64 {
    let mut lanes = 0;
    let seconds_per = fastest(1.0, || {
        let mut sum = 0.0;
        dispatch!(level, fma_lanes(sum: &mut f32 = &mut sum, lanes: &mut usize = &mut lanes));
        black_box(sum);
    });
    seconds_per * (2 * STEPS * SUMS * lanes) as f64
}

#[inline(always)]
fn fma_lanes<V: Lanes>(sum: &mut f32, lanes: &mut usize) {
    let (factor, addend) = (V::splat(black_box(0.999)), V::splat(black_box(0.001)));
    let mut sums = [V::splat(black_box(1.0)); SUMS];
    for _ in 0..STEPS {
        for s in &mut sums {
            *s = s.mul_add(factor, addend);
        }
    }
    let total = sums.into_iter().reduce(V::add).unwrap_or(factor);
    let mut out = [0.0f32; 16];
    // SAFETY: no level has more than 16 lanes.
    unsafe { total.store(out.as_mut_ptr()) };
    *sum = out[0];
    *lanes = V::COUNT;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_those_of_a_processor() {
        for level in Level::available() {
            let figures = measure(level);
            // From a tenth of a slow core in a checker to more than any core has.
            assert!((1e-4..200.0).contains(&figures.popcount_g_per_s), "{figures:?}");
            assert!((1e-4..2000.0).contains(&figures.fma_gflop_per_s), "{figures:?}");
        }
    }
}
