//! Cubic B-splines of small pieces of an image, in double precision.

/// Pole of the cubic B-spline's prefilter.
const POLE: f64 = -0.267_949_192_431_122_7;
/// Samples after which the pole's power is below rounding.
const HORIZON: usize = 28;

/// A piece of an image as spline coefficients.
#[derive(Debug, Clone)]
pub(super) struct Piece {
    /// Image coordinates of its first pixel.
    pub origin: (i64, i64),
    pub width: usize,
    pub height: usize,
    coefficients: Vec<f64>,
}

/// Values of the cubic B-spline at -1, 0, 1, 2 pixels from the one before, and their derivatives.
fn weights(f: f64) -> ([f64; 4], [f64; 4]) {
    let g = 1.0 - f;
    (
        [
            g * g * g / 6.0,
            2.0 / 3.0 - f * f * (2.0 - f) / 2.0,
            2.0 / 3.0 - g * g * (2.0 - g) / 2.0,
            f * f * f / 6.0,
        ],
        [-g * g / 2.0, -2.0 * f + 1.5 * f * f, 2.0 * g - 1.5 * g * g, f * f / 2.0],
    )
}

/// Turns samples into coefficients, mirrored about both ends.
fn prefilter(line: &mut [f64]) {
    let n = line.len();
    if n < 2 {
        return;
    }
    let mirrored = |k: usize| {
        let period = 2 * (n - 1);
        let k = k % period;
        if k < n { k } else { period - k }
    };
    let mut start = 0.0;
    let mut power = 1.0;
    for k in 0..HORIZON {
        start += power * line[mirrored(k)];
        power *= POLE;
    }
    line[0] = start;
    for k in 1..n {
        line[k] += POLE * line[k - 1];
    }
    line[n - 1] = POLE / (POLE * POLE - 1.0) * (line[n - 1] + POLE * line[n - 2]);
    for k in (0..n - 1).rev() {
        line[k] = POLE * (line[k + 1] - line[k]);
    }
    line.iter_mut().for_each(|c| *c *= 6.0);
}

impl Piece {
    /// A piece of `width` x `height` pixels from `origin`, whose pixels `at(x, y)` gives.
    pub fn new(
        origin: (i64, i64),
        width: usize,
        height: usize,
        at: impl Fn(i64, i64) -> f64,
    ) -> Self {
        let mut coefficients = Vec::with_capacity(width * height);
        for y in 0..height as i64 {
            coefficients.extend((0..width as i64).map(|x| at(origin.0 + x, origin.1 + y)));
        }
        coefficients.chunks_mut(width).for_each(prefilter);
        let mut column = vec![0.0; height];
        for x in 0..width {
            for (y, c) in column.iter_mut().enumerate() {
                *c = coefficients[y * width + x];
            }
            prefilter(&mut column);
            for (y, c) in column.iter().enumerate() {
                coefficients[y * width + x] = *c;
            }
        }
        Self { origin, width, height, coefficients }
    }

    /// Value and derivatives (by x, by y) at image coordinates; `None` where the spline's support
    /// leaves the piece.
    pub fn at(&self, x: f64, y: f64) -> Option<(f64, f64, f64)> {
        let (x, y) = (x - self.origin.0 as f64, y - self.origin.1 as f64);
        let (x0, y0) = (x.floor(), y.floor());
        let inside =
            x0 >= 1.0 && y0 >= 1.0 && x0 + 2.0 < self.width as f64 && y0 + 2.0 < self.height as f64;
        if !inside {
            return None;
        }
        let ((wx, dx), (wy, dy)) = (weights(x - x0), weights(y - y0));
        let (mut value, mut by_x, mut by_y) = (0.0, 0.0, 0.0);
        let first = (y0 as usize - 1) * self.width + x0 as usize - 1;
        for j in 0..4 {
            let line = &self.coefficients[first + j * self.width..][..4];
            let (mut sum, mut slope) = (0.0, 0.0);
            for i in 0..4 {
                sum += wx[i] * line[i];
                slope += dx[i] * line[i];
            }
            value += wy[j] * sum;
            by_x += wy[j] * slope;
            by_y += dy[j] * sum;
        }
        Some((value, by_x, by_y))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spline_goes_through_its_samples_and_follows_a_smooth_function() {
        let f = |x: f64, y: f64| (0.4 * x + 0.1 * y).sin() + 0.3 * (0.5 * y).cos();
        let piece = Piece::new((5, -3), 40, 36, |x, y| f(x as f64, y as f64));
        for (x, y) in [(20.0, 10.0), (21.0, 15.0)] {
            assert!((piece.at(x, y).unwrap().0 - f(x, y)).abs() < 1e-10);
        }
        let (value, by_x, by_y) = piece.at(22.37, 14.81).unwrap();
        let h = 1e-5;
        assert!((value - f(22.37, 14.81)).abs() < 5e-4);
        let slope_x = (piece.at(22.37 + h, 14.81).unwrap().0 - value) / h;
        let slope_y = (piece.at(22.37, 14.81 + h).unwrap().0 - value) / h;
        assert!((by_x - slope_x).abs() < 1e-4 && (by_y - slope_y).abs() < 1e-4);
        assert!(piece.at(5.5, 0.0).is_none() && piece.at(43.5, 10.0).is_none());
    }
}
