//! Lanes in plain Rust.

use super::{Constants, Reference, WarpSums, body, lanes::Lanes};
use crate::icgn::{
    prepare::Prepared,
    window::{Place, Window},
};

#[derive(Clone, Copy)]
struct Four([f32; 4]);

impl Four {
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|i| f(self.0[i], other.0[i])))
    }
}

impl Lanes for Four {
    const N: usize = 4;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; 4])
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller promises four values; an array has no alignment beyond theirs.
        Self(unsafe { from.cast::<[f32; 4]>().read() })
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller promises room for four values.
        unsafe { to.cast::<[f32; 4]>().write(self.0) }
    }

    #[inline(always)]
    unsafe fn store_whole(self, to: *mut i32) {
        // SAFETY: the caller promises room for four values, and their range.
        unsafe { to.cast::<[i32; 4]>().write(self.0.map(|v| v.to_int_unchecked())) }
    }

    #[inline(always)]
    fn floor(self) -> Self {
        // SAFETY: the lanes are within the range of i32.
        let whole = self.0.map(|v| unsafe { v.to_int_unchecked::<i32>() } as f32);
        Self(whole).zip(self, |whole, v| if whole > v { whole - 1.0 } else { whole })
    }

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, term: Self) -> Self {
        self.mul(factor).add(term)
    }

    #[inline(always)]
    fn sum(self) -> f32 {
        (self.0[0] + self.0[2]) + (self.0[1] + self.0[3])
    }
}

/// # Safety
/// As [`body::warp_sums`].
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
/// As [`body::reference`].
pub(super) unsafe fn reference<const K: usize>(
    prepared: &Prepared,
    window: &Window,
    x: usize,
    y: usize,
) -> Reference {
    // SAFETY: as the caller promises.
    unsafe { body::reference::<Four, K>(prepared, window, x, y) }
}
