//! Motion: rates and disparities of moving surfaces against the truth and against a slow reference in
//! f64, and what motion's estimate costs at rest.

use nalgebra::{SMatrix, SVector};
use stspp_matcher::{
    DisparityRange, Image, Level, Matched, Matcher, Method, Params, ShapeFunction, StereoStack,
    synthetic::{Layer, Rendered, Scene},
};

const FRAMES: usize = 10;
/// Seconds between frames.
const INTERVAL_S: f64 = 1.0 / 30.0;
/// 9 mm/s at 1 m and 30 frames a second are about this many px per frame.
const RATE_PX: f64 = 0.22;

fn params(shape: ShapeFunction) -> Params {
    let mut params = Params::new(DisparityRange { min_px: -20, max_px: 60 });
    params.method = Method::Dense;
    params.shape = shape;
    params
}

fn run(scene: &Rendered, params: Params) -> Matched {
    let mut matcher = Matcher::new(params).unwrap();
    let times: Vec<f64> = (0..scene.left.len()).map(|k| 7.0 + k as f64 * INTERVAL_S).collect();
    scene
        .with_stack(|stack| matcher.match_stack(&StereoStack { times_s: Some(&times), ..*stack }))
        .unwrap()
}

fn moving(layers: Vec<(Layer, f64)>, size: (usize, usize)) -> Scene {
    let layers = layers.into_iter().map(|(mut layer, rate)| {
        layer.rate_px_per_frame = rate;
        layer
    });
    let mut scene = Scene::new(size.0, size.1, FRAMES, layers.collect());
    scene.peak_dn = 70.0;
    scene
}

fn slant() -> Layer {
    Layer::everywhere(|x, y| 21.3 + 0.11 * x - 0.07 * y)
}

fn plane(rate: f64) -> Scene {
    moving(vec![(slant(), rate)], (240, 170))
}

