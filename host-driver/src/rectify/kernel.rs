//! Interpolation kernels as tables of fixed-point taps.

use std::sync::OnceLock;

/// Taps of a kernel: the samples from 3 before to 4 after the integer position.
pub(super) const TAPS: usize = 8;
/// Taps before the sample at the integer position.
pub(super) const TAPS_BEFORE: usize = 3;
/// Steps of the sub-pixel position: 2^10. Where the rectified scale is close to 1, neighbouring pixels
/// share their rounding, so the step itself (+-0.0005 px) bounds the systematic shift.
pub(super) const PHASE_BITS: u32 = 10;
/// As a count.
pub(super) const PHASES: usize = 1 << PHASE_BITS;

/// How a rectified pixel is interpolated from the raw image.
///
/// The default was chosen by `tests/rectify.rs`, which prints the errors of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Kernel {
    /// Linear, 2 taps: fast elsewhere, here only a comparison. It blurs by an amount that depends on
    /// the sub-pixel position.
    Linear,
    /// Keys' cubic convolution (a = -1/2), 4 taps.
    Keys,
    /// Sinc windowed by a sinc of 8 taps.
    Lanczos4,
    /// Sinc windowed by a Kaiser window, 8 taps.
    #[default]
    KaiserSinc,
}

impl Kernel {
    /// The taps at fraction `t` in 0..1, for the samples at -3..=4; they sum to 1.
    pub fn taps(self, t: f64) -> [f64; TAPS] {
        let distance = |k: usize| (k as f64 - TAPS_BEFORE as f64 - t).abs();
        let mut taps = match self {
            Kernel::Linear => std::array::from_fn(|k| (1.0 - distance(k)).max(0.0)),
            Kernel::Keys => std::array::from_fn(|k| keys(distance(k))),
            Kernel::Lanczos4 => std::array::from_fn(|k| lanczos(distance(k), 4.0)),
            Kernel::KaiserSinc => std::array::from_fn(|k| kaiser_sinc(distance(k), 4.0)),
        };
        let sum: f64 = taps.iter().sum();
        taps.iter_mut().for_each(|tap| *tap /= sum);
        taps
    }
}

/// Fraction bits of the taps.
pub(super) const TAP_BITS: u32 = 14;

/// A kernel's taps for each phase, in fixed point per depth of a camera.
#[derive(Debug)]
pub(super) struct TapTables {
    exact: Vec<[f64; TAPS]>,
    plain: Vec<[i16; TAPS]>,
    /// Made by the first image of a depth.
    by_bits: [OnceLock<Vec<[i16; TAPS]>>; 17],
}

impl TapTables {
    pub fn new(kernel: Kernel) -> Self {
        let phases = (0..PHASES).map(|phase| phase as f64 / PHASES as f64);
        let exact: Vec<_> = phases.map(|t| kernel.taps(t)).collect();
        let plain = fixed_point(&exact, 1.0);
        Self { exact, plain, by_bits: Default::default() }
    }

    /// Taps of sum 2^[`TAP_BITS`].
    pub fn plain(&self) -> &[[i16; TAPS]] {
        &self.plain
    }

    /// Taps that bring a camera's values to samples, whose full scale is 255 * 64 whatever the
    /// camera's bits, and by how many bits their products are then shifted. Values of 16 bits must
    /// be halved, to fit 16 bits with a sign.
    pub fn camera_taps(&self, bits: u32) -> (&[[i16; TAPS]], u32) {
        if bits == 8 {
            return (&self.plain, TAP_BITS - 6);
        }
        let used_bits = bits.clamp(1, 15);
        let table = self.by_bits[bits.min(16) as usize].get_or_init(|| {
            let full = f64::from((1_u32 << bits) - 1) / f64::from(1_u32 << (bits - used_bits));
            let scale = 255.0 * 64.0 / full / 2_f64.powi(14 - used_bits as i32);
            fixed_point(&self.exact, scale)
        });
        (table, used_bits)
    }
}

/// Fixed-point taps whose sum is 2^14 times `scale`, exactly: a flat grey stays flat whatever the
/// phase.
fn fixed_point(table: &[[f64; TAPS]], scale: f64) -> Vec<[i16; TAPS]> {
    let one = f64::from(1 << TAP_BITS) * scale;
    table
        .iter()
        .map(|exact| {
            let mut taps = exact.map(|tap| (tap * one).round() as i32);
            let missing = one.round() as i32 - taps.iter().sum::<i32>();
            let nearer = if exact[TAPS_BEFORE] >= exact[TAPS_BEFORE + 1] { 0 } else { 1 };
            taps[TAPS_BEFORE + nearer] += missing;
            taps.map(|tap| tap as i16)
        })
        .collect()
}

/// Keys, "Cubic convolution interpolation for digital image processing" (1981), a = -1/2.
fn keys(d: f64) -> f64 {
    if d < 1.0 {
        (1.5 * d - 2.5) * d * d + 1.0
    } else if d < 2.0 {
        ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0
    } else {
        0.0
    }
}

fn sinc(x: f64) -> f64 {
    let x = x * std::f64::consts::PI;
    if x.abs() < 1e-12 { 1.0 } else { x.sin() / x }
}

fn lanczos(d: f64, radius: f64) -> f64 {
    if d < radius { sinc(d) * sinc(d / radius) } else { 0.0 }
}

/// Shape of the Kaiser window: 5 balances the error at dots of sigma 0.75-0.9 px, which aliasing
/// dominates whatever the kernel, against that at softer ones, where it is half of Lanczos's.
const KAISER_BETA: f64 = 5.0;

fn kaiser_sinc(d: f64, radius: f64) -> f64 {
    if d >= radius {
        return 0.0;
    }
    let window = bessel_i0(KAISER_BETA * (1.0 - (d / radius).powi(2)).sqrt());
    sinc(d) * window / bessel_i0(KAISER_BETA)
}

/// Modified Bessel function of the first kind, order 0, by its power series.
fn bessel_i0(x: f64) -> f64 {
    let mut term = 1.0;
    (1..40).fold(1.0, |sum, k| {
        term *= (0.5 * x / f64::from(k)).powi(2);
        sum + term
    })
}
