//! Random numbers that are a function of a key, and the statistics of a photo sensor's signal.
//!
//! Every pixel of every frame has its own key, so an image does not depend on the number of threads
//! nor on the order in which pixels are computed.

use std::f32::consts::TAU;

/// Mixes 64 bits (finalizer of the SplitMix64 generator, Steele et al. 2014).
pub(crate) fn mix(mut x: u64) -> u64 {
    x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Combines a key with one more index.
pub(crate) fn key(seed: u64, index: u64) -> u64 {
    mix(seed ^ mix(index))
}

/// A sequence of random numbers that starts from a key.
#[derive(Debug, Clone)]
pub(crate) struct KeyedRng(u64);

impl KeyedRng {
    pub fn new(key: u64) -> Self {
        Self(key)
    }

    pub fn next_u64(&mut self) -> u64 {
        let value = mix(self.0);
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        value
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in [-1, 1).
    pub fn symmetric(&mut self) -> f64 {
        2.0 * self.uniform() - 1.0
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        f64::from(normal_pair(self.next_u64())[0])
    }
}

/// Two independent standard normal numbers from 64 random bits (Box-Muller).
fn normal_pair(bits: u64) -> [f32; 2] {
    // 32 bits keep the tail up to 6.6 sigma; the half step keeps the logarithm finite.
    let u = ((bits >> 32) as f32 + 0.5) * (1.0 / 4_294_967_296.0);
    let v = (bits & 0xffff_ffff) as f32 * (1.0 / 4_294_967_296.0);
    let radius = (-2.0 * u.min(0.999_999_94).ln()).sqrt();
    let (sin, cos) = (TAU * v).sin_cos();
    [radius * cos, radius * sin]
}

/// Mean below which Poisson numbers are drawn exactly.
const EXACT_POISSON_BELOW: f32 = 24.0;

/// Electrons read from a pixel whose mean signal is `mean_e`: a Poisson number plus normal read
/// noise. `key` must be unique to the pixel and the frame.
pub(crate) fn read_pixel_e(key: u64, mean_e: f32, read_noise_e: f32) -> f32 {
    let bits = mix(key);
    let [z_shot, z_read] = normal_pair(bits);
    let shot = if mean_e < EXACT_POISSON_BELOW {
        poisson_by_inversion(mix(bits), mean_e)
    } else {
        // Normal approximation with the first Cornish-Fisher term, which carries the skewness:
        // mean, variance and third moment agree with Poisson's.
        let e = mean_e + mean_e.sqrt() * z_shot + (z_shot * z_shot - 1.0) * (1.0 / 6.0);
        // Rounds, and cannot be negative; a library call here would take longer than all the rest.
        (e + 0.5) as u32 as f32
    };
    shot + read_noise_e * z_read
}

fn poisson_by_inversion(bits: u64, mean: f32) -> f32 {
    if mean <= 0.0 {
        return 0.0;
    }
    let mean = f64::from(mean);
    let mut u = (bits >> 11) as f64 * (1.0 / (1u64 << 53) as f64);
    let mut p = (-mean).exp();
    let mut k = 0.0_f64;
    while u > p && k < 200.0 {
        u -= p;
        k += 1.0;
        p *= mean / k;
    }
    k as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(mean_e: f32, read_noise_e: f32) -> (f64, f64, f64) {
        let n = 200_000_u64;
        let values: Vec<f64> =
            (0..n).map(|i| f64::from(read_pixel_e(key(99, i), mean_e, read_noise_e))).collect();
        let mean = values.iter().sum::<f64>() / n as f64;
        let var = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n as f64;
        let third = values.iter().map(|v| (v - mean).powi(3)).sum::<f64>() / n as f64;
        (mean, var, third)
    }

    #[test]
    fn signal_has_poisson_moments_plus_read_noise() {
        for mean_e in [0.5_f32, 5.0, 23.0, 25.0, 400.0, 8000.0] {
            let (mean, var, third) = moments(mean_e, 3.0);
            let m = f64::from(mean_e);
            let expected_var = m + 9.0;
            // Five standard errors of the estimates from 200 000 samples.
            assert!((mean - m).abs() < 5.0 * (expected_var / 2e5).sqrt(), "{mean_e}: {mean}");
            assert!((var / expected_var - 1.0).abs() < 0.02, "{mean_e}: {var}");
            let tolerance = 5.0 * (15.0 * expected_var.powi(3) / 2e5).sqrt();
            assert!((third - m).abs() < tolerance, "{mean_e}: third moment {third}");
        }
    }

    #[test]
    fn neighbouring_keys_are_uncorrelated() {
        let n = 100_000_u64;
        let mut sum = 0.0;
        for i in 0..n {
            let a = f64::from(read_pixel_e(key(1, i), 1000.0, 0.0)) - 1000.0;
            let b = f64::from(read_pixel_e(key(1, i + 1), 1000.0, 0.0)) - 1000.0;
            sum += a * b / 1000.0;
        }
        assert!((sum / n as f64).abs() < 5.0 / (n as f64).sqrt());
    }

    #[test]
    fn no_light_and_no_read_noise_is_exactly_zero() {
        assert!((0..1000).all(|i| read_pixel_e(key(3, i), 0.0, 0.0) == 0.0));
    }
}
