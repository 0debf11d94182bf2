//! The estimate's noise against the Cramer-Rao bound, on scenes where noise is all there is.

use stspp_matcher::{
    DisparityRange, Matcher, Method, Params, ShapeFunction,
    synthetic::{Layer, Rendered, Scene},
};

const GREY_PER_SAMPLE: f64 = 1.0 / 64.0;
/// As the scene is rendered: electrons per grey level, read noise in electrons, rounding to 8 bits.
const ELECTRONS_PER_DN: f64 = 10_000.0 / 255.0;
const READ_E: f64 = 3.0;
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

fn scene(frames: usize, noise: bool) -> Rendered {
    let plane = |x: f64, y: f64| 21.3 + 0.03 * x - 0.02 * y;
    let mut scene = Scene::new(190, 120, frames, vec![Layer::everywhere(plane)]);
    scene.peak_dn = 70.0;
    scene.noise = noise;
    scene.render()
}

/// Variance of a grey level in squared grey levels.
fn variance(dn: f64) -> f64 {
    (dn * ELECTRONS_PER_DN + READ_E * READ_E) / ELECTRONS_PER_DN.powi(2) + ROUNDING_VARIANCE
}

/// The bound's variance for a shift of the window around a pixel, from images without noise:
/// 1 / sum of I^2 / (var L + var R / gain^2) over 9 x 9 pixels and all frames; I by central differences of
/// eighth order.
fn bound(clean: &Rendered, x: usize, y: usize, gain: f64) -> f64 {
    let mut information = 0.0;
    for (left, right) in clean.left.iter().zip(&clean.right) {
        for j in y - 4..=y + 4 {
            for i in x - 4..=x + 4 {
                let at = |k: isize| f64::from(left.row(j)[i.wrapping_add_signed(k)]);
                let slope: f64 =
                    [(1, 4.0 / 5.0), (2, -1.0 / 5.0), (3, 4.0 / 105.0), (4, -1.0 / 280.0)]
                        .iter()
                        .map(|&(k, c)| c * (at(k) - at(-k)))
                        .sum::<f64>()
                        * GREY_PER_SAMPLE;
                let d = clean.truth_px.row(j)[i].round() as usize;
                let right_dn = f64::from(right.row(j)[i - d]) * GREY_PER_SAMPLE;
                let noise = variance(at(0) * GREY_PER_SAMPLE) + variance(right_dn) / (gain * gain);
                information += slope * slope / noise;
            }
        }
    }
    1.0 / information
}

/// RMS error of the points found against the square root of their mean bound, and which part is found.
fn times_the_bound(frames: usize, shape: ShapeFunction) -> (f64, f64) {
    let (noisy, clean) = (scene(frames, true), scene(frames, false));
    let mut params = Params::new(DisparityRange { min_px: 0, max_px: 60 });
    (params.method, params.shape) = (Method::Dense, shape);
    let mut matcher = Matcher::new(params).unwrap();
    let found = noisy.with_stack(|stack| matcher.match_stack(stack)).unwrap();
    let (mut squares, mut bounds, mut points, mut all) = (0.0, 0.0, 0, 0);
    for y in (15..105).step_by(3) {
        for x in (60..175).step_by(3) {
            let error = f64::from(found.disparity_px.row(y)[x] - noisy.truth_px.row(y)[x]);
            all += 1;
            if !error.is_nan() {
                (squares, points) = (squares + error * error, points + 1);
                bounds += bound(&clean, x, y, 0.85);
            }
        }
    }
    ((squares / bounds).sqrt(), f64::from(points) / f64::from(all))
}

#[test]
fn noise_is_within_1_4_times_the_cramer_rao_bound() {
    // A single pattern leaves windows of which a few dots are all: they say little of a second order.
    for (frames, most) in [(1, 5.5), (2, 1.4), (3, 1.4), (5, 1.4), (10, 1.4), (16, 1.4)] {
        for shape in [ShapeFunction::First, ShapeFunction::Auto] {
            let (ratio, found) = times_the_bound(frames, shape);
            println!("{frames} frames, {shape:?}: {ratio:.3} times the bound, {found:.4} found");
            assert!(
                ratio < most && found > 0.99,
                "{frames} frames, {shape:?}: {ratio:.3} times the bound"
            );
        }
    }
}
