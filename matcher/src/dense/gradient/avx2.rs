//! AVX2: 16 pixels a block.

use std::arch::x86_64::*;

use super::{SQUARE_SHIFT, Static};
use crate::{Sample, dense::kernels::Kernels};

/// # Safety
/// The processor has the features; for each block `at`, its pixels lie within `out`, and within
/// every row with 3 samples on both sides.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn blocks(
    kernels: &Kernels,
    left: &[&[Sample]],
    x0: usize,
    blocks: impl Iterator<Item = usize>,
    out: &mut Static<'_>,
) {
    let c = [
        _mm256_set1_epi16(kernels.gradient[0]),
        _mm256_set1_epi16(kernels.gradient[1]),
        _mm256_set1_epi16(kernels.gradient[2]),
    ];
    let quarter = _mm256_set1_epi16(8192);
    let ones = _mm256_set1_epi16(1);
    for at in blocks {
        let zero = _mm256_setzero_si256();
        let mut sums = [[zero; 5]; 2];
        for (pair, rows) in left.chunks_exact(2).enumerate() {
            let mut grey = [zero; 2];
            let mut gradient = [zero; 2];
            for f in 0..2 {
                // SAFETY: the caller's promise covers 3 samples on both sides.
                unsafe {
                    let p = rows[f].as_ptr().add(x0 + at);
                    // The image's next row.
                    _mm_prefetch::<_MM_HINT_T0>(p.wrapping_add(rows[f].len()).cast());
                    // Written out: closures over vectors are not always inlined.
                    grey[f] = _mm256_mulhrs_epi16(_mm256_loadu_si256(p.offset(0).cast()), quarter);
                    let near = _mm256_subs_epi16(
                        _mm256_loadu_si256(p.offset(1).cast()),
                        _mm256_loadu_si256(p.offset(-1).cast()),
                    );
                    let middle = _mm256_subs_epi16(
                        _mm256_loadu_si256(p.offset(2).cast()),
                        _mm256_loadu_si256(p.offset(-2).cast()),
                    );
                    let far = _mm256_subs_epi16(
                        _mm256_loadu_si256(p.offset(3).cast()),
                        _mm256_loadu_si256(p.offset(-3).cast()),
                    );
                    gradient[f] = _mm256_add_epi16(
                        _mm256_add_epi16(
                            _mm256_mulhrs_epi16(near, c[0]),
                            _mm256_mulhrs_epi16(middle, c[1]),
                        ),
                        _mm256_mulhrs_epi16(far, c[2]),
                    );
                }
            }
            let word = pair * out.stride + at;
            let g = interleave(gradient);
            let l = interleave(grey);
            for half in 0..2 {
                let (g, l) = (g[half], l[half]);
                // SAFETY: `word + 16` lies within both outputs.
                unsafe {
                    _mm256_storeu_si256(out.gradient.as_mut_ptr().add(word + half * 8).cast(), g);
                    _mm256_storeu_si256(out.grey.as_mut_ptr().add(word + half * 8).cast(), l);
                }
                let s = &mut sums[half];
                s[0] = _mm256_add_epi32(s[0], _mm256_madd_epi16(g, g));
                s[1] = _mm256_add_epi32(s[1], _mm256_madd_epi16(g, l));
                s[2] = _mm256_add_epi32(s[2], _mm256_madd_epi16(g, ones));
                s[3] = _mm256_add_epi32(s[3], _mm256_madd_epi16(l, ones));
                s[4] = _mm256_add_epi32(s[4], _mm256_madd_epi16(l, l));
            }
        }
        for (half, s) in sums.iter_mut().enumerate() {
            let rounding = _mm256_set1_epi32(1 << (SQUARE_SHIFT - 1));
            s[4] = _mm256_srai_epi32::<{ SQUARE_SHIFT as i32 }>(_mm256_add_epi32(s[4], rounding));
            let maps = [&mut *out.s, &mut *out.il, &mut *out.i, &mut *out.l, &mut *out.ll];
            for (map, s) in maps.into_iter().zip(*s) {
                // SAFETY: `at + 16` lies within every map.
                unsafe {
                    let to = map.as_mut_ptr().add(at + half * 8);
                    _mm256_storeu_ps(to, _mm256_cvtepi32_ps(s));
                }
            }
        }
    }
}

/// Pairs of 16 pixels in order, 8 a register.
#[target_feature(enable = "avx2")]
fn interleave(frames: [__m256i; 2]) -> [__m256i; 2] {
    let lo = _mm256_unpacklo_epi16(frames[0], frames[1]);
    let hi = _mm256_unpackhi_epi16(frames[0], frames[1]);
    [_mm256_permute2x128_si256::<0x20>(lo, hi), _mm256_permute2x128_si256::<0x31>(lo, hi)]
}
