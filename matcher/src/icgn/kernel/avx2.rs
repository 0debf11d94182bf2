//! Lanes with AVX2 and FMA.

use std::arch::x86_64::*;

use super::{Constants, Reference, WarpSums, body, lanes::Lanes};
use crate::icgn::{
    prepare::Prepared,
    window::{Place, Window},
};

#[derive(Clone, Copy)]
struct Eight(__m256);

// SAFETY of every block: the lanes are used only inside the functions below, which are compiled for
// AVX2 and FMA; loads read what the caller of `load` promises.
impl Lanes for Eight {
    const N: usize = 8;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_set1_ps(value)) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_loadu_ps(from)) }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: see above.
        unsafe { _mm256_storeu_ps(to, self.0) }
    }

    #[inline(always)]
    unsafe fn store_whole(self, to: *mut i32) {
        // SAFETY: see above.
        unsafe { _mm256_storeu_si256(to.cast(), _mm256_cvtps_epi32(self.0)) }
    }

    #[inline(always)]
    fn floor(self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_floor_ps(self.0)) }
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_sub_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_min_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_max_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_add_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_mul_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm256_fmadd_ps(self.0, factor.0, term.0)) }
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        // SAFETY: see above.
        unsafe {
            let half = _mm_add_ps(_mm256_castps256_ps128(self.0), _mm256_extractf128_ps(self.0, 1));
            let pair = _mm_add_ps(half, _mm_movehl_ps(half, half));
            _mm_cvtss_f32(_mm_add_ss(pair, _mm_movehdup_ps(pair)))
        }
    }
}

/// # Safety
/// As [`body::warp_sums`], on a machine with these instructions.
#[target_feature(enable = "avx2,fma")]
pub(super) unsafe fn warp_sums<const TAPS: usize, const K: usize>(
    prepared: &Prepared,
    window: &Window,
    place: Place,
    t: [f32; 6],
    constants: &Constants,
) -> WarpSums {
    // SAFETY: as the caller promises.
    unsafe { body::warp_sums::<Eight, TAPS, K>(prepared, window, place, t, constants) }
}

/// # Safety
/// As [`body::reference`], on a machine with these instructions.
#[target_feature(enable = "avx2,fma")]
pub(super) unsafe fn reference<const K: usize>(
    prepared: &Prepared,
    window: &Window,
    x: usize,
    y: usize,
) -> Reference {
    // SAFETY: as the caller promises.
    unsafe { body::reference::<Eight, K>(prepared, window, x, y) }
}
