//! AVX2 with FMA: 8 lanes.

use std::arch::x86_64::*;

use super::Lanes;

/// 8 `f32` in a register.
#[derive(Debug, Clone, Copy)]
pub(crate) struct F32x8(__m256);

// SAFETY of every block below: the trait's contract, that only functions compiled for the level
// call these methods; loads and stores pass the caller's promise on.
impl Lanes for F32x8 {
    type Mask = __m256;
    const COUNT: usize = 8;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_set1_ps(value) })
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_loadu_ps(from) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: see the impl.
        unsafe { _mm256_storeu_ps(to, self.0) }
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_add_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_sub_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_mul_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn reciprocal(self) -> Self {
        // SAFETY: see the impl.
        // One Newton step on the processor's estimate.
        let estimate = Self(unsafe { _mm256_rcp_ps(self.0) });
        let error = self.neg_mul_add(estimate, Self::splat(1.0));
        estimate.mul_add(error, estimate)
    }
    #[inline(always)]
    fn reciprocal_sqrt(self) -> Self {
        // SAFETY: see the impl.
        // One Newton step on the processor's estimate.
        let estimate = Self(unsafe { _mm256_rsqrt_ps(self.0) });
        let half = self.mul(Self::splat(0.5)).mul(estimate);
        estimate.mul(half.neg_mul_add(estimate, Self::splat(1.5)))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_fmadd_ps(self.0, factor.0, addend.0) })
    }
    #[inline(always)]
    fn neg_mul_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_fnmadd_ps(self.0, factor.0, addend.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> __m256 {
        // SAFETY: see the impl.
        unsafe { _mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0) }
    }
    #[inline(always)]
    fn both(a: __m256, b: __m256) -> __m256 {
        // SAFETY: see the impl.
        unsafe { _mm256_and_ps(a, b) }
    }
    #[inline(always)]
    fn select(mask: __m256, yes: Self, no: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm256_blendv_ps(no.0, yes.0, mask) })
    }
    #[inline(always)]
    fn any(mask: __m256) -> bool {
        // SAFETY: see the impl.
        unsafe { _mm256_movemask_ps(mask) != 0 }
    }
}
