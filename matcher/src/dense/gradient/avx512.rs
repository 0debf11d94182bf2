//! AVX-512 with VNNI: 32 pixels a block.

use std::arch::x86_64::*;

use super::{SQUARE_SHIFT, Static};
use crate::{Sample, dense::kernels::Kernels};

/// # Safety
/// The processor has the features; for each block `at`, its pixels lie within `out`, and within
/// every row with 3 samples on both sides.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512vnni")]
pub(super) unsafe fn blocks(
    kernels: &Kernels,
    left: &[&[Sample]],
    x0: usize,
    blocks: impl Iterator<Item = usize>,
    out: &mut Static<'_>,
) {
    let mut order = [[0i16; 32]; 2];
    for (half, o) in order.iter_mut().enumerate() {
        for (i, v) in o.iter_mut().enumerate() {
            *v = (half * 16 + i / 2 + (i % 2) * 32) as i16;
        }
    }
    // SAFETY: arrays of 64 bytes.
    let order = unsafe {
        [_mm512_loadu_si512(order[0].as_ptr().cast()), _mm512_loadu_si512(order[1].as_ptr().cast())]
    };
    let c = [
        _mm512_set1_epi16(kernels.gradient[0]),
        _mm512_set1_epi16(kernels.gradient[1]),
        _mm512_set1_epi16(kernels.gradient[2]),
    ];
    let quarter = _mm512_set1_epi16(8192);
    let ones = _mm512_set1_epi16(1);
    for at in blocks {
        let zero = _mm512_setzero_si512();
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
                    grey[f] = _mm512_mulhrs_epi16(_mm512_loadu_si512(p.offset(0).cast()), quarter);
                    let near = _mm512_subs_epi16(
                        _mm512_loadu_si512(p.offset(1).cast()),
                        _mm512_loadu_si512(p.offset(-1).cast()),
                    );
                    let middle = _mm512_subs_epi16(
                        _mm512_loadu_si512(p.offset(2).cast()),
                        _mm512_loadu_si512(p.offset(-2).cast()),
                    );
                    let far = _mm512_subs_epi16(
                        _mm512_loadu_si512(p.offset(3).cast()),
                        _mm512_loadu_si512(p.offset(-3).cast()),
                    );
                    gradient[f] = _mm512_add_epi16(
                        _mm512_add_epi16(
                            _mm512_mulhrs_epi16(near, c[0]),
                            _mm512_mulhrs_epi16(middle, c[1]),
                        ),
                        _mm512_mulhrs_epi16(far, c[2]),
                    );
                }
            }
            let word = pair * out.stride + at;
            for half in 0..2 {
                let g = _mm512_permutex2var_epi16(gradient[0], order[half], gradient[1]);
                let l = _mm512_permutex2var_epi16(grey[0], order[half], grey[1]);
                // SAFETY: `word + 32` lies within both outputs.
                unsafe {
                    _mm512_storeu_si512(out.gradient.as_mut_ptr().add(word + half * 16).cast(), g);
                    _mm512_storeu_si512(out.grey.as_mut_ptr().add(word + half * 16).cast(), l);
                }
                let s = &mut sums[half];
                s[0] = _mm512_dpwssd_epi32(s[0], g, g);
                s[1] = _mm512_dpwssd_epi32(s[1], g, l);
                s[2] = _mm512_dpwssd_epi32(s[2], g, ones);
                s[3] = _mm512_dpwssd_epi32(s[3], l, ones);
                s[4] = _mm512_dpwssd_epi32(s[4], l, l);
            }
        }
        for (half, s) in sums.iter_mut().enumerate() {
            let rounding = _mm512_set1_epi32(1 << (SQUARE_SHIFT - 1));
            s[4] = _mm512_srai_epi32::<{ SQUARE_SHIFT }>(_mm512_add_epi32(s[4], rounding));
            let maps = [&mut *out.s, &mut *out.il, &mut *out.i, &mut *out.l, &mut *out.ll];
            for (map, s) in maps.into_iter().zip(*s) {
                // SAFETY: `at + 32` lies within every map.
                unsafe {
                    let to = map.as_mut_ptr().add(at + half * 16);
                    _mm512_storeu_ps(to, _mm512_cvtepi32_ps(s));
                }
            }
        }
    }
}
