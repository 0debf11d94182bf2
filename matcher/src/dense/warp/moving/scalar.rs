//! Plain Rust.

use super::{Kernels, Sample, TAPS};

pub(super) fn pixels(kernels: &Kernels, row: &[Sample], place: &[i32], grey: &mut [i16]) {
    for (grey, &place) in grey.iter_mut().zip(place) {
        let first = (place >> 4) - 3;
        // A row shorter than the kernel holds no valid pixel.
        let samples = usize::try_from(first).ok().and_then(|first| row.get(first..first + TAPS));
        let taps = &kernels.taps[(place & 15) as usize];
        *grey = samples.map_or(0, |samples| {
            let products = samples.iter().zip(taps).map(|(&v, &c)| i32::from(v) * i32::from(c));
            (products.fold(0x8000, i32::wrapping_add) >> 16) as i16
        });
    }
}
