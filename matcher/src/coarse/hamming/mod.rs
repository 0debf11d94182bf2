//! The search's inner loop: which candidate's descriptor differs in the fewest bits.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;

use crate::Level;

/// Pixels a call's length is a multiple of.
pub(crate) const BLOCK: usize = 32;

/// Candidates in rising order.
#[derive(Debug, Default)]
pub(crate) struct Shifts(Vec<i32>);

impl Shifts {
    /// None yet, with place for `count`.
    pub(crate) fn with_capacity(count: usize) -> Self {
        Self(Vec::with_capacity(count))
    }

    pub(crate) fn clear(&mut self) {
        self.0.clear();
    }

    /// Takes `count` candidates from `first` on instead of what there is.
    pub(crate) fn fill(&mut self, first: i32, count: usize) {
        self.0.clear();
        self.0.extend(first..first + count as i32);
    }

    /// Adds a candidate.
    ///
    /// # Panics
    /// When it is not above the last one.
    pub(crate) fn push(&mut self, shift: i32) {
        assert!(self.0.last().is_none_or(|last| *last < shift), "candidates rise");
        self.0.push(shift);
    }

    /// The lowest candidate; 0 where there is none.
    pub(crate) fn first(&self) -> i32 {
        self.0.first().copied().unwrap_or(0)
    }
}

#[cfg(test)]
impl Extend<i32> for Shifts {
    fn extend<I: IntoIterator<Item = i32>>(&mut self, shifts: I) {
        shifts.into_iter().for_each(|shift| self.push(shift));
    }
}

/// For each `left[i]` the candidate of smallest Hamming distance to `right[origin + i - candidate]`;
/// ties go to the lowest. `best[i]` = distance << 16 | candidate - lowest candidate, all ones without
/// candidates.
pub(crate) fn best_candidates(
    level: Level,
    left: &[u64],
    right: &[u64],
    origin: usize,
    shifts: &Shifts,
    best: &mut [u32],
) {
    let n = left.len();
    assert!(n.is_multiple_of(BLOCK) && best.len() == n);
    let shifts = &shifts.0[..];
    if let [first, .., last] | [first @ last] = shifts {
        // They rise: what holds for the outermost holds for all.
        let at = |shift: i32| origin as i64 - i64::from(shift);
        let inside = at(*last) >= 0 && at(*first) as usize + n <= right.len();
        assert!(inside && i64::from(*last) - i64::from(*first) < 1 << 16, "candidates outside");
    }
    match level {
        // SAFETY: trusted levels are the processor's; every candidate lies inside as checked.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::search(left, right, origin, shifts, best) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::search(left, right, origin, shifts, best) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::search(left, right, origin, shifts, best) },
        _ => scalar::search(left, right, origin, shifts, best),
    }
}

/// The smallest Hamming distance of `value` to any of `row`, and where; the first of equals.
pub(crate) fn nearest(level: Level, value: u64, row: &[u64]) -> Option<(u32, usize)> {
    let key = match level {
        // SAFETY: trusted levels are the processor's.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::nearest(value, row) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::nearest(value, row) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::nearest(value, row) },
        _ => scalar::nearest(value, row),
    };
    (!row.is_empty()).then_some(((key >> 32) as u32, key as u32 as usize))
}

