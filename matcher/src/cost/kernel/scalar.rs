//! The search kernels in plain Rust; the loops over columns are shared by the other levels, which
//! compile them for their instructions.

pub(super) fn costs(
    words: &[u16],
    planes: &[u16],
    invalid: &[u16],
    first: usize,
    costs: &mut [u16],
) {
    costs.fill(0);
    for (&word, plane) in words.iter().zip(planes.chunks_exact(invalid.len())) {
        for (cost, &other) in costs.iter_mut().zip(&plane[first..]) {
            *cost += (word ^ other).count_ones() as u16;
        }
    }
    for (cost, &invalid) in costs.iter_mut().zip(&invalid[first..]) {
        *cost |= invalid;
    }
}

#[inline(always)]
pub(super) fn smallest(costs: &[u16]) -> u16 {
    costs.iter().fold(u16::MAX, |least, &c| least.min(c))
}

#[inline(always)]
pub(super) fn find(costs: &[u16], cost: u16) -> Option<usize> {
    // Whole blocks first: without an early way out of the block, the compiler vectorises it.
    const BLOCK: usize = 64;
    let block = costs.chunks(BLOCK).position(|b| b.iter().fold(false, |f, &c| f | (c == cost)))?;
    let start = block * BLOCK;
    costs[start..].iter().position(|&c| c == cost).map(|i| start + i)
}

#[inline(always)]
pub(super) fn keep_best(costs: &[u16], x: u16, best_cost: &mut [u16], best_x: &mut [u16]) {
    for ((&cost, best), at) in costs.iter().zip(best_cost).zip(best_x) {
        let better = cost < *best;
        *best = if better { cost } else { *best };
        *at = if better { x } else { *at };
    }
}
