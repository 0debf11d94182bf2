//! Interpolating B-splines along a row: prefilter, weights, derivative.
//!
//! After rectification a right subset moves along its row only, so all interpolation is
//! one-dimensional. Rows are interleaved: [`LANES`] values, one a frame, for each pixel.

use crate::Interpolation;

/// Frames a pixel has room for.
pub const LANES: usize = 16;

/// Most taps of a spline.
pub const TAPS_MAX: usize = 6;

impl Interpolation {
    /// Poles of the prefilter.
    fn poles(self) -> &'static [f64] {
        match self {
            Interpolation::Cubic => &[-0.267_949_192_431_122_7],
            Interpolation::Quintic => &[-0.430_575_347_099_973_4, -0.043_096_288_203_264_65],
        }
    }

    /// Number of coefficients that a value between pixels depends on.
    pub fn taps(self) -> usize {
        match self {
            Interpolation::Cubic => 4,
            Interpolation::Quintic => 6,
        }
    }

    /// Weights of the taps as polynomials of the fraction f in 0..1: `[power][tap]`, the first tap
    /// being `taps() / 2 - 1` pixels before the pixel that f counts from.
    pub fn polynomials(self) -> [[f32; TAPS_MAX]; TAPS_MAX] {
        let (scale, table): (f64, [[f64; 6]; 6]) = match self {
            Interpolation::Cubic => (
                6.0,
                [
                    [1.0, 4.0, 1.0, 0.0, 0.0, 0.0],
                    [-3.0, 0.0, 3.0, 0.0, 0.0, 0.0],
                    [3.0, -6.0, 3.0, 0.0, 0.0, 0.0],
                    [-1.0, 3.0, -3.0, 1.0, 0.0, 0.0],
                    [0.0; 6],
                    [0.0; 6],
                ],
            ),
            Interpolation::Quintic => (
                120.0,
                [
                    [1.0, 26.0, 66.0, 26.0, 1.0, 0.0],
                    [-5.0, -50.0, 0.0, 50.0, 5.0, 0.0],
                    [10.0, 20.0, -60.0, 20.0, 10.0, 0.0],
                    [-10.0, 20.0, 0.0, -20.0, 10.0, 0.0],
                    [5.0, -20.0, 30.0, -20.0, 5.0, 0.0],
                    [-1.0, 5.0, -10.0, 10.0, -5.0, 1.0],
                ],
            ),
        };
        table.map(|row| row.map(|v| (v / scale) as f32))
    }

    /// Weights of the coefficients at +1, +2 pixels in the derivative at a pixel; those at -1, -2 are
    /// their negatives.
    pub fn derivative(self) -> [f32; 2] {
        match self {
            Interpolation::Cubic => [0.5, 0.0],
            Interpolation::Quintic => [10.0 / 24.0, 1.0 / 24.0],
        }
    }
}

/// Index of the sample that stands at `at` when `len` samples are continued by mirroring about the
/// first and the last.
pub fn mirrored(at: isize, len: usize) -> usize {
    if len == 1 {
        return 0;
    }
    let period = 2 * (len as isize - 1);
    let at = at.rem_euclid(period);
    (if at < len as isize { at } else { period - at }) as usize
}

/// Turns an interleaved row of samples into spline coefficients, mirrored at both ends.
///
/// # Panics
/// When the row is empty or no whole number of pixels.
pub fn prefilter(row: &mut [f32], kind: Interpolation) {
    let (pixels, rest) = row.as_chunks_mut::<LANES>();
    assert!(!pixels.is_empty() && rest.is_empty());
    let len = pixels.len();
    if len == 1 {
        return;
    }
    for &pole in kind.poles() {
        let gain = ((1.0 - pole) * (1.0 - 1.0 / pole)) as f32;
        // The causal filter's start is the sum over the mirrored past, until the pole's power is
        // below the precision.
        let mut start = [0f64; LANES];
        let mut power = 1.0f64;
        let mut k = 0isize;
        while power.abs() > 1e-9 {
            let pixel = &pixels[mirrored(k, len)];
            (0..LANES).for_each(|t| start[t] += power * pixel[t] as f64);
            power *= pole;
            k += 1;
        }
        let z = pole as f32;
        (0..LANES).for_each(|t| pixels[0][t] = start[t] as f32);
        for x in 1..len {
            let before = pixels[x - 1];
            (0..LANES).for_each(|t| pixels[x][t] += z * before[t]);
        }
        let end = (pole / (pole * pole - 1.0)) as f32;
        let (last, before) = (pixels[len - 1], pixels[len - 2]);
        (0..LANES).for_each(|t| pixels[len - 1][t] = end * (last[t] + z * before[t]));
        for x in (0..len - 1).rev() {
            let after = pixels[x + 1];
            (0..LANES).for_each(|t| pixels[x][t] = z * (after[t] - pixels[x][t]));
        }
        pixels.iter_mut().for_each(|p| p.iter_mut().for_each(|v| *v *= gain));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_give_the_samples_back() {
        for kind in [Interpolation::Cubic, Interpolation::Quintic] {
            for len in [1usize, 2, 3, 7, 40] {
                let sample = |x: usize, t: usize| ((x * 37 + t * 11) % 101) as f32;
                let mut row: Vec<f32> =
                    (0..len * LANES).map(|i| sample(i / LANES, i % LANES)).collect();
                prefilter(&mut row, kind);
                let weights = kind.polynomials()[0];
                for x in 0..len {
                    for t in 0..LANES {
                        let value: f32 = (0..kind.taps())
                            .map(|k| {
                                let at = x as isize + k as isize + 1 - kind.taps() as isize / 2;
                                weights[k] * row[mirrored(at, len) * LANES + t]
                            })
                            .sum();
                        assert!((value - sample(x, t)).abs() < 2e-4, "{kind:?} {len} {x} {value}");
                    }
                }
            }
        }
    }
}
