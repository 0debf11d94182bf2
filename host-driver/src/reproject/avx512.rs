//! AVX-512 with VBMI2: 16 pixels at a time, those without a point left out by compression.

use std::arch::x86_64::*;

use super::{Part, Row, Sources};

const _: () = assert!(size_of::<nalgebra::Point3<f32>>() == 3 * size_of::<f32>());

/// Pixels of a vector.
const LANES: usize = 16;

/// For 16 triples as three vectors: which x or y is in each place, and then which of those or of z.
const ORDER: [[[i32; LANES]; 2]; 3] = {
    let mut order = [[[0; LANES]; 2]; 3];
    let mut i = 0;
    while i < 3 * LANES {
        let (vector, lane, pixel) = (i / LANES, i % LANES, (i / 3) as i32);
        order[vector][0][lane] = if i % 3 == 1 { LANES as i32 + pixel } else { pixel };
        order[vector][1][lane] = if i % 3 == 2 { LANES as i32 + pixel } else { lane as i32 };
        i += 1;
    }
    order
};

/// # Safety
/// The processor has the features; there is as much of everything as [`super::pack_row`] checks.
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512vbmi2")]
pub(super) unsafe fn pack_row(
    row: &Row,
    from: &Sources<'_>,
    part: &mut Part<'_>,
    mut at: usize,
) -> usize {
    let infinity = _mm512_set1_ps(row.disparity_at_infinity_px);
    let (first, step) = (row.first.map(|v| _mm512_set1_ps(v)), row.step.map(|v| _mm512_set1_ps(v)));
    let numbers = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    // SAFETY: 64 bytes each.
    let order = ORDER.map(|pair| pair.map(|o| unsafe { _mm512_loadu_si512(o.as_ptr().cast()) }));
    let n = from.disparity_px.len();
    for x in (0..n).step_by(LANES) {
        let inside = u16::MAX >> (LANES - (n - x).min(LANES));
        // SAFETY: only what is inside the row is read.
        let d = unsafe { _mm512_maskz_loadu_ps(inside, from.disparity_px.as_ptr().add(x)) };
        let parallax = _mm512_sub_ps(d, infinity);
        let zero = _mm512_setzero_ps();
        let valid = _mm512_mask_cmp_ps_mask::<_CMP_GT_OQ>(inside, parallax, zero);
        if valid == 0 {
            continue;
        }
        let scale = _mm512_div_ps(_mm512_set1_ps(1.0), parallax);
        let column = _mm512_cvtepi32_ps(_mm512_add_epi32(numbers, _mm512_set1_epi32(x as i32)));
        let mut xyz = [zero; 3];
        for (k, v) in xyz.iter_mut().enumerate() {
            // Not fused, so that every level gives the same.
            let ray = _mm512_add_ps(first[k], _mm512_mul_ps(step[k], column));
            *v = _mm512_maskz_compress_ps(valid, _mm512_mul_ps(ray, scale));
        }
        let count = valid.count_ones() as usize;
        assert!(at + count <= part.points.len(), "more points than were counted");
        let triples = (1_u64 << (3 * count)) - 1;
        let here = u16::MAX >> (LANES - count);
        // SAFETY: `count` of everything are read, within the row, and written, from `at` on, where
        // there is place for them; a point is three numbers.
        unsafe {
            let to = part.points.as_mut_ptr().add(at).cast::<f32>();
            for (k, [pairs, triple]) in order.into_iter().enumerate() {
                let both = _mm512_permutex2var_ps(xyz[0], pairs, xyz[1]);
                let all = _mm512_permutex2var_ps(both, triple, xyz[2]);
                _mm512_mask_storeu_ps(to.add(LANES * k), (triples >> (LANES * k)) as u16, all);
            }
            let zncc = _mm512_maskz_loadu_ps(valid, from.zncc.as_ptr().add(x));
            let zncc = _mm512_maskz_compress_ps(valid, zncc);
            _mm512_mask_storeu_ps(part.zncc.as_mut_ptr().add(at), here, zncc);
            let grey = _mm_maskz_loadu_epi8(valid, from.intensity.as_ptr().add(x).cast());
            let grey = _mm_maskz_compress_epi8(valid, grey);
            _mm_mask_storeu_epi8(part.intensity.as_mut_ptr().add(at).cast(), here, grey);
            if let Some(rate) = from.rate {
                let rate = _mm512_maskz_loadu_ps(valid, rate.as_ptr().add(x));
                let rate = _mm512_maskz_compress_ps(valid, rate);
                _mm512_mask_storeu_ps(part.rate.as_mut_ptr().add(at), here, rate);
            }
        }
        at += count;
    }
    at
}
