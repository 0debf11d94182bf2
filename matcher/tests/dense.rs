//! The fast path as a whole: against the truth, against per-point IC-GN, over threads and SIMD
//! levels, at depth steps, on thin objects, and on input that cannot be matched.

use stspp_matcher::{
    DisparityRange, Image, Level, Matched, Matcher, Method, Params, Sample, ShapeFunction,
    StereoStack,
    coarse::{Coarse, CoarseMap, INVALID},
    synthetic::{Layer, Random, Rendered, Scene},
};

/// Largest difference between SIMD levels, whose fused multiply-adds round differently.
const LEVEL_TOLERANCE_PX: f32 = 1e-3;

fn params(method: Method, shape: ShapeFunction) -> Params {
    let mut params = Params::new(DisparityRange { min_px: -20, max_px: 60 });
    params.method = method;
    params.shape = shape;
    params
}

fn run(scene: &Rendered, params: Params) -> Matched {
    let mut matcher = Matcher::new(params).unwrap();
    scene.with_stack(|stack| matcher.match_stack(stack)).unwrap()
}

/// Coarse maps of the cheap search and of brute force.
fn searched(stack: &StereoStack<'_>, range: DisparityRange) -> (CoarseMap, CoarseMap) {
    let mut coarse = Coarse::new(Level::best(), range);
    coarse.describe(stack);
    let (mut cheap, mut all) = (CoarseMap::new(0, 0), CoarseMap::new(0, 0));
    coarse.search(stack, false, &mut cheap);
    coarse.search_all(stack, &mut all);
    (cheap, all)
}

/// Errors where the map is valid and at least `margin` px inside, 40 more on the left: there the
/// right image ends.
fn errors(map: &Image<f32>, truth: &Image<f32>, margin: usize) -> Vec<f64> {
    let (w, h) = (map.width(), map.height());
    let inside = |i: &usize| {
        let (x, y) = (i % w, i / w);
        x >= margin + 40 && x + margin < w && y >= margin && y + margin < h
    };
    (0..w * h)
        .filter(inside)
        .map(|i| f64::from(map.as_slice()[i]) - f64::from(truth.as_slice()[i]))
        .filter(|e| !e.is_nan())
        .collect()
}

