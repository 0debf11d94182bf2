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

/// For each `left[i]` the candidate c of smallest Hamming distance to `right[origin + i - shifts[c]]`;
/// ties go to the first. `best[i]` = distance << 16 | c.
pub(crate) fn best_candidates(
    level: Level,
    left: &[u64],
    right: &[u64],
    origin: usize,
    shifts: &[i32],
    best: &mut [u32],
) {
    let n = left.len();
    assert!(n.is_multiple_of(BLOCK) && best.len() == n && shifts.len() <= 1 << 16);
    for &shift in shifts {
        let first = origin as i64 - i64::from(shift);
        assert!(first >= 0 && first as usize + n <= right.len(), "candidate outside the row");
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Random;

    #[test]
    fn levels_are_bit_equal() {
        let mut random = Random::new(11);
        let right: Vec<u64> = (0..700).map(|_| random.bits()).collect();
        for n in [32, 64, 160] {
            let left: Vec<u64> =
                (0..n).map(|i| right[i + 100] ^ (1 << (random.bits() % 64))).collect();
            for count in [0usize, 1, 2, 7, 130] {
                let shifts: Vec<i32> =
                    (0..count).map(|_| (random.bits() % 300) as i32 - 100).collect();
                let mut want = vec![9; n];
                scalar::search(&left, &right, 250, &shifts, &mut want);
                for level in Level::available() {
                    let mut got = vec![9; n];
                    best_candidates(level, &left, &right, 250, &shifts, &mut got);
                    assert_eq!(got, want, "{level} {n} {count}");
                }
            }
        }
    }
}
