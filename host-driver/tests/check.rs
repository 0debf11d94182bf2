//! The vertical disparity against an independent reference, and turns of a camera found again.

use nalgebra::{DMatrix, DVector};
use stspp::accuracy::capture::Capture;
use stspp::check::drift::Axes;
use stspp::check::icgn::{self, Affine};
use stspp::check::{Options, check, search, trials};
use stspp::reconstruct::RectifiedStack;
use stspp::rectify::{DepthRange, Rectifier};
use stspp_hil_sim::world::{SceneSpec, SensorModel};
use stspp_matcher::{Image, Sample};

/// Interpolating cubic spline of a line by its definition: coefficients from the whole linear system.
struct Spline1(Vec<f64>);

fn basis(t: f64) -> f64 {
    let t = t.abs();
    if t < 1.0 {
        2.0 / 3.0 - t * t + t * t * t / 2.0
    } else if t < 2.0 {
        (2.0 - t).powi(3) / 6.0
    } else {
        0.0
    }
}

impl Spline1 {
    fn new(samples: &[f64]) -> Self {
        let n = samples.len();
        let mut system = DMatrix::<f64>::zeros(n, n);
        for row in 0..n {
            for k in -1..=1_i64 {
                let at = row as i64 + k;
                let at = if at < 0 {
                    -at
                } else if at >= n as i64 {
                    2 * n as i64 - 2 - at
                } else {
                    at
                };
                system[(row, at as usize)] += basis(k as f64);
            }
        }
        let solved = system.lu().solve(&DVector::from_column_slice(samples)).unwrap();
        Self(solved.iter().copied().collect())
    }

    fn at(&self, x: f64) -> f64 {
        let n = self.0.len() as i64;
        (x.floor() as i64 - 1..=x.floor() as i64 + 2)
            .map(|k| {
                let at = if k < 0 {
                    -k
                } else if k >= n {
                    2 * n - 2 - k
                } else {
                    k
                };
                self.0[at as usize] * basis(x - k as f64)
            })
            .sum()
    }
}

/// Zero-mean normalised sum of squared differences of a window, slow and direct.
fn znssd(stack: &RectifiedStack, (x, y): (usize, usize), r: i64, p: &[f64; 6]) -> f64 {
    let (mut left, mut right) = (Vec::new(), Vec::new());
    for (l, g) in stack.left.iter().zip(&stack.right) {
        // Lines of splines along x, of whose values splines along y are made.
        let reach = r + 12;
        let (cx, cy) = (x as i64 + p[0].round() as i64, y as i64 + p[3].round() as i64);
        let rows: Vec<Spline1> = (cy - reach..=cy + reach)
            .map(|row| {
                let line: Vec<f64> = (cx - reach..=cx + reach)
                    .map(|column| f64::from(g.get(column as usize, row as usize).unwrap()) / 64.0)
                    .collect();
                Spline1::new(&line)
            })
            .collect();
        for dy in -r..=r {
            for dx in -r..=r {
                left.push(
                    f64::from(l.get((x as i64 + dx) as usize, (y as i64 + dy) as usize).unwrap())
                        / 64.0,
                );
                let (dx, dy) = (dx as f64, dy as f64);
                let wx = x as f64 + dx + p[0] + p[1] * dx + p[2] * dy;
                let wy = y as f64 + dy + p[3] + p[4] * dx + p[5] * dy;
                let column: Vec<f64> =
                    rows.iter().map(|row| row.at(wx - (cx - reach) as f64)).collect();
                right.push(Spline1::new(&column).at(wy - (cy - reach) as f64));
            }
        }
    }
    let normalise = |v: &mut Vec<f64>| {
        let mean = v.iter().sum::<f64>() / v.len() as f64;
        v.iter_mut().for_each(|x| *x -= mean);
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        v.iter_mut().for_each(|x| *x /= norm);
    };
    normalise(&mut left);
    normalise(&mut right);
    left.iter().zip(&right).map(|(a, b)| (a - b).powi(2)).sum()
}