fn rms(errors: &[f64]) -> f64 {
    (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
}

fn slanted(noise: bool) -> Scene {
    let plane = |x: f64, y: f64| 21.3 + 0.11 * x - 0.07 * y;
    let mut scene = Scene::new(200, 110, 10, vec![Layer::everywhere(plane)]);
    scene.noise = noise;
    // Nothing saturates: that would be an error of the scene, not of the estimate.
    scene.peak_dn = 70.0;
    scene
}

#[test]
fn finds_a_slanted_plane_without_noise_and_without_bias() {
    let scene = slanted(false).render();
    for shape in [ShapeFunction::First, ShapeFunction::Second, ShapeFunction::Auto] {
        let found = run(&scene, params(Method::Dense, shape));
        let errors = errors(&found.disparity_px, &scene.truth_px, 25);
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!(errors.len() > 105 * 55, "{shape:?}: {} points", errors.len());
        // What is left is the interpolation's error, which the second order averages less.
        assert!(rms(&errors) < 1.5e-3 && mean.abs() < 5e-4, "{shape:?} {} {mean}", rms(&errors));
    }
}

/// The dense form is the same estimate as the per-point one, which has references of its own.
#[test]
fn equals_icgn() {
    let scene = slanted(true).render();
    for (shape, most) in [(ShapeFunction::First, 1.5e-3), (ShapeFunction::Second, 3e-3)] {
        let dense = run(&scene, params(Method::Dense, shape));
        let point = run(&scene, params(Method::IcGn, shape));
        let difference = errors(&dense.disparity_px, &point.disparity_px, 25);
        let (d, p) = (
            rms(&errors(&dense.disparity_px, &scene.truth_px, 25)),
            rms(&errors(&point.disparity_px, &scene.truth_px, 25)),
        );
        assert!(difference.len() > 105 * 55);
        assert!(rms(&difference) < most, "{shape:?} differs by {}", rms(&difference));
        assert!(d < 1.03 * p, "{shape:?}: dense {d}, per point {p}");
    }
}

#[test]
fn auto_takes_the_first_order_where_flat_and_the_second_where_curved() {
    let flat = slanted(true).render();
    let of = |scene: &Rendered, shape| {
        let found = run(scene, params(Method::Dense, shape));
        rms(&errors(&found.disparity_px, &scene.truth_px, 25))
    };
    let (first, auto) = (of(&flat, ShapeFunction::First), of(&flat, ShapeFunction::Auto));
    assert!(auto < 1.35 * first, "flat: first {first}, auto {auto}");
    // A cylinder: 0.5 x 0.006 x 4^2 px of bow within half a window.
    let bow = |x: f64, _: f64| 30.0 - 0.003 * (x - 110.0).powi(2);
    let curved = Scene::new(200, 110, 10, vec![Layer::everywhere(bow)]).render();
    let [first, second, auto] =
        [ShapeFunction::First, ShapeFunction::Second, ShapeFunction::Auto].map(|s| of(&curved, s));
    assert!(second < first && auto < 1.3 * second, "curved: {first} {second} {auto}");
}

#[test]
fn result_does_not_depend_on_threads_and_hardly_on_the_level() {
    let scene = Scene::benchmark(170, 140, 7, 20.0).render();
    let with = |threads: usize, level: Level| {
        let mut params = params(Method::Dense, ShapeFunction::Auto);
        params.advanced.threads = Some(threads);
        params.advanced.level_max = Some(level);
        run(&scene, params)
    };
    let bits = |m: &Image<f32>| m.as_slice().iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    let one = with(1, Level::best());
    let three = with(3, Level::best());
    assert_eq!(bits(&one.disparity_px), bits(&three.disparity_px));
    assert_eq!(bits(&one.zncc), bits(&three.zncc));
    for level in Level::available() {
        let other = with(2, level);
        let pairs = one.disparity_px.as_slice().iter().zip(other.disparity_px.as_slice());
        let (mut alike, mut lone) = (0, 0);
        for (a, b) in pairs {
            match (a.is_nan(), b.is_nan()) {
                (true, true) => {}
                (false, false) if (a - b).abs() < LEVEL_TOLERANCE_PX => alike += 1,
                _ => lone += 1,
            }
        }
        // A threshold may fall between two roundings on single pixels.
        assert!(lone * 2000 < alike, "{level}: {lone} of {alike} differ");
    }
}

/// Disc before a plane: points belong to one of the two surfaces.
#[test]
fn steps_are_sharp_and_nothing_floats_between_the_surfaces() {
    let disc = |x: f64, y: f64| (x - 90.0).powi(2) + (y - 70.0).powi(2) < 30f64.powi(2);
    let far = Layer::everywhere(|x, _| 8.0 + 0.03 * x);
    let near = Layer::patch(|_, y| 30.0 + 0.02 * y, disc);
    let scene = Scene::new(190, 140, 10, vec![far, near]).render();
    let found = run(&scene, params(Method::Dense, ShapeFunction::Auto));
    let (mut floating, mut wrong_side, mut good) = (0, 0, 0);
    for y in 12..128 {
        for x in 50..178 {
            let d = found.disparity_px.row(y)[x];
            if d.is_nan() {
                continue;
            }
            let (far, near) = (8.0 + 0.03 * x as f32, 30.0 + 0.02 * y as f32);
            let own = scene.truth_px.row(y)[x];
            let radius = (x as f32 - 90.0).hypot(y as f32 - 70.0);
            if (d - far).abs() > 0.3 && (d - near).abs() > 0.3 {
                floating += 1;
            } else if (d - own).abs() > 0.3 {
                wrong_side += usize::from((radius - 30.0).abs() > 2.5);
            } else {
                good += 1;
            }
        }
    }
    assert!(good > 12_500 && floating <= 28 && wrong_side == 0, "{good} {floating} {wrong_side}");
}

#[test]
fn coarse_search_finds_what_brute_force_finds() {
    let range = DisparityRange { min_px: -60, max_px: 110 };
    for frames in [1, 2, 3, 5, 10, 16] {
        // A rod and a wire, a bar and a dot between the seed rows, on four depths.
        let rod = |x: f64, y: f64| (x - 110.0).abs() < 2.8 || (x - y - 60.0).abs() < 1.6;
        let bar = |x: f64, y: f64| (y - 33.0).abs() < 2.2 && x > 140.0;
        let spot = |x: f64, y: f64| (x - 170.0).powi(2) + (y - 81.0).powi(2) < 16.0;
        let layers = vec![
            Layer::everywhere(|x, _| 3.0 + 0.04 * x),
            Layer::patch(|_, _| 61.2, rod),
            Layer::patch(|_, _| 31.7, bar),
            Layer::patch(|_, _| 88.4, spot),
        ];
        let mut scene = Scene::new(256, 120, frames, layers);
        scene.peak_dn = 40.0;
        let scene = scene.render();
        scene.with_stack(|stack| {
            let (cheap, all) = searched(stack, range);
            let good = |map: &CoarseMap| {
                let triples = map.disparity.as_slice().iter().zip(scene.truth_px.as_slice());
                let near = |(d, t): (&i16, &f32)| *d != INVALID && (f32::from(*d) - t).abs() < 1.5;
                let seen = scene.visible.as_slice().iter();
                triples.zip(seen).filter(|(p, v)| **v != 0 && near(*p)).count() as f64
            };
            assert!(
                good(&cheap) > 0.995 * good(&all),
                "{frames}: {} of {}",
                good(&cheap),
                good(&all)
            );
        });
    }
}

/// On the thin objects alone, which are too few pixels to count in a whole image: a rod of 3 mm at 1 m
/// (1.3 mm a pixel), a wire of two pixels aslant, a bar between two seed rows, in front of weak dots.
#[test]
fn thin_objects_are_found_nearly_as_often_as_by_brute_force() {
    let range = DisparityRange { min_px: -60, max_px: 110 };
    let rod = |x: f64, _: f64| (x - 120.0).abs() < 1.15;
    let wire = |x: f64, y: f64| (x - y - 80.0).abs() < 1.4;
    let bar = |x: f64, y: f64| (y - 46.0).abs() < 1.5 && x > 150.0;
    for frames in [1, 2, 3, 4, 5, 10, 16] {
        let layers = vec![
            Layer::everywhere(|x, _| 3.0 + 0.04 * x),
            Layer::patch(|_, _| 61.2, rod),
            Layer::patch(|_, _| 47.0, wire),
            Layer::patch(|_, _| 31.7, bar),
        ];
        let mut scene = Scene::new(256, 120, frames, layers);
        scene.peak_dn = 30.0;
        let scene = scene.render();
        scene.with_stack(|stack| {
            let (cheap, all) = searched(stack, range);
            let good = |map: &CoarseMap| {
                let on = |x: usize, y: usize| {
                    let (x, y) = (x as f64, y as f64);
                    rod(x, y) || wire(x, y) || bar(x, y)
                };
                let pixels = (0..120).flat_map(|y| (0..256).map(move |x| (x, y)));
                let near = |&(x, y): &(usize, usize)| {
                    let d = map.disparity.row(y)[x];
                    d != INVALID && (f32::from(d) - scene.truth_px.row(y)[x]).abs() < 1.5
                };
                let seen = |&(x, y): &(usize, usize)| on(x, y) && scene.visible.row(y)[x] != 0;
                pixels.filter(seen).filter(near).count()
            };
            let (cheap, all) = (good(&cheap), good(&all));
            println!("{frames} frames: {cheap} of the {all} pixels that brute force finds");
            assert!(cheap as f64 >= 0.95 * all as f64, "{frames} frames: {cheap} of {all}");
        });
    }
}

#[test]
fn any_size_window_and_number_of_frames_gives_a_map_of_the_size() {
    let mut random = Random::new(9);
    for (width, height) in [(1, 1), (5, 3), (31, 17), (33, 40), (97, 9), (130, 66)] {
        for (frames, radius) in [(1, 2), (2, 8), (3, 4), (5, 7), (16, 3)] {
            let stack: Vec<Image<Sample>> = (0..2 * frames)
                .map(|_| Image::new(width, height, 0).map(|_: Sample| random.bits() as Sample))
                .collect();
            let images: Vec<&Image<Sample>> = stack.iter().collect();
            let mut params = params(Method::Dense, ShapeFunction::Auto);
            params.advanced.subset_radius = radius;
            let mut matcher = Matcher::new(params).unwrap();
            let stack = StereoStack::new(&images[..frames], &images[frames..]);
            let found = matcher.match_stack(&stack).unwrap();
            assert_eq!(found.disparity_px.width(), width);
            assert_eq!(found.zncc.height(), height);
        }
    }
}

#[test]
fn black_saturated_and_unequal_input_gives_nothing_or_an_error() {
    for value in [0, 16_320] {
        let image = Image::new(90, 60, value);
        let images = [&image; 10];
        let mut matcher = Matcher::new(params(Method::Dense, ShapeFunction::Auto)).unwrap();
        let found = matcher.match_stack(&StereoStack::new(&images, &images)).unwrap();
        assert!(found.disparity_px.as_slice().iter().all(|d| d.is_nan()));
        assert!(found.zncc.as_slice().iter().all(|z| z.is_nan()));
        assert!(matcher.match_stack(&StereoStack::new(&images, &images[1..])).is_err());
        assert!(matcher.match_stack(&StereoStack::new(&[], &[])).is_err());
    }
}

#[test]
fn brightness_is_the_mean_of_all_left_images() {
    for frames in [1, 4, 10] {
        let scene = Scene::benchmark(150, 90, frames, 20.0).render();
        let found = run(&scene, params(Method::Dense, ShapeFunction::First));
        let brightness = found.brightness.unwrap();
        for (i, &got) in brightness.as_slice().iter().enumerate() {
            let sum: f64 = scene.left.iter().map(|image| f64::from(image.as_slice()[i])).sum();
            let want = (sum / (64.0 * frames as f64)).clamp(0.0, 255.0);
            assert!((f64::from(got) - want).abs() < 0.6, "{frames} {i}: {got}, {want}");
        }
    }
}

#[test]
fn masked_pixels_are_invalid() {
    let scene = slanted(true).render();
    let mut left_mask = Image::new(200, 110, 1u8);
    left_mask.row_mut(50).fill(0);
    let mut matcher = Matcher::new(params(Method::Dense, ShapeFunction::Second)).unwrap();
    let found = scene.with_stack(|stack| {
        matcher.match_stack(&StereoStack { left_mask: Some(&left_mask), ..*stack }).unwrap()
    });
    assert!(found.disparity_px.row(50).iter().all(|d| d.is_nan()));
    assert!(found.disparity_px.row(52)[60..150].iter().all(|d| !d.is_nan()));
}

/// Ridges 8 px long: a window of 9 x 9 pixels keeps two thirds of their height, the fine one all but a
/// tenth; a plane beside them is measured by the usual window, with its noise.
#[test]
fn ridges_narrower_than_the_window_keep_their_height() {
    let (width, height) = (260, 120);
    let ridges = |x: f64| 0.4 * (x * std::f64::consts::TAU / 8.0).sin();
    let shape = move |x: f64, _: f64| 12.0 + if x > 130.0 { ridges(x) } else { 0.0 };
    let truth = Scene::new(width, height, 10, vec![Layer::everywhere(shape)]).render();
    let mut params = Params::new(DisparityRange { min_px: -10, max_px: 40 });
    (params.method, params.shape) = (Method::Dense, ShapeFunction::Auto);
    let map = truth
        .with_stack(|stack| Matcher::new(params).unwrap().match_stack(stack).unwrap().disparity_px);
    let (mut kept, mut whole, mut squares, mut flat) = (0.0, 0.0, 0.0, 0);
    for y in 10..height - 10 {
        for x in 20..width - 20 {
            let d = f64::from(map.row(y)[x]);
            if x > 140 && !d.is_nan() {
                let true_px = ridges(x as f64);
                (kept, whole) = (kept + (d - 12.0) * true_px, whole + true_px * true_px);
            } else if x < 110 {
                (squares, flat) = (squares + (d - 12.0).powi(2), flat + 1);
            }
        }
    }
    let (amplitude, noise) = (kept / whole, (squares / f64::from(flat)).sqrt());
    println!("{amplitude:.3} of the height kept; noise on the plane {noise:.4} px");
    assert!((0.88..1.05).contains(&amplitude), "{amplitude}");
    assert!(noise < 0.006, "{noise}");
}
