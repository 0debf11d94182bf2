//! Lanes with AVX-512.

use std::arch::x86_64::*;

use super::{Constants, Reference, WarpSums, body, lanes::Lanes};
use crate::icgn::{
    prepare::Prepared,
    window::{Place, Window},
};

#[derive(Clone, Copy)]
struct Sixteen(__m512);

// SAFETY of every block: the lanes are used only inside the functions below, which are compiled for
// AVX-512; loads read what the caller of `load` promises.
impl Lanes for Sixteen {
    const N: usize = 16;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_set1_ps(value)) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_loadu_ps(from)) }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: see above.
        unsafe { _mm512_storeu_ps(to, self.0) }
    }

    #[inline(always)]
    unsafe fn store_whole(self, to: *mut i32) {
        // SAFETY: see above.
        unsafe { _mm512_storeu_si512(to.cast(), _mm512_cvtps_epi32(self.0)) }
    }

    #[inline(always)]
    fn floor(self) -> Self {
        // SAFETY: see above.
        unsafe {
            Self(_mm512_roundscale_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(self.0))
        }
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_sub_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_min_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_max_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_add_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_mul_ps(self.0, other.0)) }
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_fmadd_ps(self.0, factor.0, term.0)) }
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        // SAFETY: see above.
        unsafe { _mm512_reduce_add_ps(self.0) }
    }
}

/// # Safety
/// As [`body::warp_sums`], on a machine with these instructions.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx2,fma")]
pub(super) unsafe fn warp_sums<const TAPS: usize, const K: usize>(
    prepared: &Prepared,
    window: &Window,
    place: Place,
    t: [f32; 6],
    constants: &Constants,
) -> WarpSums {
    // SAFETY: as the caller promises.
    unsafe { body::warp_sums::<Sixteen, TAPS, K>(prepared, window, place, t, constants) }
}

/// # Safety
/// As [`body::reference`], on a machine with these instructions.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx2,fma")]
pub(super) unsafe fn reference<const K: usize>(
    prepared: &Prepared,
    window: &Window,
    x: usize,
    y: usize,
) -> Reference {
    // SAFETY: as the caller promises.
    unsafe { body::reference::<Sixteen, K>(prepared, window, x, y) }
}
