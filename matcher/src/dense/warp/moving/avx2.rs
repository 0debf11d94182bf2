//! AVX2: 8 pixels a block; each pixel's eight taps are one load, summed by horizontal additions.

use std::arch::x86_64::*;

use super::{Kernels, Sample};

/// Does whole blocks, and returns the number of pixels done.
///
/// # Safety
/// The processor has AVX2; `place` lies within the row with all eight taps; `grey` is at least as
/// long as `place`.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn blocks(
    kernels: &Kernels,
    row: &[Sample],
    place: &[i32],
    grey: &mut [i16],
) -> usize {
    let half = _mm256_set1_epi32(0x8000);
    let blocks = place.len() / 8;
    for i in (0..blocks * 8).step_by(8) {
        let mut products = [half; 4];
        for (j, product) in products.iter_mut().enumerate() {
            let (low, high) = (place[i + j], place[i + j + 4]);
            let taps = |place: i32| kernels.taps[(place & 15) as usize].as_ptr();
            let samples = |place: i32| {
                // SAFETY: the caller's promise: the first tap lies within the row.
                unsafe { row.as_ptr().add(((place >> 4) - 3) as usize) }
            };
            // SAFETY: a phase's taps are 16 bytes, and the row holds eight samples from the first.
            *product = unsafe {
                _mm256_madd_epi16(two(samples(low), samples(high)), two(taps(low), taps(high)))
            };
        }
        let all = _mm256_hadd_epi32(
            _mm256_hadd_epi32(products[0], products[1]),
            _mm256_hadd_epi32(products[2], products[3]),
        );
        let g = _mm256_srai_epi32::<16>(_mm256_add_epi32(all, half));
        let words = _mm256_permute4x64_epi64::<0b1000>(_mm256_packs_epi32(g, g));
        // SAFETY: `i + 8` lies within the row of results.
        unsafe {
            _mm_storeu_si128(grey.as_mut_ptr().add(i).cast(), _mm256_castsi256_si128(words));
        }
    }
    blocks * 8
}

/// Eight samples from each of two places.
///
/// # Safety
/// They are readable.
#[target_feature(enable = "avx2")]
#[inline]
unsafe fn two(low: *const i16, high: *const i16) -> __m256i {
    // SAFETY: the caller's promise.
    unsafe {
        _mm256_inserti128_si256::<1>(
            _mm256_castsi128_si256(_mm_loadu_si128(low.cast())),
            _mm_loadu_si128(high.cast()),
        )
    }
}
