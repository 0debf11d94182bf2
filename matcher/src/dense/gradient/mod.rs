//! The static pass over one row of the left stack: gradients, and the sums over time that do not
//! depend on the disparity.
//!
//! Grey values and gradients are brought to 1/16 of an 8-bit grey level (per px), so that sums of
//! squares over 16 frames fit 32 bits, and kept as pairs: the low half of a word is an even frame,
//! the high half the odd one after it.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;

use super::kernels::Kernels;
use crate::{Level, Sample};

/// Unit of squared grey values: coarse enough that a window's column of them sums without rounding
/// in an `f32`, whatever the order, and fine against any noise.
pub(crate) const SQUARE_UNIT: f32 = 256.0;
/// [`SQUARE_UNIT`] as a shift.
pub(crate) const SQUARE_SHIFT: u32 = 8;

/// Reach of the gradient's kernel on both sides.
pub(crate) const REACH: usize = 3;

/// Where a row's results go; each slice starts at the row's first pixel.
pub(crate) struct Static<'a> {
    /// Gradient pairs, `stride` words per pair of frames.
    pub gradient: &'a mut [i32],
    /// Grey value pairs, laid out likewise.
    pub grey: &'a mut [i32],
    /// Words per pair of frames.
    pub stride: usize,
    /// Sum over time of the squared gradient.
    pub s: &'a mut [f32],
    /// Sum over time of gradient times grey value.
    pub il: &'a mut [f32],
    /// Sum over time of the gradient.
    pub i: &'a mut [f32],
    /// Sum over time of the grey value.
    pub l: &'a mut [f32],
    /// Sum over time of the squared grey value, in units of [`SQUARE_UNIT`].
    pub ll: &'a mut [f32],
}

/// Fills `out` for pixels `x0..x0 + len` of the rows in `left`: an even number of rows of the
/// image's width (a last odd frame is followed by a row of zeros). Pixels beyond the image get
/// zeros, and so do gradients within [`REACH`] of its sides.
#[cfg_attr(
    not(any(target_arch = "x86_64", target_arch = "aarch64")),
    allow(unused_variables, unreachable_code)
)]
pub(crate) fn static_row(
    level: Level,
    left: &[&[Sample]],
    x0: usize,
    len: usize,
    out: &mut Static<'_>,
) {
    let width = left[0].len();
    assert!(left.len().is_multiple_of(2) && left.iter().all(|r| r.len() == width));
    let pairs = left.len() / 2;
    assert!(len <= out.stride && out.gradient.len() >= pairs * out.stride);
    assert!(out.grey.len() >= pairs * out.stride);
    for map in [&out.s, &out.il, &out.i, &out.l, &out.ll] {
        assert!(map.len() >= len);
    }
    let kernels = Kernels::get();
    let block = match level {
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => 32,
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => 16,
        #[cfg(target_arch = "aarch64")]
        Level::Neon => 8,
        _ => return scalar::pixels(kernels, left, x0, 0..len, out),
    };
    // Whole blocks whose kernel stays inside the image, counted from `from`.
    let from = REACH.saturating_sub(x0).min(len);
    let end = width.saturating_sub(REACH).saturating_sub(x0).min(len);
    if end < from + block {
        return scalar::pixels(kernels, left, x0, 0..len, out);
    }
    scalar::pixels(kernels, left, x0, 0..from, out);
    let blocks = (end - from).div_ceil(block);
    // The last block ends at `end` and may repeat pixels of the one before.
    let at = |b: usize| if b + 1 == blocks { end - block } else { from + b * block };
    let at = (0..blocks).map(at);
    match level {
        // SAFETY: trusted levels are the processor's; blocks lie within rows and outputs as checked
        // above, with REACH samples on both sides.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::blocks(kernels, left, x0, at, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::blocks(kernels, left, x0, at, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::blocks(kernels, left, x0, at, out) },
        _ => {}
    }
    scalar::pixels(kernels, left, x0, end..len, out);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        guarded::{Edge, Guarded},
        synthetic::Random,
    };

    type Maps = ([Vec<i32>; 2], [Vec<f32>; 5]);

    fn run(level: Level, rows: &[Vec<Sample>], x0: usize, len: usize, edge: Edge) -> Maps {
        let rows: Vec<Guarded<Sample>> = rows.iter().map(|r| Guarded::new(r, edge)).collect();
        let left: Vec<&[Sample]> = rows.iter().map(|r| &r[..]).collect();
        let none = vec![0; rows.len() / 2 * len];
        let mut words = [Guarded::new(&none, edge), Guarded::new(&none, edge)];
        let none = vec![0.0; len];
        let mut maps: [Guarded<f32>; 5] = std::array::from_fn(|_| Guarded::new(&none, edge));
        let [s, il, i, l, ll] = &mut maps;
        let [gradient, grey] = &mut words;
        let mut out = Static { gradient, grey, stride: len, s, il, i, l, ll };
        static_row(level, &left, x0, len, &mut out);
        (words.map(|w| w.to_vec()), maps.map(|m| m.to_vec()))
    }

    #[test]
    fn levels_are_bit_equal() {
        let mut random = Random::new(3);
        for (width, x0, len) in
            [(131, 0, 131), (131, 40, 91), (131, 40, 128), (5, 0, 16), (64, 1, 64)]
        {
            let rows: Vec<Vec<Sample>> = (0..6)
                .map(|_| (0..width).map(|_| (random.bits() % 16_321) as i16).collect())
                .collect();
            let want = run(Level::Scalar, &rows, x0, len, Edge::End);
            for (level, edge) in Level::available().flat_map(|l| Edge::BOTH.map(|e| (l, e))) {
                let got = run(level, &rows, x0, len, edge);
                assert_eq!(got, want, "{level} {edge:?} {width} {x0} {len}");
            }
        }
    }
}
