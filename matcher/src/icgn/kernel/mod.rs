//! IC-GN's inner loops: the sums over a subset that an iteration needs.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod body;
mod lanes;
#[cfg(target_arch = "aarch64")]
mod neon;
mod scalar;

use super::{
    prepare::Prepared,
    window::{Place, Window},
};
use crate::{Interpolation, Level, bspline::TAPS_MAX};

/// Sums over the warped subset, with g the right grey value, L the left one and I its derivative.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct WarpSums {
    pub g: f32,
    pub gg: f32,
    pub lg: f32,
    /// Sum of I g times each derivative of the shape function.
    pub ig: [f32; 6],
}

/// Sums over the reference subset.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Reference {
    pub l: f64,
    pub ll: f64,
    /// Sum of I L and of I times each derivative of the shape function.
    pub il: [f64; 6],
    pub i: [f64; 6],
    /// Lower half of the Hessian (paper eq 16).
    pub hessian: [[f64; 6]; 6],
}

/// What the warp kernels need besides the subset.
#[derive(Debug, Clone)]
pub(crate) struct Constants {
    /// [`Interpolation::polynomials`].
    pub polynomials: [[f32; TAPS_MAX]; TAPS_MAX],
}

type Warp = unsafe fn(&Prepared, &Window, Place, [f32; 6], &Constants) -> WarpSums;
type Refer = unsafe fn(&Prepared, &Window, usize, usize) -> Reference;

/// The kernels of one SIMD level, interpolation and order of the shape function.
#[derive(Debug, Clone)]
pub(crate) struct Kernel {
    warp: Warp,
    reference: Refer,
    constants: Constants,
}

macro_rules! pick {
    ($level:ident, $taps:expr, $parameters:expr) => {
        match ($taps, $parameters) {
            (4, 3) => ($level::warp_sums::<4, 3> as Warp, $level::reference::<3> as Refer),
            (4, _) => ($level::warp_sums::<4, 6> as Warp, $level::reference::<6> as Refer),
            (_, 3) => ($level::warp_sums::<6, 3> as Warp, $level::reference::<3> as Refer),
            (_, _) => ($level::warp_sums::<6, 6> as Warp, $level::reference::<6> as Refer),
        }
    };
}

impl Kernel {
    /// The kernels of `level`, or of the best level below it that this machine runs, for a shape
    /// function of 3 or 6 `parameters`.
    pub fn new(level: Level, kind: Interpolation, parameters: usize) -> Self {
        let (warp, reference) = match level.usable() {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => pick!(avx512, kind.taps(), parameters),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => pick!(avx2, kind.taps(), parameters),
            #[cfg(target_arch = "aarch64")]
            Level::Neon => pick!(neon, kind.taps(), parameters),
            _ => pick!(scalar, kind.taps(), parameters),
        };
        Self { warp, reference, constants: Constants { polynomials: kind.polynomials() } }
    }

    /// Correlates the left subset about (x, y) with the right stack warped by `t`, whose u is relative
    /// to right column `base`.
    ///
    /// # Panics
    /// When the window does not fit about (x, y), `base` is outside the image, or `t` not finite.
    pub fn warp(
        &self,
        prepared: &Prepared,
        window: &Window,
        (x, y): (usize, usize),
        base: i64,
        t: [f32; 6],
    ) -> WarpSums {
        assert!(window.fits(prepared, x, y) && t.iter().all(|v| v.is_finite()));
        let place = Place::new(prepared, x, y, base);
        // SAFETY: `new` took a level that this machine runs; the window fits, `t` is finite.
        unsafe { (self.warp)(prepared, window, place, t, &self.constants) }
    }

    /// Sums over the left subset about (x, y).
    ///
    /// # Panics
    /// When the window does not fit about (x, y).
    pub fn reference(&self, prepared: &Prepared, window: &Window, x: usize, y: usize) -> Reference {
        assert!(window.fits(prepared, x, y));
        // SAFETY: `new` took a level that this machine runs; the window fits.
        unsafe { (self.reference)(prepared, window, x, y) }
    }
}
