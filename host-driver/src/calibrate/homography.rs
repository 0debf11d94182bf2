//! Homographies between planes.

use nalgebra::{DMatrix, Matrix3, Point2, Vector3};

/// The homography that maps `from` to `to`: direct linear transform on normalised points (Hartley and
/// Zisserman, Multiple View Geometry, algorithm 4.2). `None` for fewer than four pairs, or points on
/// a line.
pub fn fit(from: &[Point2<f64>], to: &[Point2<f64>]) -> Option<Matrix3<f64>> {
    if from.len() < 4 || from.len() != to.len() {
        return None;
    }
    let (normalise_from, normalise_to) = (normaliser(from)?, normaliser(to)?);
    let mut rows = DMatrix::<f64>::zeros(2 * from.len().max(5), 9);
    for (i, (a, b)) in from.iter().zip(to).enumerate() {
        let a = normalise_from * a.to_homogeneous();
        let b = normalise_to * b.to_homogeneous();
        for k in 0..3 {
            rows[(2 * i, 3 + k)] = -a[k];
            rows[(2 * i, 6 + k)] = b.y * a[k];
            rows[(2 * i + 1, k)] = a[k];
            rows[(2 * i + 1, 6 + k)] = -b.x * a[k];
        }
    }
    // The smallest eigenvector of the normal matrix; normalised coordinates keep it well-conditioned.
    let eigen = (rows.transpose() * &rows).symmetric_eigen();
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    // Two solutions: the points do not determine one.
    if eigen.eigenvalues[order[1]] < 1e-9 * eigen.eigenvalues[order[8]] {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let h = Matrix3::from_row_slice(h.as_slice());
    Some(normalise_to.try_inverse()? * h * normalise_from)
}

/// Where a homography maps a point; `None` at infinity.
pub fn map(homography: &Matrix3<f64>, point: Point2<f64>) -> Option<Point2<f64>> {
    let p: Vector3<f64> = homography * point.to_homogeneous();
    (p.z.abs() > 1e-12).then(|| Point2::new(p.x / p.z, p.y / p.z))
}

/// Moves the points' middle to the origin and their mean distance to the square root of 2.
fn normaliser(points: &[Point2<f64>]) -> Option<Matrix3<f64>> {
    let n = points.len() as f64;
    let mean = points.iter().map(|p| p.coords).sum::<nalgebra::Vector2<f64>>() / n;
    let distance = points.iter().map(|p| (p.coords - mean).norm()).sum::<f64>() / n;
    if distance.is_nan() || distance <= 0.0 {
        return None;
    }
    let s = std::f64::consts::SQRT_2 / distance;
    Some(Matrix3::new(s, 0.0, -s * mean.x, 0.0, s, -s * mean.y, 0.0, 0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_homography_is_found_again_and_a_line_gives_none() {
        let truth = Matrix3::new(900.0, 30.0, 600.0, -20.0, 880.0, 500.0, 0.2, -0.1, 1.0);
        let from: Vec<_> =
            (0..12).map(|i| Point2::new(f64::from(i % 4) * 0.1, f64::from(i / 4) * 0.1)).collect();
        let to: Vec<_> = from.iter().map(|p| map(&truth, *p).unwrap()).collect();
        let found = fit(&from, &to).unwrap();
        for (a, b) in from.iter().zip(&to) {
            assert!((map(&found, *a).unwrap() - b).norm() < 1e-8);
        }
        let line: Vec<_> = (0..12).map(|i| Point2::new(f64::from(i), 2.0)).collect();
        assert!(fit(&line, &to).is_none());
        assert!(fit(&from[..3], &to[..3]).is_none());
    }
}
