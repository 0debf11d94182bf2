//! Eight-tap products, the inner loop of the resampling: four at a time where the processor can.

use super::kernel::TAPS;

/// Samples and their taps.
pub(super) type Operands<'a> = (&'a [i16; TAPS], &'a [i16; TAPS]);

/// The sum of products, divided by 2^`shift`, rounded and saturated.
pub(super) fn one((samples, taps): Operands<'_>, shift: u32) -> i16 {
    let products = samples.iter().zip(taps).map(|(s, t)| i32::from(*s) * i32::from(*t));
    let sum = (1_i32 << (shift - 1)) + products.sum::<i32>();
    (sum >> shift).clamp(i32::from(i16::MIN), i32::from(i16::MAX)) as i16
}

/// [`one`] of each.
#[cfg(not(target_arch = "x86_64"))]
#[inline(always)]
pub(super) fn four(operands: [Operands<'_>; 4], shift: u32) -> [i16; 4] {
    operands.map(|operands| one(operands, shift))
}

/// [`one`] of each, by SSE2, which every x86-64 processor has.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(super) fn four(operands: [Operands<'_>; 4], shift: u32) -> [i16; 4] {
    use std::arch::x86_64::{
        __m128i, _mm_add_epi32, _mm_cvtsi32_si128, _mm_cvtsi128_si64, _mm_loadu_si128,
        _mm_madd_epi16, _mm_packs_epi32, _mm_set1_epi32, _mm_sra_epi32, _mm_unpackhi_epi32,
        _mm_unpackhi_epi64, _mm_unpacklo_epi32, _mm_unpacklo_epi64,
    };
    let load = |values: &[i16; TAPS]| {
        // SAFETY: the reference is to 16 readable bytes, and the load needs no alignment.
        unsafe { _mm_loadu_si128(values.as_ptr().cast::<__m128i>()) }
    };
    // SAFETY: SSE2 is part of the x86-64 baseline; these work on registers alone.
    let packed = unsafe {
        // Each has the sums of its products of samples 0-1, 2-3, 4-5, 6-7.
        let [a, b, c, d] = operands.map(|(s, t)| _mm_madd_epi16(load(s), load(t)));
        let ab = _mm_add_epi32(_mm_unpacklo_epi32(a, b), _mm_unpackhi_epi32(a, b));
        let cd = _mm_add_epi32(_mm_unpacklo_epi32(c, d), _mm_unpackhi_epi32(c, d));
        let sums = _mm_add_epi32(_mm_unpacklo_epi64(ab, cd), _mm_unpackhi_epi64(ab, cd));
        let rounded = _mm_add_epi32(sums, _mm_set1_epi32(1 << (shift - 1)));
        let shifted = _mm_sra_epi32(rounded, _mm_cvtsi32_si128(shift as i32));
        _mm_cvtsi128_si64(_mm_packs_epi32(shifted, shifted))
    };
    let [a, b, c, d, e, f, g, h] = packed.to_le_bytes();
    [[a, b], [c, d], [e, f], [g, h]].map(i16::from_le_bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Values as large as samples and taps get: eight products stay within 32 bits.
        #[test]
        fn four_are_four_times_one(
            samples in any::<[[i16; TAPS]; 4]>(),
            taps in prop::array::uniform4(prop::array::uniform8(-8000_i16..8000)),
            shift in 8_u32..16,
        ) {
            let operands = [0, 1, 2, 3].map(|k| (&samples[k], &taps[k]));
            prop_assert_eq!(four(operands, shift), operands.map(|o| one(o, shift)));
        }
    }
}