/// Mean and standard deviation of `map` - `truth` where `inside` and well inside the image, and the
/// number of pixels, without those that are invalid.
fn errors(
    map: &Image<f32>,
    truth: impl Fn(usize, usize) -> f64,
    inside: impl Fn(usize, usize) -> bool,
) -> (f64, f64, f64) {
    let (w, h) = (map.width(), map.height());
    let (mut n, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for y in 20..h - 20 {
        for x in (65..w - 20).filter(|&x| inside(x, y)) {
            let e = f64::from(map.row(y)[x]) - truth(x, y);
            if !e.is_nan() {
                (n, sum, squares) = (n + 1.0, sum + e, squares + e * e);
            }
        }
    }
    (sum / n, (squares / n - (sum / n).powi(2)).sqrt(), n)
}

fn everywhere(_: usize, _: usize) -> bool {
    true
}

fn truth_of(scene: &Rendered) -> impl Fn(usize, usize) -> f64 {
    |x, y| f64::from(scene.truth_px.row(y)[x])
}

#[test]
fn a_moving_plane_measures_as_one_at_rest() {
    let still = plane(0.0).render();
    for shape in [ShapeFunction::First, ShapeFunction::Second] {
        let at_rest = run(&still, params(shape));
        let (_, rest, _) = errors(&at_rest.disparity_px, truth_of(&still), everywhere);
        for rate in [RATE_PX, -RATE_PX, 0.04] {
            let scene = plane(rate).render();
            let found = run(&scene, params(shape));
            let (bias, scatter, n) = errors(&found.disparity_px, truth_of(&scene), everywhere);
            println!("{shape:?} {rate}: at rest {rest:.5} moving {scatter:.5} bias {bias:.5}");
            assert!(found.at_newest && n > 20_100.0, "{n} points");
            assert!(scatter < 1.2 * rest, "{shape:?} {rate}: {scatter} at rest {rest}");
            // 0.0025 mm at 1 m.
            assert!(bias.abs() < 0.002, "{shape:?} {rate}: bias {bias}");
            let speed = found.rate_px_per_s.as_ref().unwrap();
            let (bias, scatter, _) = errors(speed, |_, _| rate / INTERVAL_S, everywhere);
            println!("  speed: bias {bias:.5} scatter {scatter:.5} px/s");
            assert!(bias.abs() < 0.012 && scatter < 0.02, "{rate}: speed {bias} {scatter}");
        }
    }
}

/// Faster motion is measured by fewer frames, with more noise; what is too fast for three is not found.
/// 0.22 px a frame are 9 mm/s at 1 m and 30 frames a second.
#[test]
fn fast_motion_is_measured_by_fewer_frames_and_beyond_that_not_at_all() {
    let mut whole = 0.0;
    for rate in [0.0, 0.3, 0.36, 0.5, 0.6, 0.75, 1.0, 1.5, 3.0] {
        let scene = plane(rate).render();
        let found = run(&scene, params(ShapeFunction::Auto));
        let truth = truth_of(&scene);
        let (bias, scatter, n) = errors(&found.disparity_px, &truth, everywhere);
        let off = |x: usize, y: usize| {
            (f64::from(found.disparity_px.row(y)[x]) - truth(x, y)).abs() > 1.0
        };
        let (_, _, wrong) = errors(&found.disparity_px, &truth, off);
        if rate == 0.0 {
            whole = n;
        }
        println!(
            "{rate} px a frame, {:.0} mm/s: {:.2} % found, {:.3} % wrong by more than 1 px, \
             bias {bias:.4}, scatter {scatter:.4} px",
            rate / RATE_PX * 9.0,
            100.0 * n / whole,
            100.0 * wrong / whole,
        );
        // Up to 31 mm/s all is found; what is wrong at any speed is lost, but for single pixels.
        assert!(wrong < 0.001 * whole, "{rate}: {wrong} of {whole} wrong");
        assert!(rate > 0.8 || n > 0.99 * whole, "{rate}: {n} of {whole} found");
        assert!(rate > 0.8 || (bias.abs() < 0.005 && scatter < 0.02), "{rate}: {bias} {scatter}");
    }
}

/// A surface nearer than the range reaches is not there, and is not taken for one too fast to be found.
#[test]
fn what_is_out_of_range_does_not_cost_the_rest() {
    let layers = vec![
        (Layer::patch(|x, y| 40.3 + 0.03 * x - 0.02 * y, |_, y| y < 120.0), 0.0),
        (Layer::patch(|_, _| 330.0, |_, y| y >= 120.0), 0.0),
    ];
    let scene = moving(layers, (480, 256)).render();
    let range = DisparityRange { min_px: -150, max_px: 250 };
    let found = run(&scene, Params { disparity: range, ..params(ShapeFunction::Auto) });
    let upper = |_: usize, y: usize| y < 110;
    let (bias, scatter, n) = errors(&found.disparity_px, truth_of(&scene), upper);
    assert!(n > 30_000.0 && bias.abs() < 0.01 && scatter < 0.05, "{n} {bias} {scatter}");
}

#[test]
fn at_rest_the_rate_is_zero_and_the_disparity_untouched() {
    let scene = plane(0.0).render();
    for shape in [ShapeFunction::First, ShapeFunction::Second, ShapeFunction::Auto] {
        let with = run(&scene, params(shape));
        let without = run(&scene, Params { motion: false, ..params(shape) });
        let bits = |m: &Matched| -> Vec<u32> {
            m.disparity_px.as_slice().iter().map(|d| d.to_bits()).collect()
        };
        assert_eq!(bits(&with), bits(&without));
        let rates = with.rate_px_per_s.unwrap();
        let pairs = rates.as_slice().iter().zip(with.disparity_px.as_slice());
        assert!(pairs.clone().any(|(v, _)| *v == 0.0));
        assert!(pairs.clone().all(|(v, d)| *v == 0.0 || (v.is_nan() && d.is_nan())));
        assert!(with.at_newest && !without.at_newest && without.rate_px_per_s.is_none());
    }
}

/// A disc that comes closer before a plane that recedes, and a strip at rest.
#[test]
fn parts_that_move_differently_have_their_own_rates() {
    let disc = |x: f64, y: f64| (x - 130.0).hypot(y - 85.0) < 40.0;
    let strip = |x: f64, _: f64| x > 195.0;
    let layers = || {
        let far = Layer::everywhere(|x, _| 8.0 + 0.03 * x);
        let near = Layer::patch(|_, y| 30.0 + 0.02 * y, disc);
        let still = Layer::patch(|x, _| 26.0 - 0.02 * x, strip);
        vec![(far, -0.1), (near, 0.2), (still, 0.0)]
    };
    let scene = moving(layers(), (260, 170)).render();
    let rest = layers().into_iter().map(|(layer, _)| (layer, 0.0)).collect();
    let rest = moving(rest, (260, 170)).render();
    let found = run(&scene, params(ShapeFunction::First));
    let at_rest = run(&rest, params(ShapeFunction::First));
    let rates = found.rate_px_per_s.as_ref().unwrap();
    let radius = |x: usize, y: usize| (x as f64 - 130.0).hypot(y as f64 - 85.0);
    let on_disc = |x: usize, y: usize| radius(x, y) < 33.0;
    // What the disc and the strip hide from one of the cameras is not measured.
    let on_plane = |x: usize, y: usize| radius(x, y) > 75.0 && x < 165;
    let on_strip = |x: usize, _: usize| x >= 214;
    type Inside<'a> = &'a dyn Fn(usize, usize) -> bool;
    let parts: [(&str, Inside<'_>, f64); 3] =
        [("disc", &on_disc, 0.2), ("plane", &on_plane, -0.1), ("strip", &on_strip, 0.0)];
    for (part, inside, rate) in parts {
        let (v_bias, v_scatter, n) = errors(rates, |_, _| rate / INTERVAL_S, inside);
        let (bias, scatter, _) = errors(&found.disparity_px, truth_of(&scene), inside);
        let (_, still, _) = errors(&at_rest.disparity_px, truth_of(&rest), inside);
        println!(
            "{part}: rate {v_bias:.4} {v_scatter:.4} px/s, disparity {bias:.5} {scatter:.5} ({still:.5}), {n}"
        );
        assert!(n > 600.0, "{part}: {n} points");
        assert!(v_bias.abs() < 0.03 && v_scatter < 0.06, "{part}: rate {v_bias} {v_scatter}");
        assert!(bias.abs() < 0.004, "{part}: bias {bias}");
        assert!(scatter < 1.4 * still, "{part}: {scatter} at rest {still}");
    }
}

/// The model written out for one pixel, in f64: least squares of
/// L_t(x + i, y + j) = ratio R_t(x + i - d - v t, y + j) + offset over a window of 41 x 41 pixels and
/// all frames, with d = a + b i + c j and a, b, c, v, ratio and offset unknown, by Gauss-Newton with a
/// windowed sinc of 12 taps. Gives v and a at the newest frame's time.
fn reference(scene: &Rendered, x: usize, y: usize, start: f64) -> (f64, f64) {
    const RADIUS: i32 = 20;
    let frames = scene.left.len();
    let sinc = |t: f64| {
        if t.abs() < 1e-12 {
            1.0
        } else {
            (std::f64::consts::PI * t).sin() / (std::f64::consts::PI * t)
        }
    };
    let interpolated = |image: &Image<i16>, at: f64, y: usize| -> (f64, f64) {
        let value = |at: f64| {
            let first = at.floor() as i64 - 5;
            (first..first + 12)
                .map(|k| {
                    f64::from(image.row(y)[k as usize])
                        * sinc(at - k as f64)
                        * sinc((at - k as f64) / 6.0)
                })
                .sum::<f64>()
        };
        (value(at), (value(at + 0.01) - value(at - 0.01)) / 0.02)
    };
    let mut p = SVector::<f64, 6>::from([start, 0.0, 0.0, 0.0, 1.0, 0.0]);
    for _ in 0..12 {
        let mut m = SMatrix::<f64, 6, 6>::zeros();
        let mut b = SVector::<f64, 6>::zeros();
        for t in 0..frames {
            let time = t as f64 - (frames - 1) as f64;
            // Every second pixel is plenty.
            for j in (-RADIUS..=RADIUS).step_by(2) {
                for i in (-RADIUS..=RADIUS).step_by(2) {
                    let (px, py) = ((x as i32 + i) as usize, (y as i32 + j) as usize);
                    let d = p[0] + p[1] * f64::from(i) + p[2] * f64::from(j) + p[3] * time;
                    let (g, slope) = interpolated(&scene.right[t], px as f64 - d, py);
                    let residual = f64::from(scene.left[t].row(py)[px]) - p[4] * g - p[5];
                    let s = -p[4] * slope;
                    let row = SVector::<f64, 6>::from([
                        s,
                        s * f64::from(i),
                        s * f64::from(j),
                        s * time,
                        g,
                        1.0,
                    ]);
                    m += row * row.transpose();
                    b += row * residual;
                }
            }
        }
        p += m.try_inverse().expect("a textured window") * b;
    }
    (p[3], p[0])
}

#[test]
fn agrees_with_the_reference_in_f64() {
    let scene = plane(RATE_PX).render();
    let found = run(&scene, params(ShapeFunction::First));
    let rates = found.rate_px_per_s.as_ref().unwrap();
    for (x, y) in [(110, 60), (150, 100), (190, 85)] {
        let truth = f64::from(scene.truth_px.row(y)[x]);
        let (v, d) = reference(&scene, x, y, truth.round());
        let (v_found, d_found) =
            (f64::from(rates.row(y)[x]) * INTERVAL_S, f64::from(found.disparity_px.row(y)[x]));
        println!("{x} {y}: {v:.5} {v_found:.5}; {d:.5} {d_found:.5}, truth {truth:.5}");
        assert!((v - RATE_PX).abs() < 1e-3 && (v - v_found).abs() < 1.5e-3, "{v} {v_found}");
        // A window of 9 x 9 scatters more than one of 41 x 41.
        assert!((d - truth).abs() < 0.004 && (d - d_found).abs() < 0.016, "{d} {d_found} {truth}");
    }
}

#[test]
fn times_may_be_uneven_or_missing_and_frames_few() {
    let scene = plane(RATE_PX).render();
    let mut matcher = Matcher::new(params(ShapeFunction::First)).unwrap();
    // Without times: as if evenly spaced, and no speed.
    let found = scene.with_stack(|stack| matcher.match_stack(stack)).unwrap();
    assert!(found.at_newest && found.rate_px_per_s.is_none());
    let (bias, _, _) = errors(&found.disparity_px, truth_of(&scene), everywhere);
    assert!(bias.abs() < 0.002, "{bias}");
    // Frames 0, 1, 2, 5, 6, 9 at their times.
    let kept = [0, 1, 2, 5, 6, 9];
    let times = kept.map(|k| f64::from(k) * INTERVAL_S);
    let of = |images: &[Image<i16>]| kept.map(|k| images[k as usize].clone());
    let (left, right) = (of(&scene.left), of(&scene.right));
    let (left, right) = (left.each_ref(), right.each_ref());
    let stack = StereoStack { times_s: Some(&times), ..StereoStack::new(&left, &right) };
    let found = matcher.match_stack(&stack).unwrap();
    let (bias, _, _) = errors(&found.disparity_px, truth_of(&scene), everywhere);
    let (speed, _, _) =
        errors(found.rate_px_per_s.as_ref().unwrap(), |_, _| RATE_PX / INTERVAL_S, everywhere);
    assert!(bias.abs() < 0.003 && speed.abs() < 0.03, "{bias} {speed}");
    for frames in [1, 2] {
        let stack = StereoStack::new(&left[..frames], &right[..frames]);
        assert!(matcher.match_stack(&stack).unwrap().at_newest);
    }
}

#[test]
fn neither_threads_nor_the_level_change_a_moving_result() {
    let scene = plane(RATE_PX).render();
    let with = |threads: usize, level: Level| {
        let mut params = params(ShapeFunction::Auto);
        params.advanced.threads = Some(threads);
        params.advanced.level_max = Some(level);
        run(&scene, params)
    };
    let bits = |m: &Image<f32>| m.as_slice().iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    let one = with(1, Level::best());
    let three = with(3, Level::best());
    assert_eq!(bits(&one.disparity_px), bits(&three.disparity_px));
    let rates = |m: &Matched| bits(m.rate_px_per_s.as_ref().unwrap());
    assert_eq!(rates(&one), rates(&three));
    for level in Level::available() {
        let other = with(2, level);
        let (bias, scatter, _) =
            errors(&other.disparity_px, |x, y| f64::from(one.disparity_px.row(y)[x]), everywhere);
        assert!(bias.abs() < 1e-4 && scatter < 1e-3, "{level}: {bias} {scatter}");
    }
}
