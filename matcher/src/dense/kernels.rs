//! The dense stage's two filters: an 8-tap interpolation kernel per 1/16 px and a 6-tap gradient.
//!
//! Both are least-squares designs: the weighted error of the frequency response is smallest, with
//! the spectrum of a Gaussian dot of `DESIGN_SIGMA_PX` as the weight plus a small floor. The
//! interpolation position is rounded to 1/16 px; because the fit is linear about the *rounded*
//! position and for the disparity itself, that rounding cancels to first order.

use std::sync::OnceLock;

use nalgebra::{DMatrix, DVector};

/// Interpolation steps per pixel.
pub const PHASES: usize = 16;
/// Taps of the interpolation kernel, at offsets -3..=4.
pub const TAPS: usize = 8;
/// Unit of an interpolation coefficient.
pub const COEFFICIENT_ONE: i32 = 1 << 14;
/// Dots that the design is for: small ones, blur included. Sharper ones are served by the bias
/// terms.
const DESIGN_SIGMA_PX: f64 = 1.1;
/// Dot sizes at which the interpolation's shift bias is kept small.
const UNBIASED_SIGMA_PX: [f64; 5] = [0.75, 0.85, 1.0, 1.2, 1.4];
/// Weight of the squared bias against the integrated squared error.
const BIAS_WEIGHT: f64 = 5e3;
/// Weight of frequencies that no dot has, so that noise is not amplified.
const FLOOR: f64 = 1e-6;
/// Nodes of the integral over frequency.
const NODES: usize = 512;

/// Interpolation and gradient coefficients in fixed point.
#[derive(Debug)]
pub struct Kernels {
    /// `taps[phase][k]` is the weight of the sample at offset k - 3; each phase sums to
    /// [`COEFFICIENT_ONE`].
    pub taps: [[i16; TAPS]; PHASES],
    /// `gradient[k]` times sample(x + k + 1) - sample(x - k - 1), in 1/2^15, gives the gradient in
    /// a quarter of the sample's unit per px.
    pub gradient: [i16; 3],
    /// The gradient in floating point (sample units per px).
    pub gradient_exact: [f64; 3],
}

impl Kernels {
    /// The kernels, designed once per process.
    pub fn get() -> &'static Kernels {
        static KERNELS: OnceLock<Kernels> = OnceLock::new();
        KERNELS.get_or_init(Kernels::design)
    }

    fn design() -> Kernels {
        let gradient_exact = gradient_taps();
        let mut taps = [[0i16; TAPS]; PHASES];
        for (phase, out) in taps.iter_mut().enumerate() {
            let exact = interpolation_taps(phase as f64 / PHASES as f64, gradient_exact);
            for (o, e) in out.iter_mut().zip(&exact) {
                *o = (e * f64::from(COEFFICIENT_ONE)).round() as i16;
            }
            let sum: i32 = out.iter().map(|&c| i32::from(c)).sum();
            // The rounding's remainder goes where it is relatively smallest.
            let largest = (0..TAPS).max_by_key(|&k| out[k].abs()).unwrap_or(3);
            out[largest] += (COEFFICIENT_ONE - sum) as i16;
        }
        let mut gradient = [0i16; 3];
        for (o, e) in gradient.iter_mut().zip(gradient_exact) {
            *o = (e * 32_768.0 / 4.0).round() as i16;
        }
        Kernels { taps, gradient, gradient_exact }
    }
}

fn weight(omega: f64) -> f64 {
    (-(omega * DESIGN_SIGMA_PX).powi(2)).exp() + FLOOR
}

/// Frequencies up to twice Nyquist's: a small dot's spectrum reaches beyond pi, and what is folded
/// back counts in the bias.
fn folded_nodes() -> impl Iterator<Item = f64> {
    (0..NODES).map(|i| (i as f64 + 0.5) * std::f64::consts::TAU / NODES as f64)
}

/// Frequencies up to Nyquist's.
fn nodes() -> impl Iterator<Item = f64> {
    folded_nodes().take(NODES / 2)
}

/// Smallest c^T A c - 2 b^T c with g^T c = 1.
fn constrained(a: DMatrix<f64>, b: DVector<f64>, g: DVector<f64>) -> DVector<f64> {
    let inverse = a.try_inverse().expect("a Gram matrix of independent functions");
    let free = &inverse * &b;
    let pull = &inverse * &g;
    let lambda = (1.0 - g.dot(&free)) / g.dot(&pull);
    free + pull * lambda
}

