//! Interpolating B-splines from the definition: the coefficients solve "the spline passes through all
//! samples", with mirrored ends, as a dense linear system.

use nalgebra::{DMatrix, DVector};

/// The centred B-spline of a degree, by the Cox-de Boor recursion on its support.
pub fn basis(degree: usize, x: f64) -> f64 {
    if degree == 0 {
        return if (-0.5..0.5).contains(&x) { 1.0 } else { 0.0 };
    }
    let n = degree as f64;
    let half = (n + 1.0) / 2.0;
    ((half + x) * basis(degree - 1, x + 0.5) + (half - x) * basis(degree - 1, x - 0.5)) / n
}

/// Derivative of the basis.
pub fn basis_derivative(degree: usize, x: f64) -> f64 {
    basis(degree - 1, x + 0.5) - basis(degree - 1, x - 0.5)
}

fn mirror(at: i64, len: i64) -> i64 {
    if len == 1 {
        return 0;
    }
    let mut at = at;
    while at < 0 || at >= len {
        at = if at < 0 { -at } else { 2 * (len - 1) - at };
    }
    at
}

/// A spline through samples.
pub struct Spline {
    degree: usize,
    coefficients: Vec<f64>,
}

impl Spline {
    pub fn new(samples: &[f64], degree: usize) -> Self {
        let n = samples.len();
        let mut a = DMatrix::<f64>::zeros(n, n);
        for row in 0..n as i64 {
            for k in -(degree as i64)..=degree as i64 {
                let weight = basis(degree, k as f64);
                a[(row as usize, mirror(row + k, n as i64) as usize)] += weight;
            }
        }
        let b = DVector::from_column_slice(samples);
        let x = a.lu().solve(&b).expect("interpolation is well posed");
        Self { degree, coefficients: x.iter().copied().collect() }
    }

    fn sum(&self, x: f64, f: impl Fn(f64) -> f64) -> f64 {
        let centre = x.floor() as i64;
        let reach = self.degree as i64 + 1;
        (centre - reach..=centre + reach)
            .map(|k| {
                let c = self.coefficients[mirror(k, self.coefficients.len() as i64) as usize];
                c * f(x - k as f64)
            })
            .sum()
    }

    pub fn value(&self, x: f64) -> f64 {
        self.sum(x, |d| basis(self.degree, d))
    }

    pub fn derivative(&self, x: f64) -> f64 {
        self.sum(x, |d| basis_derivative(self.degree, d))
    }
}
