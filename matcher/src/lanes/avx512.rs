//! AVX-512: 16 lanes, masks in mask registers.

use std::arch::x86_64::*;

use super::Lanes;

/// 16 `f32` in a register.
#[derive(Debug, Clone, Copy)]
pub(crate) struct F32x16(__m512);

// SAFETY of every block below: the trait's contract, that only functions compiled for the level
// call these methods; loads and stores pass the caller's promise on.
impl Lanes for F32x16 {
    type Mask = __mmask16;
    const COUNT: usize = 16;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_set1_ps(value) })
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_loadu_ps(from) })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: see the impl.
        unsafe { _mm512_storeu_ps(to, self.0) }
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_add_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_sub_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_mul_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn reciprocal(self) -> Self {
        // SAFETY: see the impl.
        // One Newton step on the processor's estimate.
        let estimate = Self(unsafe { _mm512_rcp14_ps(self.0) });
        let error = self.neg_mul_add(estimate, Self::splat(1.0));
        estimate.mul_add(error, estimate)
    }
    #[inline(always)]
    fn reciprocal_sqrt(self) -> Self {
        // SAFETY: see the impl.
        // One Newton step on the processor's estimate.
        let estimate = Self(unsafe { _mm512_rsqrt14_ps(self.0) });
        let half = self.mul(Self::splat(0.5)).mul(estimate);
        estimate.mul(half.neg_mul_add(estimate, Self::splat(1.5)))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_fmadd_ps(self.0, factor.0, addend.0) })
    }
    #[inline(always)]
    fn neg_mul_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_fnmadd_ps(self.0, factor.0, addend.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_abs_ps(self.0) })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> __mmask16 {
        // SAFETY: see the impl.
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0) }
    }
    #[inline(always)]
    fn both(a: __mmask16, b: __mmask16) -> __mmask16 {
        a & b
    }
    #[inline(always)]
    fn select(mask: __mmask16, yes: Self, no: Self) -> Self {
        // SAFETY: see the impl.
        Self(unsafe { _mm512_mask_blend_ps(mask, no.0, yes.0) })
    }
    #[inline(always)]
    fn any(mask: __mmask16) -> bool {
        mask != 0
    }
    const AHEAD: bool = true;
    #[inline(always)]
    fn ahead<const K: i32>(self, next: Self) -> Self {
        // SAFETY: see the impl.
        unsafe {
            let (low, high) = (_mm512_castps_si512(self.0), _mm512_castps_si512(next.0));
            Self(_mm512_castsi512_ps(_mm512_alignr_epi32::<K>(high, low)))
        }
    }
}
