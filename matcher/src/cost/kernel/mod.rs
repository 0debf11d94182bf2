//! Kernels of the search: Hamming costs of a stretch of columns, their smallest, and the best
//! partner of every right pixel so far.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod scalar;

use crate::{Level, census::BLOCK};

type Costs = fn(words: &[u16], planes: &[u16], invalid: &[u16], first: usize, costs: &mut [u16]);
type Smallest = fn(costs: &[u16]) -> u16;
type Find = fn(costs: &[u16], cost: u16) -> Option<usize>;
type KeepBest = fn(costs: &[u16], x: u16, best_cost: &mut [u16], best_x: &mut [u16]);

/// The search kernels of one SIMD level.
#[derive(Debug, Clone, Copy)]
pub struct CostKernel {
    costs: Costs,
    smallest: Smallest,
    find: Find,
    keep_best: KeepBest,
}

impl CostKernel {
    /// The kernels of `level`, or of the best level below it that this machine runs.
    pub fn new(level: Level) -> Self {
        match level.usable() {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => Self {
                // SAFETY: `usable` returns only levels whose instructions this machine has.
                costs: |w, p, i, f, c| unsafe { avx512::costs(w, p, i, f, c) },
                smallest: |c| unsafe { avx512::smallest(c) },
                find: |c, v| unsafe { avx512::find(c, v) },
                keep_best: |c, x, b, bx| unsafe { avx512::keep_best(c, x, b, bx) },
            },
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => Self {
                // SAFETY: as above.
                costs: |w, p, i, f, c| unsafe { avx2::costs(w, p, i, f, c) },
                smallest: |c| unsafe { avx2::smallest(c) },
                find: |c, v| unsafe { avx2::find(c, v) },
                keep_best: |c, x, b, bx| unsafe { avx2::keep_best(c, x, b, bx) },
            },
            #[cfg(target_arch = "aarch64")]
            // SAFETY: as above. The plain loops are compiled to NEON, ARM's baseline.
            Level::Neon => Self {
                costs: |w, p, i, f, c| unsafe { neon::costs(w, p, i, f, c) },
                smallest: scalar::smallest,
                find: scalar::find,
                keep_best: scalar::keep_best,
            },
            _ => Self {
                costs: scalar::costs,
                smallest: scalar::smallest,
                find: scalar::find,
                keep_best: scalar::keep_best,
            },
        }
    }

    /// Hamming distances between `words` and the descriptors of the columns from `first` on, as many
    /// as `costs` holds; all ones where `invalid` is.
    ///
    /// `planes`: word w of column x at w * stride + x, the stride being `invalid`'s length.
    ///
    /// # Panics
    /// When a slice is too short, or `first` or `costs` are no whole blocks.
    pub fn costs(
        self,
        words: &[u16],
        planes: &[u16],
        invalid: &[u16],
        first: usize,
        costs: &mut [u16],
    ) {
        assert!(first.is_multiple_of(BLOCK) && costs.len().is_multiple_of(BLOCK));
        assert!(first + costs.len() <= invalid.len());
        assert!(planes.len() >= words.len() * invalid.len());
        (self.costs)(words, planes, invalid, first, costs);
    }

    /// The smallest of the costs; all ones when there is none.
    pub fn smallest(self, costs: &[u16]) -> u16 {
        (self.smallest)(costs)
    }

    /// Index of the first cost equal to `cost`.
    pub fn find(self, costs: &[u16], cost: u16) -> Option<usize> {
        (self.find)(costs, cost)
    }

    /// Where a cost is below `best_cost`, puts it there, and `x` into `best_x`.
    ///
    /// # Panics
    /// When the slices differ in length.
    pub fn keep_best(self, costs: &[u16], x: u16, best_cost: &mut [u16], best_x: &mut [u16]) {
        assert!(costs.len() == best_cost.len() && costs.len() == best_x.len());
        (self.keep_best)(costs, x, best_cost, best_x);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_bit_equal() {
        let mut state = 7u64;
        let mut random = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as u16
        };
        let scalar = CostKernel::new(Level::Scalar);
        for (words, stride, first, len) in [
            (2, 64, 0, 64),
            (16, 256, 32, 160),
            (51, 96, 64, 32),
            (289, 256, 0, 256),
            (16, 32, 32, 0),
        ] {
            let reference: Vec<u16> = (0..words).map(|_| random()).collect();
            let planes: Vec<u16> = (0..words * stride).map(|_| random()).collect();
            let invalid: Vec<u16> =
                (0..stride).map(|_| if random() % 8 == 0 { u16::MAX } else { 0 }).collect();
            let mut expected = vec![0; len];
            scalar.costs(&reference, &planes, &invalid, first, &mut expected);
            let before: Vec<u16> = (0..len).map(|_| random() % 300).collect();
            let (mut cost, mut x) = (before.clone(), vec![1; len]);
            scalar.keep_best(&expected, 9, &mut cost, &mut x);
            for level in Level::available() {
                let kernel = CostKernel::new(level);
                let mut got = vec![1; len];
                kernel.costs(&reference, &planes, &invalid, first, &mut got);
                assert!(got == expected, "{level}: {words} words, {len} columns from {first}");
                assert_eq!(kernel.smallest(&got), got.iter().copied().min().unwrap_or(u16::MAX));
                assert_eq!(kernel.smallest(&got[..len / 3]), scalar.smallest(&got[..len / 3]));
                for value in got.iter().copied().take(40).chain([u16::MAX]) {
                    let first = got.iter().position(|&v| v == value);
                    assert_eq!(kernel.find(&got, value), first, "{level}");
                }
                let (mut got_cost, mut got_x) = (before.clone(), vec![1; len]);
                kernel.keep_best(&got, 9, &mut got_cost, &mut got_x);
                assert!(got_cost == cost && got_x == x, "{level}");
            }
        }
    }
}
