//! Eq 8-17 for one subset, as they stand.

use nalgebra::{DMatrix, DVector, Matrix6, Vector6};

use super::{Volume, bspline::Spline};

/// u, ux, uy, uxx, uyy, uxy.
pub type T = Vector6<f64>;

/// First row of eq 8.
pub fn warp(t: &T, x: f64, y: f64) -> f64 {
    x + t[0] + t[1] * x + t[2] * y + t[3] / 2.0 * x * x + t[4] / 2.0 * y * y + t[5] * x * y
}

/// dW/dT.
pub fn derivative(x: f64, y: f64) -> Vector6<f64> {
    Vector6::new(1.0, x, y, x * x / 2.0, y * y / 2.0, x * y)
}

/// Eq 17 by its meaning: the second-order shape function closest, over the subset's points, to
/// W(T) o W^-1(dT), the inverse being found point by point.
pub fn compose_inverse(t: &T, step: &T, points: &[(f64, f64)], order: usize) -> T {
    let k = if order == 1 { 3 } else { 6 };
    let mut a = DMatrix::<f64>::zeros(points.len(), k);
    let mut b = DVector::<f64>::zeros(points.len());
    for (row, &(x, y)) in points.iter().enumerate() {
        // The x' that the step maps to x.
        let mut from = x;
        for _ in 0..50 {
            from -= warp(step, from, y) - x;
        }
        let phi = derivative(x, y);
        for j in 0..k {
            a[(row, j)] = phi[j];
        }
        b[row] = warp(t, from, y) - x;
    }
    let solution = a.svd(true, true).solve(&b, 1e-12).expect("a square of points");
    T::from_fn(|j, _| if j < k { solution[j] } else { 0.0 })
}

/// Result of one subset.
pub struct Solution {
    pub t: T,
    pub zncc: f64,
    pub znssd: f64,
}

/// IC-GN (eq 10-17) over the pixels of a subset, `points` relative to (x, y).
pub fn solve(
    left: &Volume,
    right: &Volume,
    (x, y): (i64, i64),
    points: &[(f64, f64)],
    start: T,
    order: usize,
    degree: usize,
) -> Option<Solution> {
    let k = if order == 1 { 3 } else { 6 };
    // (phi, I_L, dI_L/dx) for every sample.
    let mut samples = Vec::new();
    let mut splines = Vec::new();
    for t in 0..left.len() {
        for &(px, py) in points {
            let row = (y + py as i64) as usize;
            let spline = Spline::new(&left[t][row], degree);
            let column = x as f64 + px;
            samples.push((
                derivative(px, py),
                left[t][row][column as usize],
                spline.derivative(column),
            ));
            splines.push((px, py, Spline::new(&right[t][row], degree)));
        }
    }
    let n = samples.len() as f64;
    let mean_l = samples.iter().map(|s| s.1).sum::<f64>() / n;
    let delta_l = samples.iter().map(|s| (s.1 - mean_l).powi(2)).sum::<f64>().sqrt();
    let mut hessian = Matrix6::<f64>::zeros();
    for (phi, _, gradient) in &samples {
        hessian += phi * phi.transpose() * (gradient * gradient);
    }
    for j in k..6 {
        hessian.row_mut(j).fill(0.0);
        hessian.column_mut(j).fill(0.0);
        hessian[(j, j)] = 1.0;
    }
    let inverse = hessian.try_inverse()?;
    let mut shape = start;
    for _ in 0..100 {
        let g: Vec<f64> =
            splines.iter().map(|(px, py, s)| s.value(x as f64 + warp(&shape, *px, *py))).collect();
        let mean_r = g.iter().sum::<f64>() / n;
        let delta_r = g.iter().map(|v| (v - mean_r).powi(2)).sum::<f64>().sqrt();
        let mut sum = Vector6::<f64>::zeros();
        let mut znssd = 0.0;
        for ((phi, l, gradient), v) in samples.iter().zip(&g) {
            let residual = l - mean_l - delta_l / delta_r * (v - mean_r);
            sum += phi * (gradient * residual);
            znssd += (residual / delta_l).powi(2);
        }
        for j in k..6 {
            sum[j] = 0.0;
        }
        let step = -inverse * sum;
        shape = compose_inverse(&shape, &step, points, order);
        if step.norm() <= 1e-7 {
            return Some(Solution { t: shape, zncc: 1.0 - 0.5 * znssd, znssd });
        }
    }
    None
}

/// Eq 18-19 over all points given: minus the disparities, fitted.
pub fn initial_guess(disparities: &[((f64, f64), f64)], order: usize) -> T {
    let k = if order == 1 { 3 } else { 6 };
    let a = DMatrix::from_fn(disparities.len(), k, |r, j| {
        derivative(disparities[r].0.0, disparities[r].0.1)[j]
    });
    let b = DVector::from_fn(disparities.len(), |r, _| -disparities[r].1);
    let solution = a.svd(true, true).solve(&b, 1e-12).expect("a square of points");
    T::from_fn(|j, _| if j < k { solution[j] } else { 0.0 })
}