/// Dots drawn at known places: the right image moved by a known affine field.
fn drawn(truth: &Affine, middle: (f64, f64)) -> RectifiedStack {
    let (w, h) = (96_usize, 96_usize);
    let mut left = Vec::new();
    let mut right = Vec::new();
    for frame in 0..2_u64 {
        let mut state = 77 + frame;
        let mut random = || {
            state =
                state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963);
            (state >> 33) as f64 / (1_u64 << 31) as f64
        };
        let dots: Vec<(f64, f64)> =
            (0..700).map(|_| (random() * w as f64, random() * h as f64)).collect();
        let draw = |moved: &dyn Fn(f64, f64) -> (f64, f64)| {
            let mut image: Image<Sample> = Image::new(w, h, 0);
            for y in 0..h {
                for x in 0..w {
                    // Which left place is seen here.
                    let (sx, sy) = moved(x as f64, y as f64);
                    let sum: f64 = dots
                        .iter()
                        .map(|(dx, dy)| (-((sx - dx).powi(2) + (sy - dy).powi(2)) / 3.4).exp())
                        .sum();
                    image.set(x, y, (64.0 * (20.0 + 60.0 * sum)).round() as Sample);
                }
            }
            image
        };
        left.push(draw(&|x, y| (x, y)));
        // Inverts the affine field about the window's middle.
        let inverse = nalgebra::Matrix2::new(1.0 + truth.ux, truth.uy, truth.vx, 1.0 + truth.vy)
            .try_inverse()
            .unwrap();
        right.push(draw(&|x, y| {
            let d = nalgebra::Vector2::new(x - middle.0 - truth.u, y - middle.1 - truth.v);
            let s = inverse * d;
            (middle.0 + s.x, middle.1 + s.y)
        }));
    }
    let calibration = stspp::sim::calibration_of(&SensorModel::default().scaled_down(8));
    let rectifier = Rectifier::new(&calibration, DepthRange::default()).unwrap();
    RectifiedStack { rectifier, left, right, labels: Vec::new() }
}

#[test]
fn refinement_agrees_with_the_slow_reference_and_the_truth() {
    let truth = Affine { u: 3.37, ux: 0.012, uy: -0.008, v: -1.63, vx: 0.004, vy: -0.003 };
    let stack = drawn(&truth, (48.0, 48.0));
    let start = Affine { u: 3.0, v: -2.0, ..Affine::default() };
    let found = icgn::refine(&stack, (48, 48), 8, start).unwrap();
    println!("{found:?}");
    assert!((found.affine.u - truth.u).abs() < 0.004 && (found.affine.v - truth.v).abs() < 0.004);
    assert!(found.zncc > 0.999);
    // The reference's minimum over u and v, by a parabola through its values about the found place.
    let at = |du: f64, dv: f64| {
        let a = found.affine;
        znssd(&stack, (48, 48), 8, &[a.u + du, a.ux, a.uy, a.v + dv, a.vx, a.vy])
    };
    let h = 0.05;
    let middle = at(0.0, 0.0);
    for (name, before, after) in [("u", at(-h, 0.0), at(h, 0.0)), ("v", at(0.0, -h), at(0.0, h))] {
        let offset = 0.5 * h * (before - after) / (before - 2.0 * middle + after);
        println!("{name}: reference minimum {offset:+.5} px away, ZNSSD {middle:.6}");
        assert!(offset.abs() < 0.003, "{name} {offset}");
    }
    assert!((1.0 - middle / 2.0 - found.zncc).abs() < 1e-4);
}

#[test]
fn an_injected_turn_is_found_and_corrected() {
    let model = SensorModel::with_seed(4).scaled_down(2);
    let scene = SceneSpec::parse("statue", &[]).unwrap();
    let options = Options { spacing_px: 24, ..Options::default() };
    let turned_deg = [0.05, 0.0, -0.05];
    let trial = trials::injected(&scene, &model, turned_deg, 5, &options, Axes::default()).unwrap();
    println!("{}", trial.report.to_text());
    println!("error {:?}", trial.error_deg);
    // Nothing turned about y: a yaw that this small recording cannot tell is not put in.
    assert!(trial.error_deg.iter().all(|e| e.abs() < 0.005), "{:?}", trial.error_deg);
    assert_eq!(trial.report.drift.correction_deg[1], 0.0);
    assert!(trial.report.before.rms_px > 0.5 && trial.report.after.rms_px < 0.1);
}

#[test]
fn a_plain_or_dark_recording_is_an_error_that_says_what_to_do() {
    let model = SensorModel::with_seed(4).scaled_down(4);
    let scene = SceneSpec::parse("plane", &[("distance_m", "1")]).unwrap();
    let mut capture = Capture::record(&scene, model, 2, &mut |_| {}).unwrap();
    for pair in &mut capture.pairs {
        let (w, h) = (pair.left.width(), pair.left.height());
        pair.left = stspp::RawImage::gray8(Image::new(w, h, 40));
        pair.right = stspp::RawImage::gray8(Image::new(w, h, 40));
    }
    let error = check(
        &capture.calibration,
        &capture.pairs,
        &Options::default(),
        Axes::default(),
        &mut |_| {},
    )
    .unwrap_err()
    .to_string();
    assert!(error.contains("0 of") && error.contains("speckles"), "{error}");
    let rectifier = Rectifier::new(&capture.calibration, DepthRange::default()).unwrap();
    let stack = RectifiedStack::new(rectifier, &capture.pairs, Vec::new()).unwrap();
    assert!(search::search(&stack, &Options::default()).found.is_empty());
}
