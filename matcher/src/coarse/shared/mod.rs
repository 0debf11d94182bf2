//! What left pixels do to the right pixels that they match, a row at a time.
//!
//! Pixel by pixel this would be a write to a place that the last one may have written as well. But
//! neighbours' disparities are mostly alike, and the pixels of a block that share one have their right
//! pixels side by side: each disparity of a block is dealt with at once.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;

use crate::Level;

/// Most pixels of a block, and places before and after a row that blocks may reach.
pub(super) const BLOCK: usize = 32;

/// Disparities of a block that are dealt with at once; pixels of others follow one by one.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
const SPREAD: usize = 4;

/// Where the right pixels of the left pixels from `x` on are, in a row with [`BLOCK`] places before its
/// first pixel.
#[inline(always)]
fn place(x: usize, disparity: i16) -> usize {
    (x + BLOCK).wrapping_add_signed(-isize::from(disparity))
}

/// Lets each left pixel with a disparity claim its right pixel: the least of cost << 16 | column remains,
/// of which `claims` has [`BLOCK`] more before and after the row's.
pub(super) fn claim(level: Level, disparity: &[i16], cost: &[u8], claims: &mut [u32]) {
    assert!(cost.len() == disparity.len());
    match level {
        // SAFETY: trusted levels are the processor's; as many costs as disparities.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::claim(disparity, cost, claims) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::claim(disparity, cost, claims) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::claim(disparity, cost, claims) },
        _ => scalar::claim(0, disparity, cost, claims),
    }
}

/// Takes the disparity of those whose right pixel has an owner more than `most` columns away.
pub(super) fn keep(level: Level, claims: &[u32], most: u16, disparity: &mut [i16]) {
    match level {
        // SAFETY: trusted levels are the processor's.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::keep(claims, most, disparity) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::keep(claims, most, disparity) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::keep(claims, most, disparity) },
        _ => scalar::keep(0, claims, most, disparity),
    }
}

/// Sets the right pixels of those left pixels that differ in no more than `most` bits, of which `taken`
/// has [`BLOCK`] more before and after the row's.
pub(super) fn take(level: Level, disparity: &[i16], cost: &[u8], most: u8, taken: &mut [u8]) {
    assert!(cost.len() == disparity.len());
    match level {
        // SAFETY: trusted levels are the processor's; as many costs as disparities.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::take(disparity, cost, most, taken) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::take(disparity, cost, most, taken) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::take(disparity, cost, most, taken) },
        _ => scalar::take(0, disparity, cost, most, taken),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        coarse::INVALID,
        guarded::{Edge, Guarded},
        synthetic::Random,
    };

    /// Blocks of one disparity, of some, of many and of none.
    #[test]
    fn levels_are_bit_equal() {
        let mut random = Random::new(21);
        for n in [1_usize, 15, 16, 31, 32, 33, 130, 400] {
            for spread in [1, 3, 40] {
                let disparity: Vec<i16> = (0..n)
                    .map(|x| {
                        let at = x as u64 * 2 / 3 + random.bits() % spread / 3;
                        let none = random.bits().is_multiple_of(7) || x / 32 == 2;
                        if none { INVALID } else { x as i16 - at.min(n as u64 - 1) as i16 }
                    })
                    .collect();
                let cost: Vec<u8> = disparity
                    .iter()
                    .map(|d| if *d == INVALID { 255 } else { (random.bits() % 20) as u8 })
                    .collect();
                let mut want = vec![u32::MAX; n + 2 * BLOCK];
                scalar::claim(0, &disparity, &cost, &mut want);
                assert!(want[..BLOCK].iter().chain(&want[n + BLOCK..]).all(|c| *c == u32::MAX));
                let mut want_kept = disparity.clone();
                scalar::keep(0, &want, 2, &mut want_kept);
                let mut want_taken = vec![0; n + 2 * BLOCK];
                scalar::take(0, &disparity, &cost, 9, &mut want_taken);
                for (level, edge) in Level::available().flat_map(|l| Edge::BOTH.map(|e| (l, e))) {
                    let cost = Guarded::new(&cost, edge);
                    let mut claims = Guarded::new(&vec![u32::MAX; n + 2 * BLOCK], edge);
                    let mut kept = Guarded::new(&disparity, edge);
                    claim(level, &kept, &cost, &mut claims);
                    assert_eq!(claims[..], want[..], "{level} {n} {spread}");
                    let mut taken = Guarded::new(&vec![0; n + 2 * BLOCK], edge);
                    take(level, &kept, &cost, 9, &mut taken);
                    assert_eq!(taken[..], want_taken[..], "{level} {n} {spread}");
                    keep(level, &claims, 2, &mut kept);
                    assert_eq!(kept[..], want_kept[..], "{level} {n} {spread}");
                }
            }
        }
    }
}
