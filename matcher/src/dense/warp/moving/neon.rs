//! NEON: 8 pixels a block, interpolated as in [`super::super::neon`].

use std::arch::aarch64::*;

use super::{Kernels, Sample};
use crate::dense::warp::neon::interpolate;

/// Does whole blocks, and returns the number of pixels done.
///
/// # Safety
/// The processor has NEON; `place` lies within the row with all eight taps; `grey` is at least as long
/// as `place`.
#[target_feature(enable = "neon")]
pub(super) unsafe fn blocks(
    kernels: &Kernels,
    row: &[Sample],
    place: &[i32],
    grey: &mut [i16],
) -> usize {
    let (places, rest) = place.as_chunks::<8>();
    for (at, to) in places.iter().zip(grey.as_chunks_mut::<8>().0) {
        let first = at.map(|at| ((at >> 4) - 3) as usize);
        // SAFETY: a phase's taps are 16 bytes.
        let taps = at.map(|at| unsafe { vld1q_s16(kernels.taps[(at & 15) as usize].as_ptr()) });
        // SAFETY: the caller's promise: all taps lie within the row; 16 bytes.
        unsafe { vst1q_s16(to.as_mut_ptr(), interpolate(row, &first, &taps)) };
    }
    place.len() - rest.len()
}
