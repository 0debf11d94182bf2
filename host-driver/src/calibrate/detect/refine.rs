//! Sub-pixel places of corners and discs, by models of their grey values.
//!
//! A corner is the product of two blurred edges, a disc a blurred ellipse, each on a tilted grey
//! plane (uneven light). Both models are fitted to the pixels near the edges, which is all that tells
//! the place. The blur comes out with it.

use nalgebra::{SVector, Vector2};

use super::fit::{self, edge};
use super::gray::Gray;

/// A refined point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// Its place.
    pub pixel: Vector2<f64>,
    /// Standard deviation of the edges' blur, in px.
    pub blur_px: f64,
    /// Grey values of white and black next to it.
    pub white: f64,
    /// See `white`.
    pub black: f64,
}

/// Farthest that refinement moves a corner.
const MOVE_MAX_PX: f64 = 2.0;
/// Least difference of white and black, in grey values of 8 bits.
const CONTRAST_MIN: f64 = 6.0;
/// Rest of the model, relative to the contrast, above which it is none of a corner or disc.
const REST_MAX: f64 = 0.2;

/// Refines a corner of a chessboard from a start within two pixels. `along` are the vectors to the
/// neighbouring corners in both directions; `clear` is the width of the strip beside an edge, as a
/// part of the pitch, in which nothing else is printed.
pub fn corner(
    gray: &Gray,
    start: Vector2<f64>,
    along: [Vector2<f64>; 2],
    clear: f64,
) -> Option<Refined> {
    let pitch = along[0].norm().min(along[1].norm());
    let reach = (0.4 * pitch).clamp(2.5, 12.0);
    // A pixel less, so that the blur of what is printed beyond stays out.
    let strip = (clear * pitch - 1.2).clamp(1.5, 6.0);
    if !gray.contains(start, reach.min(4.0)) {
        return None;
    }
    let angles = along.map(|v| v.y.atan2(v.x));
    let distance = |angle: f64, x: f64, y: f64| y * angle.cos() - x * angle.sin();
    let select = |x: f64, y: f64| {
        let near = distance(angles[0], x, y).abs().min(distance(angles[1], x, y).abs());
        near <= strip && x.hypot(y) <= reach
    };
    let mut centre = start;
    let mut found = None;
    // The second pass selects the pixels about the place that the first one found.
    for _ in 0..2 {
        let pixels = fit::window(gray, (centre.x, centre.y), reach, select);
        let mean = pixels.iter().map(|p| p.value).sum::<f64>() / pixels.len().max(1) as f64;
        let signed: f64 = pixels
            .iter()
            .map(|p| {
                let sign = distance(angles[0], p.x, p.y) * distance(angles[1], p.x, p.y);
                (p.value - mean).copysign((p.value - mean) * sign)
            })
            .sum();
        let contrast = signed / pixels.len().max(1) as f64;
        // x, y, both angles, ln blur, mean, contrast, slope x, slope y.
        let begin = SVector::<f64, 9>::from([
            0.0,
            0.0,
            angles[0],
            angles[1],
            (0.8_f64).ln(),
            mean,
            contrast,
            0.0,
            0.0,
        ]);
        let steps = SVector::<f64, 9>::from([0.02, 0.02, 0.01, 0.01, 0.02, 0.5, 0.5, 0.05, 0.05]);
        let fitted = fit::fit(&pixels, begin, &steps, |p, x, y| {
            let (x, y) = (x - p[0], y - p[1]);
            let blur = p[4].exp();
            let product = edge(distance(p[2], x, y) / blur) * edge(distance(p[3], x, y) / blur);
            p[5] + p[6] * product + p[7] * x + p[8] * y
        })?;
        let p = fitted.parameters;
        let moved = centre + Vector2::new(p[0], p[1]);
        let blur_px = p[4].exp();
        let is_corner = (moved - start).norm() <= MOVE_MAX_PX.min(0.3 * pitch)
            && 2.0 * p[6].abs() >= CONTRAST_MIN
            && fitted.rms <= REST_MAX * 2.0 * p[6].abs()
            && (0.1..0.5 * pitch).contains(&blur_px);
        if !is_corner {
            return None;
        }
        centre = moved;
        found = Some(Refined {
            pixel: moved,
            blur_px,
            white: p[5] + p[6].abs(),
            black: p[5] - p[6].abs(),
        });
    }
    found
}

/// Shape of a disc's image: a point is on the outline where its square form is 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipse {
    /// Centre.
    pub centre: Vector2<f64>,
    /// Half axes' covariance-like matrix (xx, xy, yy): semi-axes squared along its eigenvectors.
    pub shape: [f64; 3],
}

