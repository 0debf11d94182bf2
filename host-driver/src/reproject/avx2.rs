//! AVX2: 8 pixels at a time, those with a point brought to the front by a table, four by four.

use std::arch::x86_64::*;

use super::{
    Part, Row, Sources,
    front::{FRONT, LANES},
    plain,
};

const _: () = assert!(size_of::<nalgebra::Point3<f32>>() == 3 * size_of::<f32>());

/// # Safety
/// The processor has AVX2; there is as much of everything as [`super::pack_row`] checks.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn pack_row(
    row: &Row,
    from: &Sources<'_>,
    part: &mut Part<'_>,
    mut at: usize,
) -> usize {
    let infinity = _mm256_set1_ps(row.disparity_at_infinity_px);
    let (first, step) = (row.first.map(|v| _mm256_set1_ps(v)), row.step.map(|v| _mm256_set1_ps(v)));
    let numbers = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
    let n = from.disparity_px.len();
    let mut x = 0;
    // Whole vectors are written, of which what lies behind the points does not count.
    while x + 2 * LANES <= n && at + 2 * LANES <= part.points.len() {
        // SAFETY: within the row.
        let d = unsafe { _mm256_loadu_ps(from.disparity_px.as_ptr().add(x)) };
        let parallax = _mm256_sub_ps(d, infinity);
        let valid = _mm256_cmp_ps::<_CMP_GT_OQ>(parallax, _mm256_setzero_ps());
        let valid = _mm256_movemask_ps(valid) as usize;
        if valid != 0 {
            let scale = _mm256_div_ps(_mm256_set1_ps(1.0), parallax);
            let column = _mm256_cvtepi32_ps(_mm256_add_epi32(numbers, _mm256_set1_epi32(x as i32)));
            let mut xyz = [scale; 3];
            for (k, v) in xyz.iter_mut().enumerate() {
                // Not fused, so that every level gives the same.
                let ray = _mm256_add_ps(first[k], _mm256_mul_ps(step[k], column));
                *v = _mm256_mul_ps(ray, scale);
            }
            let halves = [
                xyz.map(|v| _mm256_castps256_ps128(v)),
                xyz.map(|v| _mm256_extractf128_ps::<1>(v)),
            ];
            for (half, xyz) in halves.into_iter().enumerate() {
                let set = valid >> (4 * half) & 15;
                // SAFETY: four of everything from `x + 4 half` on lie within the row, and there is place
                // for four from `at` on.
                unsafe { write_four(xyz, set, from, x + LANES * half, part, at) };
                at += set.count_ones() as usize;
            }
        }
        x += 2 * LANES;
    }
    if x < n { plain::pack_row(row, from, part, x, at) } else { at }
}

/// Writes those of four points that are in the set, and what belongs to them; behind them anything.
///
/// # Safety
/// The processor has AVX2; four of everything are readable from `x` on and writable from `at` on.
#[target_feature(enable = "avx2")]
#[inline]
unsafe fn write_four(
    xyz: [__m128; 3],
    set: usize,
    from: &Sources<'_>,
    x: usize,
    part: &mut Part<'_>,
    at: usize,
) {
    // SAFETY: 16 bytes; there are as many sets.
    let order = unsafe { _mm_loadu_si128(FRONT[set & 15].as_ptr().cast()) };
    let front = |v| _mm_castsi128_ps(_mm_shuffle_epi8(_mm_castps_si128(v), order));
    let [px, py, pz] = [front(xyz[0]), front(xyz[1]), front(xyz[2])];
    let (xy, yz, zx) = (_mm_unpacklo_ps(px, py), _mm_unpacklo_ps(py, pz), _mm_unpacklo_ps(pz, px));
    let (xy_last, yz_last, zx_last) =
        (_mm_unpackhi_ps(px, py), _mm_unpackhi_ps(py, pz), _mm_unpackhi_ps(pz, px));
    // SAFETY: the caller's promise; a point is three numbers.
    unsafe {
        let to = part.points.as_mut_ptr().add(at).cast::<f32>();
        _mm_storeu_ps(to, _mm_shuffle_ps::<0b11_00_01_00>(xy, zx));
        _mm_storeu_ps(to.add(4), _mm_shuffle_ps::<0b01_00_11_10>(yz, xy_last));
        _mm_storeu_ps(to.add(8), _mm_shuffle_ps::<0b11_10_11_00>(zx_last, yz_last));
        let zncc = _mm_loadu_ps(from.zncc.as_ptr().add(x));
        _mm_storeu_ps(part.zncc.as_mut_ptr().add(at), front(zncc));
        if let Some(rate) = from.rate {
            let rate = _mm_loadu_ps(rate.as_ptr().add(x));
            _mm_storeu_ps(part.rate.as_mut_ptr().add(at), front(rate));
        }
        let grey = from.intensity.as_ptr().add(x).cast::<i32>().read_unaligned();
        let wide = _mm_shuffle_epi8(_mm_cvtepu8_epi32(_mm_cvtsi32_si128(grey)), order);
        let bytes = _mm_shuffle_epi8(wide, _mm_set1_epi32(0x0C08_0400));
        let to = part.intensity.as_mut_ptr().add(at).cast::<i32>();
        to.write_unaligned(_mm_cvtsi128_si32(bytes));
    }
}
