//! The 6x6 (or 3x3) normal equations, by Cholesky in place.

// Indices as in the textbook.
#![allow(clippy::needless_range_loop)]

/// Factor L of a symmetric positive definite K x K matrix, A = L L^T.
#[derive(Debug, Clone)]
pub struct Cholesky<const K: usize> {
    lower: [[f64; K]; K],
    inverse_diagonal: [f64; K],
}

impl<const K: usize> Cholesky<K> {
    /// Factors a matrix of which only the lower half is read; `None` when it is not positive definite
    /// to about ten digits.
    pub fn new(mut a: [[f64; K]; K]) -> Option<Self> {
        let mut inverse_diagonal = [0.0; K];
        for j in 0..K {
            let full = a[j][j];
            let mut pivot = full;
            for k in 0..j {
                pivot -= a[j][k] * a[j][k];
            }
            // Written so that NaN fails too.
            let definite = pivot > 1e-10 * full && full > 0.0;
            if !definite {
                return None;
            }
            let inverse = 1.0 / pivot.sqrt();
            inverse_diagonal[j] = inverse;
            for i in j + 1..K {
                let mut sum = a[i][j];
                for k in 0..j {
                    sum -= a[i][k] * a[j][k];
                }
                a[i][j] = sum * inverse;
            }
        }
        Some(Self { lower: a, inverse_diagonal })
    }

    /// Solves A x = b.
    pub fn solve(&self, mut b: [f64; K]) -> [f64; K] {
        for i in 0..K {
            for k in 0..i {
                b[i] -= self.lower[i][k] * b[k];
            }
            b[i] *= self.inverse_diagonal[i];
        }
        for i in (0..K).rev() {
            for k in i + 1..K {
                b[i] -= self.lower[k][i] * b[k];
            }
            b[i] *= self.inverse_diagonal[i];
        }
        b
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_what_it_was_given() {
        let mut a = [[0.0f64; 6]; 6];
        for (i, row) in a.iter_mut().enumerate() {
            for (j, v) in row.iter_mut().enumerate() {
                *v = 1.0 / (1.0 + i as f64 + j as f64) + if i == j { 0.5 } else { 0.0 };
            }
        }
        let x = [1.0, -2.0, 3.0, 0.5, -0.25, 4.0];
        let b = std::array::from_fn(|i| (0..6).map(|j| a[i][j] * x[j]).sum());
        let got = Cholesky::new(a).unwrap().solve(b);
        assert!(got.iter().zip(x).all(|(g, x)| (g - x).abs() < 1e-9), "{got:?}");
        assert!(Cholesky::new([[0.0; 3]; 3]).is_none());
        assert!(Cholesky::new([[1.0, 1.0], [1.0, 1.0]]).is_none());
        assert!(Cholesky::new([[f64::NAN; 3]; 3]).is_none());
    }
}