/// Refines a black disc on white from its moments. Only pixels near the outline count: whether the
/// middle is hollow does not matter.
pub fn disc(gray: &Gray, start: Ellipse, white: f64, black: f64) -> Option<Refined> {
    let [xx, xy, yy] = start.shape;
    let largest = xx.max(yy).sqrt();
    let reach = 1.6 * largest + 1.5;
    if !gray.contains(start.centre, largest + 1.0) {
        return None;
    }
    // Lower triangle L of the inverse's root: rho = |L^T p|, kept as its three entries.
    let determinant = xx * yy - xy * xy;
    if determinant <= 0.0 {
        return None;
    }
    let (ixx, ixy, iyy) = (yy / determinant, -xy / determinant, xx / determinant);
    let a = ixx.sqrt();
    let b = ixy / a;
    let c = (iyy - b * b).max(0.0).sqrt();
    let rho = |a: f64, b: f64, c: f64, x: f64, y: f64| (a * x + b * y).hypot(c * y);
    let mut centre = start.centre;
    let mut found = None;
    for _ in 0..2 {
        let pixels = fit::window(gray, (centre.x, centre.y), reach, |x, y| {
            let inside = rho(a, b, c, x, y);
            // The strip about the outline, in pixels as far as the mean radius tells.
            let distance = (inside - 1.0) * x.hypot(y) / inside.max(1e-9);
            inside > 0.62 && (-4.0..3.5).contains(&distance)
        });
        // x, y, the three entries relative to the start, ln blur, mean, contrast, slopes.
        let begin = SVector::<f64, 10>::from([
            0.0,
            0.0,
            1.0,
            0.0,
            1.0,
            (0.8_f64).ln(),
            (white + black) / 2.0,
            (white - black) / 2.0,
            0.0,
            0.0,
        ]);
        let s = 0.02 / largest;
        let steps = SVector::<f64, 10>::from([0.02, 0.02, s, s, s, 0.02, 0.5, 0.5, 0.05, 0.05]);
        let fitted = fit::fit(&pixels, begin, &steps, |p, x, y| {
            let (x, y) = (x - p[0], y - p[1]);
            let (a, b, c) = (a * p[2], b + a * p[3], c * p[4]);
            let (u, v) = (a * x + b * y, c * y);
            let rho = u.hypot(v).max(1e-9);
            // Distance to first order: (rho - 1) over the slope of rho.
            let slope = (a * u).hypot(b * u + c * v) / rho;
            p[6] + p[7] * edge((rho - 1.0) / slope / p[5].exp()) + p[8] * x + p[9] * y
        })?;
        let p = fitted.parameters;
        let moved = centre + Vector2::new(p[0], p[1]);
        let blur_px = p[5].exp();
        let is_disc = (moved - start.centre).norm() <= MOVE_MAX_PX
            && 2.0 * p[7] >= CONTRAST_MIN
            && fitted.rms <= REST_MAX * 2.0 * p[7]
            && (0.1..largest).contains(&blur_px);
        if !is_disc {
            return None;
        }
        centre = moved;
        found = Some(Refined { pixel: moved, blur_px, white: p[6] + p[7], black: p[6] - p[7] });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use stspp_matcher::Image;

    /// Draws what a lens with a Gaussian spread of 0.65 px images, by sampling about each pixel.
    fn drawn(size: usize, is_white: impl Fn(f64, f64) -> bool) -> Gray {
        let offset = |k: i32| f64::from(k) / 10.0;
        let weight = |k: i32| (-0.5 * (offset(k) / 0.65).powi(2)).exp();
        let mut pixels = Image::new(size, size, 0.0_f32);
        for y in 0..size {
            for x in 0..size {
                let (mut sum, mut total) = (0.0, 0.0);
                for (i, j) in (-20..=20).flat_map(|i| (-20..=20).map(move |j| (i, j))) {
                    let w = weight(i) * weight(j);
                    total += w;
                    if is_white(x as f64 + offset(i), y as f64 + offset(j)) {
                        sum += w;
                    }
                }
                pixels.set(x, y, (20.0 + 200.0 * sum / total) as f32);
            }
        }
        Gray { pixels }
    }

    #[test]
    fn corners_and_discs_are_found_to_a_hundredth_of_a_pixel() {
        for (cx, cy, a, b) in [(20.3, 19.6, 0.2_f64, 1.6_f64), (20.0, 20.5, -0.4, 1.3)] {
            let gray = drawn(41, |x, y| {
                let d = |angle: f64| (y - cy) * angle.cos() - (x - cx) * angle.sin();
                d(a) * d(b) > 0.0
            });
            let along = [a, b].map(|angle| Vector2::new(angle.cos(), angle.sin()) * 30.0);
            let found = corner(&gray, Vector2::new(21.0, 19.0), along, 0.5).unwrap();
            assert!((found.pixel - Vector2::new(cx, cy)).norm() < 0.01, "{found:?}");
            assert!((found.white - 220.0).abs() < 3.0 && (found.black - 20.0).abs() < 3.0);

            let gray = drawn(41, |x, y| ((x - cx) / 9.0).powi(2) + ((y - cy) / 6.0).powi(2) > 1.0);
            let start =
                Ellipse { centre: Vector2::new(cx + 0.6, cy - 0.4), shape: [75.0, 2.0, 40.0] };
            let found = disc(&gray, start, 200.0, 30.0).unwrap();
            assert!((found.pixel - Vector2::new(cx, cy)).norm() < 0.01, "{found:?}");
        }
    }

    #[test]
    fn a_plain_surface_has_no_corner() {
        let gray = drawn(41, |x, _| x > 20.0);
        let along = [Vector2::new(30.0, 0.0), Vector2::new(0.0, 30.0)];
        assert!(corner(&gray, Vector2::new(20.0, 20.0), along, 0.5).is_none());
    }
}
