//! Census in plain Rust.

use crate::{Sample, params::RADIUS_LIMIT};

pub(super) fn census(rows: &[&[Sample]], radius: usize, thresholds: &[Sample], planes: &mut [u16]) {
    let side = 2 * radius + 1;
    let stride = thresholds.len();
    planes[..(rows.len() * side).div_ceil(16) * stride].fill(0);
    let mut k = 0;
    for window in rows.chunks_exact(side) {
        for i in 0..side {
            for row in window {
                let plane = &mut planes[k / 16 * stride..][..stride];
                let samples = &row[RADIUS_LIMIT - radius + i..][..stride];
                for ((word, &sample), &threshold) in plane.iter_mut().zip(samples).zip(thresholds) {
                    *word |= ((sample > threshold) as u16) << (k % 16);
                }
                k += 1;
            }
        }
    }
}
