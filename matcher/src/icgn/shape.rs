//! The shape function (paper eq 8) in the parameters that rectification leaves, and its
//! inverse-compositional update (eq 17).

/// Parameters u, ux, uy, uxx, uyy, uxy of W(x, y) = x + u + ux x + uy y + uxx x^2/2 + uyy y^2/2 +
/// uxy x y; the row y stays. u is minus the disparity.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Shape(pub [f64; 6]);

impl Shape {
    /// Right column, relative to the subset's centre, of the subset's pixel (x, y).
    pub fn warp(&self, x: f64, y: f64) -> f64 {
        let [u, ux, uy, uxx, uyy, uxy] = self.0;
        x + u + ux * x + uy * y + 0.5 * uxx * x * x + 0.5 * uyy * y * y + uxy * x * y
    }

    /// 2-norm of the parameters, the paper's measure of convergence.
    pub fn norm(&self) -> f64 {
        self.0.iter().map(|p| p * p).sum::<f64>().sqrt()
    }

    /// W(self) o W(increment)^-1 (eq 17), to second order in x and y.
    ///
    /// W acts on the monomials (x^2, xy, y^2, x, y, 1) as a 6x6 matrix once products of third and
    /// higher order are dropped, and composition is that matrices' product. Of the result only the
    /// row that gives x is needed: b with b M(increment) = a(self). Rows y^2, y and 1 of M are the
    /// identity's, which leaves a 2x2 system. `None` when the increment cannot be inverted.
    pub fn compose_inverse(&self, increment: &Shape) -> Option<Shape> {
        let a = row(&self.0);
        let m = row(&increment.0);
        let [m0, m1, m2, m3, m4, m5] = m;
        // Row of x'^2 over (x^2, xy, y^2, x, y, 1), third and fourth order dropped.
        let square = [
            m3 * m3 + 2.0 * m5 * m0,
            2.0 * m3 * m4 + 2.0 * m5 * m1,
            m4 * m4 + 2.0 * m5 * m2,
            2.0 * m5 * m3,
            2.0 * m5 * m4,
            m5 * m5,
        ];
        // Row of x'y: x y, y^2 and y alone.
        let (product_xy, product_yy, product_y) = (m3, m4, m5);
        let determinant = square[0] * m3 - square[3] * m0;
        if !(determinant.abs() > 1e-12 && product_xy.abs() > 1e-12) {
            return None;
        }
        // Columns x^2 and x hold only the rows of x'^2 and x'.
        let b0 = (a[0] * m3 - a[3] * m0) / determinant;
        let b3 = (square[0] * a[3] - square[3] * a[0]) / determinant;
        let b1 = (a[1] - b0 * square[1] - b3 * m1) / product_xy;
        let b2 = a[2] - b0 * square[2] - b1 * product_yy - b3 * m2;
        let b4 = a[4] - b0 * square[4] - b1 * product_y - b3 * m4;
        let b5 = a[5] - b0 * square[5] - b3 * m5;
        Some(Shape([b5, b3 - 1.0, b4, 2.0 * b0, 2.0 * b2, b1]))
    }
}

/// Coefficients of W over (x^2, xy, y^2, x, y, 1).
fn row(p: &[f64; 6]) -> [f64; 6] {
    let [u, ux, uy, uxx, uyy, uxy] = *p;
    [0.5 * uxx, uxy, 0.5 * uyy, 1.0 + ux, uy, u]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn composing_with_its_own_inverse_is_the_identity() {
        let w = Shape([0.4, 0.03, -0.02, 0.002, -0.003, 0.001]);
        let identity = w.compose_inverse(&w).unwrap();
        assert!(identity.norm() < 1e-12, "{identity:?}");
    }

    #[test]
    fn composition_holds_at_points() {
        let w = Shape([-31.4, 0.11, -0.07, 0.003, -0.002, 0.004]);
        let step = Shape([2e-3, 1e-3, -4e-4, 2e-4, 1e-4, -3e-4]);
        let new = w.compose_inverse(&step).unwrap();
        for (x, y) in [(0.0, 0.0), (3.0, -4.0), (-4.0, 4.0), (4.0, 1.0)] {
            // new(step(x, y)) = w(x, y) up to the dropped third order.
            let (got, expected) = (new.warp(step.warp(x, y), y), w.warp(x, y));
            assert!((got - expected).abs() < 1e-4, "({x}, {y}): {got} {expected}");
        }
    }

    #[test]
    fn first_order_stays_first_order() {
        let w = Shape([5.0, 0.2, 0.1, 0.0, 0.0, 0.0]);
        let step = Shape([0.3, -0.02, 0.04, 0.0, 0.0, 0.0]);
        let new = w.compose_inverse(&step).unwrap();
        assert_eq!(new.0[3..], [0.0; 3]);
        assert!((new.warp(step.warp(2.0, 3.0), 3.0) - w.warp(2.0, 3.0)).abs() < 1e-12);
    }
}