/// The taps for a fraction `tau`: least squares with sum 1, where the shift bias for several dot
/// sizes, the integral of G(omega) P(omega) Im[response] over that of omega G P, is among the errors;
/// G is the response of the `gradient` that the fit projects on.
fn interpolation_taps(tau: f64, gradient: [f64; 3]) -> Vec<f64> {
    let response = |o: f64| -> f64 {
        gradient.iter().zip(1..).map(|(c, k)| 2.0 * c * (o * f64::from(k)).sin()).sum()
    };
    let offset = |k: usize| k as f64 - 3.0;
    let mut unit = vec![0.0; TAPS];
    if tau == 0.0 {
        unit[3] = 1.0;
        return unit;
    }
    let mut a = DMatrix::from_fn(TAPS, TAPS, |i, j| {
        nodes().map(|o| weight(o) * (o * (offset(i) - offset(j))).cos()).sum()
    });
    let b = DVector::from_fn(TAPS, |i, _| {
        nodes().map(|o| weight(o) * (o * (offset(i) - tau)).cos()).sum()
    });
    for sigma in UNBIASED_SIGMA_PX {
        let power = |o: f64| (-(o * sigma).powi(2)).exp();
        let energy: f64 = folded_nodes().map(|o| response(o) * o * power(o)).sum();
        let bias = DVector::from_fn(TAPS, |k, _| {
            folded_nodes()
                .map(|o| power(o) * response(o) * (o * (offset(k) - tau)).sin())
                .sum::<f64>()
                / energy
        });
        a += &bias * bias.transpose() * BIAS_WEIGHT;
    }
    constrained(a, b, DVector::from_element(TAPS, 1.0)).iter().copied().collect()
}

fn gradient_taps() -> [f64; 3] {
    let a = DMatrix::from_fn(3, 3, |i, j| {
        nodes()
            .map(|o| weight(o) * 4.0 * (o * (i + 1) as f64).sin() * (o * (j + 1) as f64).sin())
            .sum()
    });
    let b = DVector::from_fn(3, |i, _| {
        nodes().map(|o| weight(o) * 2.0 * o * (o * (i + 1) as f64).sin()).sum()
    });
    let c = constrained(a, b, DVector::from_fn(3, |i, _| 2.0 * (i + 1) as f64));
    [c[0], c[1], c[2]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phase_zero_is_the_sample_itself() {
        let k = Kernels::get();
        assert_eq!(k.taps[0], [0, 0, 0, COEFFICIENT_ONE as i16, 0, 0, 0, 0]);
        for taps in &k.taps {
            assert_eq!(taps.iter().map(|&c| i32::from(c)).sum::<i32>(), COEFFICIENT_ONE);
        }
    }

    /// Shift bias of the estimate on dots of any phase: the projection of the interpolation error
    /// on the gradient, averaged over where the dot lies in the pixel.
    #[test]
    fn bias_is_below_a_thousandth_of_a_pixel() {
        let k = Kernels::get();
        for sigma in [0.75, 0.8, 0.9, 1.0, 1.15, 1.3] {
            for phase in 0..PHASES {
                let tau = phase as f64 / PHASES as f64;
                let (mut cross, mut energy) = (0.0, 0.0);
                for centre in 0..40 {
                    let c = centre as f64 / 40.0;
                    let dot = |x: f64| (-0.5 * ((x - c) / sigma).powi(2)).exp();
                    for x in -8i32..=8 {
                        let x = f64::from(x);
                        let at: f64 = (0..TAPS)
                            .map(|j| f64::from(k.taps[phase][j]) * dot(x + j as f64 - 3.0))
                            .sum::<f64>()
                            / f64::from(COEFFICIENT_ONE);
                        // As the fit takes it from the reference, whose samples lie at x + tau.
                        let gradient: f64 = (0..3)
                            .map(|j| {
                                let o = (j + 1) as f64;
                                k.gradient_exact[j] * (dot(x + tau + o) - dot(x + tau - o))
                            })
                            .sum();
                        let reference = -(x + tau - c) / (sigma * sigma) * dot(x + tau);
                        cross += gradient * (at - dot(x + tau));
                        energy += gradient * reference;
                    }
                }
                let bias = cross / energy;
                println!("{sigma} {phase} {bias:.6} {:?}", k.taps[phase]);
                assert!(bias.abs() < 1e-3, "sigma {sigma} phase {phase}: {bias}");
            }
        }
    }

    #[test]
    fn gradient_of_a_ramp_is_its_slope() {
        let k = Kernels::get();
        let slope: f64 = (0..3).map(|j| k.gradient_exact[j] * 2.0 * (j + 1) as f64).sum();
        assert!((slope - 1.0).abs() < 1e-12);
    }
}
