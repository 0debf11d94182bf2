//! Census comparison kernels: one row of descriptors from the rows of its window.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod scalar;

use super::BLOCK;
use crate::{Level, Sample, params::RADIUS_LIMIT};

type Kernel = fn(rows: &[&[Sample]], radius: usize, thresholds: &[Sample], planes: &mut [u16]);

/// The census kernel of one SIMD level.
#[derive(Debug, Clone, Copy)]
pub struct CensusKernel(Kernel);

impl CensusKernel {
    /// The kernel of `level`, or of the best level below it that this machine runs.
    pub fn new(level: Level) -> Self {
        Self(match level.usable() {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: `usable` returns only levels whose instructions this machine has.
            Level::Avx512 => |r, n, t, p| unsafe { avx512::census(r, n, t, p) },
            #[cfg(target_arch = "x86_64")]
            // SAFETY: as above.
            Level::Avx2 => |r, n, t, p| unsafe { avx2::census(r, n, t, p) },
            #[cfg(target_arch = "aarch64")]
            // SAFETY: as above.
            Level::Neon => |r, n, t, p| unsafe { neon::census(r, n, t, p) },
            _ => scalar::census,
        })
    }

    /// Compares every sample of every window with its threshold.
    ///
    /// `rows`: for each frame its 2R+1 window rows, each with margins of [`RADIUS_LIMIT`] samples.
    /// `thresholds`: one per column, padded to whole blocks. `planes`: as in
    /// [`super::CensusRow`], written completely.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn run(self, rows: &[&[Sample]], radius: usize, thresholds: &[Sample], planes: &mut [u16]) {
        let stride = thresholds.len();
        let side = 2 * radius + 1;
        assert!(radius <= RADIUS_LIMIT && rows.len().is_multiple_of(side));
        assert!(stride.is_multiple_of(BLOCK));
        assert!(rows.iter().all(|r| r.len() >= stride + 2 * RADIUS_LIMIT));
        assert!(planes.len() >= (rows.len() * side).div_ceil(16) * stride);
        (self.0)(rows, radius, thresholds, planes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_bit_equal() {
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 48) as u16 as i16 / 8
        };
        let cases: [(usize, usize, usize); 5] =
            [(1, 1, 32), (3, 2, 64), (10, 2, 96), (16, 4, 32), (2, 8, 64)];
        for (frames, radius, stride) in cases {
            let side = 2 * radius + 1;
            let data: Vec<Vec<i16>> = (0..frames * side)
                .map(|_| (0..stride + 2 * RADIUS_LIMIT).map(|_| random()).collect())
                .collect();
            let rows: Vec<&[i16]> = data.iter().map(Vec::as_slice).collect();
            let thresholds: Vec<i16> = (0..stride).map(|_| random() / 4).collect();
            let planes = (frames * side * side).div_ceil(16) * stride;
            let mut expected = vec![0u16; planes];
            scalar::census(&rows, radius, &thresholds, &mut expected);
            for level in Level::available() {
                let mut got = vec![0xaaaau16; planes];
                CensusKernel::new(level).run(&rows, radius, &thresholds, &mut got);
                assert!(got == expected, "{level}: {frames} frames, radius {radius}");
            }
        }
    }
}
