//! Lanes with NEON.

use std::arch::aarch64::*;

use super::{Constants, Reference, WarpSums, body, lanes::Lanes};
use crate::icgn::{
    prepare::Prepared,
    window::{Place, Window},
};

#[derive(Clone, Copy)]
struct Four(float32x4_t);

// SAFETY of every block: the lanes are used only inside the functions below, which are compiled for
// NEON; loads read what the caller of `load` promises.
impl Lanes for Four {
    const N: usize = 4;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see above.
        unsafe { Self(vdupq_n_f32(value)) }
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: see above.
        unsafe { Self(vld1q_f32(from)) }
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: see above.
        unsafe { vst1q_f32(to, self.0) }
    }

    #[inline(always)]
    unsafe fn store_whole(self, to: *mut i32) {
        // SAFETY: see above.
        unsafe { vst1q_s32(to, vcvtq_s32_f32(self.0)) }
    }

    #[inline(always)]
    fn floor(self) -> Self {
        // SAFETY: see above.
        unsafe { Self(vrndmq_f32(self.0)) }
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(vsubq_f32(self.0, other.0)) }
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(vminq_f32(self.0, other.0)) }
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(vmaxq_f32(self.0, other.0)) }
    }

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(vaddq_f32(self.0, other.0)) }
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(vmulq_f32(self.0, other.0)) }
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(vfmaq_f32(term.0, self.0, factor.0)) }
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        // SAFETY: see above.
        unsafe { vaddvq_f32(self.0) }
    }
}

/// # Safety
/// As [`body::warp_sums`], on a machine with these instructions.
#[target_feature(enable = "neon")]
pub(super) unsafe fn warp_sums<const TAPS: usize, const K: usize>(
    prepared: &Prepared,
    window: &Window,
    place: Place,
    t: [f32; 6],
    constants: &Constants,
) -> WarpSums {
    // SAFETY: as the caller promises.
    unsafe { body::warp_sums::<Four, TAPS, K>(prepared, window, place, t, constants) }
}

/// # Safety
/// As [`body::reference`], on a machine with these instructions.
#[target_feature(enable = "neon")]
pub(super) unsafe fn reference<const K: usize>(
    prepared: &Prepared,
    window: &Window,
    x: usize,
    y: usize,
) -> Reference {
    // SAFETY: as the caller promises.
    unsafe { body::reference::<Four, K>(prepared, window, x, y) }
}
