//! Clean-up of the coarse disparities before the refinement: a small median. (The left-right check and
//! uniqueness are part of the search, which has the costs; [`crate::regions`] removes small regions.)

use rayon::prelude::*;

use crate::Image;

/// Neighbours whose disparities differ by more than this belong to different surfaces.
pub const STEP_PX: f32 = 1.0;

/// Replaces single wrong pixels by the median of their 3x3 neighbours and closes single gaps.
///
/// One wrong coarse pixel would spoil the initial guess of every window it is in. A pixel that agrees
/// with the median within [`STEP_PX`] keeps its value, so that nothing is smoothed. A pixel without a
/// value gets the median where at least five of its neighbours are within [`STEP_PX`] of it: on a
/// surface, not across a step.
pub fn median_3x3(map: &Image<f32>, out: &mut Image<f32>) {
    let (width, height) = (map.width(), map.height());
    assert_eq!((width, height), (out.width(), out.height()));
    out.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let centre = map.row(y)[x];
            let mut near = [0f32; 9];
            let mut count = 0;
            for r in y.saturating_sub(1)..(y + 2).min(height) {
                for &v in &map.row(r)[x.saturating_sub(1)..(x + 2).min(width)] {
                    if !v.is_nan() {
                        near[count] = v;
                        count += 1;
                    }
                }
            }
            *value = centre;
            let near = &mut near[..count];
            if count < 5 {
                continue;
            }
            near.sort_unstable_by(f32::total_cmp);
            let median = near[count / 2];
            let agreeing = near.iter().filter(|v| (*v - median).abs() <= STEP_PX).count();
            let wrong = centre.is_nan() || (centre - median).abs() > STEP_PX;
            if wrong && agreeing >= 5 {
                *value = median;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_mends_a_wrong_pixel_and_a_gap_but_moves_nothing_else() {
        let mut map = Image::new(9, 7, 0f32);
        for y in 0..7 {
            (0..9).for_each(|x| {
                map.set(x, y, 10.0 + 0.3 * x as f32 + if x > 5 { 20.0 } else { 0.0 })
            });
        }
        let truth = map.clone();
        map.set(2, 3, 77.0);
        map.set(4, 1, f32::NAN);
        let mut out = Image::new(9, 7, 0f32);
        median_3x3(&map, &mut out);
        for y in 0..7 {
            for x in 0..9 {
                assert!((out.row(y)[x] - truth.row(y)[x]).abs() <= 0.31, "({x}, {y})");
            }
        }
        assert_eq!(out.row(5), truth.row(5));
    }
}
