//! NEON: 4 lanes.

use std::arch::aarch64::*;

use super::Lanes;

/// 4 `f32` in a register.
#[derive(Debug, Clone, Copy)]
pub(crate) struct F32x4(float32x4_t);

// SAFETY of every block below: the trait's contract, that only functions compiled for the level
// call these methods; loads and stores pass the caller's promise on.
impl Lanes for F32x4 {
    type Mask = uint32x4_t;
    const COUNT: usize = 4;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vdupq_n_f32(value) })
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vld1q_f32(from) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: see the impl.
        unsafe { vst1q_f32(to, self.0) }
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vaddq_f32(self.0, other.0) })
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vsubq_f32(self.0, other.0) })
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vmulq_f32(self.0, other.0) })
    }
    #[inline(always)]
    fn reciprocal(self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vdivq_f32(vdupq_n_f32(1.0), self.0) })
    }
    #[inline(always)]
    fn reciprocal_sqrt(self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vdivq_f32(vdupq_n_f32(1.0), vsqrtq_f32(self.0)) })
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vfmaq_f32(addend.0, self.0, factor.0) })
    }
    #[inline(always)]
    fn neg_mul_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vfmsq_f32(addend.0, self.0, factor.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vabsq_f32(self.0) })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> uint32x4_t {
        // SAFETY: see the impl.
        unsafe { vcltq_f32(self.0, other.0) }
    }
    #[inline(always)]
    fn both(a: uint32x4_t, b: uint32x4_t) -> uint32x4_t {
        // SAFETY: see the impl.
        unsafe { vandq_u32(a, b) }
    }
    #[inline(always)]
    fn select(mask: uint32x4_t, yes: Self, no: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { vbslq_f32(mask, yes.0, no.0) })
    }
    #[inline(always)]
    fn any(mask: uint32x4_t) -> bool {
        // SAFETY: see the impl.
        unsafe { vmaxvq_u32(mask) != 0 }
    }
}