/// Puts the descriptors of `row` that are not `taken`, and their columns, side by side at the begin of
/// `descriptors` and `columns`; returns their number.
pub(crate) fn untaken(
    level: Level,
    taken: &[u8],
    row: &[u64],
    descriptors: &mut Vec<u64>,
    columns: &mut Vec<u16>,
) -> usize {
    assert!(taken.len() == row.len() && row.len() <= 1 << 16);
    // Whole blocks are written, of which only the first values count.
    descriptors.resize(row.len() + BLOCK, 0);
    columns.resize(row.len() + BLOCK, 0);
    let (to, to_columns) = (&mut descriptors[..], &mut columns[..]);
    match level {
        // SAFETY: trusted levels are the processor's; there is a block more than the row is long.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::untaken(taken, row, to, to_columns) },
        _ => scalar::untaken(taken, row, to, to_columns),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        guarded::{Edge, Guarded},
        synthetic::Random,
    };

    #[test]
    fn levels_are_bit_equal() {
        let mut random = Random::new(11);
        let right: Vec<u64> = (0..700).map(|_| random.bits()).collect();
        for n in [32, 64, 160] {
            let left: Vec<u64> =
                (0..n).map(|i| right[i + 100] ^ (1 << (random.bits() % 64))).collect();
            for count in [0usize, 1, 2, 7, 130] {
                let mut shifts = Shifts::default();
                let mut at = -100;
                shifts.extend((0..count).map(|_| {
                    at += 1 + (random.bits() % 2) as i32;
                    at
                }));
                let mut want = vec![9; n];
                scalar::search(&left, &right, 250, &shifts.0, &mut want);
                for level in Level::available() {
                    let left = Guarded::new(&left, Edge::End);
                    let mut got = Guarded::new(&vec![9; n], Edge::End);
                    best_candidates(level, &left, &right, 250, &shifts, &mut got);
                    assert_eq!(got[..], want[..], "{level} {n} {count}");
                }
            }
        }
    }

    #[test]
    fn the_key_names_the_best_candidate() {
        let mut random = Random::new(3);
        let right: Vec<u64> = (0..400).map(|_| random.bits()).collect();
        let mut shifts = Shifts::default();
        shifts.extend([-31, -30, -4, 0, 7, 8, 90]);
        let left: Vec<u64> = (0..64).map(|i| right[100 + i - 7]).collect();
        let mut best = vec![0; 64];
        best_candidates(Level::best(), &left, &right, 100, &shifts, &mut best);
        assert!(best.iter().all(|b| *b == 38), "{best:?}");
    }

    #[test]
    fn the_nearest_is_the_first_of_the_smallest_distance_at_every_level() {
        let mut random = Random::new(5);
        for n in [0usize, 1, 7, 8, 9, 64, 101] {
            let value = random.bits();
            let row: Vec<u64> =
                (0..n).map(|_| value ^ (random.bits() & random.bits() & random.bits())).collect();
            let distances = row.iter().map(|r| (r ^ value).count_ones());
            let want = distances.enumerate().map(|(i, d)| (d, i)).min();
            for (level, edge) in Level::available().flat_map(|l| Edge::BOTH.map(|e| (l, e))) {
                let got = nearest(level, value, &Guarded::new(&row, edge));
                assert_eq!(got, want, "{level} {n}");
            }
        }
    }

    #[test]
    fn what_is_not_taken_stands_side_by_side_at_every_level() {
        let mut random = Random::new(6);
        for n in [0_usize, 1, 31, 32, 33, 100, 333] {
            let row: Vec<u64> = (0..n).map(|_| random.bits()).collect();
            for one_in in [1, 2, 9] {
                let taken: Vec<u8> =
                    (0..n).map(|_| u8::from(!random.bits().is_multiple_of(one_in))).collect();
                let want: Vec<(u64, u16)> =
                    (0..n).filter(|i| taken[*i] == 0).map(|i| (row[i], i as u16)).collect();
                for (level, edge) in Level::available().flat_map(|l| Edge::BOTH.map(|e| (l, e))) {
                    let (taken, row) = (Guarded::new(&taken, edge), Guarded::new(&row, edge));
                    let (mut descriptors, mut columns) = (Vec::new(), Vec::new());
                    let n = untaken(level, &taken, &row, &mut descriptors, &mut columns);
                    let got: Vec<(u64, u16)> =
                        descriptors.into_iter().zip(columns).take(n).collect();
                    assert_eq!(got, want, "{level} {n} {one_in}");
                }
            }
        }
    }
}
