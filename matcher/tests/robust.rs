//! Inputs at the edge of what is possible: tiny and odd images, black, saturated, masked out, wrong
//! numbers of frames, impossible parameters. Errors or invalid maps, never a panic.

mod synthetic;

use proptest::prelude::*;
use stspp_matcher::{
    DisparityRange, Error, Image, Level, Matched, Matcher, Method, Params, Sample, ShapeFunction,
    StereoStack,
};
use synthetic::{Layer, Random, Scene};

fn params(method: Method, min_px: i32, max_px: i32) -> Params {
    let mut params = Params::new(DisparityRange { min_px, max_px });
    params.method = method;
    params
}

fn constant(width: usize, height: usize, frames: usize, value: Sample) -> Vec<Image<Sample>> {
    vec![Image::new(width, height, value); frames]
}

fn noise(width: usize, height: usize, frames: usize, seed: u64) -> Vec<Image<Sample>> {
    let mut random = Random(seed);
    let mut image = || {
        let data = (0..width * height).map(|_| (random.bits() >> 49) as Sample).collect();
        Image::from_vec(width, height, data).unwrap()
    };
    (0..frames).map(|_| image()).collect()
}

fn run(left: &[Image<Sample>], right: &[Image<Sample>], params: Params) -> Result<Matched, Error> {
    let (left, right): (Vec<_>, Vec<_>) = (left.iter().collect(), right.iter().collect());
    Matcher::new(params)?.match_stack(&StereoStack::new(&left, &right))
}

fn valid(matched: &Matched) -> usize {
    matched.disparity_px.as_slice().iter().filter(|d| d.is_finite()).count()
}

const METHODS: [Method; 3] = [Method::Parabola, Method::IcGn, Method::Dense];

#[test]
fn images_without_texture_have_no_disparity() {
    for method in METHODS {
        for value in [0, 255 * 64, Sample::MAX, Sample::MIN] {
            let images = constant(70, 40, 3, value);
            let matched = run(&images, &images, params(method, -20, 20)).unwrap();
            assert_eq!(valid(&matched), 0, "{method:?}, all {value}");
        }
    }
}

#[test]
fn unrelated_images_have_hardly_any_disparity() {
    // Chance alone: no pixel of the right image belongs to the left one.
    for frames in [3, 10] {
        let (left, right) = (noise(120, 90, frames, 1), noise(120, 90, frames, 2));
        for method in METHODS {
            let matched = run(&left, &right, params(method, -60, 60)).unwrap();
            assert!(valid(&matched) * 1000 <= 120 * 90, "{method:?}: {}", valid(&matched));
        }
    }
}

#[test]
fn empty_masks_leave_nothing() {
    let rendered = Scene::new(80, 40, 3, vec![Layer::everywhere(|_, _| 4.0)]).render();
    let nothing = Image::new(80, 40, 0u8);
    for method in METHODS {
        for (left_mask, right_mask) in [(Some(&nothing), None), (None, Some(&nothing))] {
            rendered.with_stack(|stack| {
                let stack = StereoStack { left_mask, right_mask, ..*stack };
                let matched =
                    Matcher::new(params(method, -20, 20)).unwrap().match_stack(&stack).unwrap();
                assert_eq!(valid(&matched), 0);
            });
        }
    }
}

#[test]
fn wrong_stacks_are_errors() {
    let images = constant(20, 10, 17, 5);
    let p = || params(Method::IcGn, 0, 9);
    assert_eq!(run(&[], &[], p()).unwrap_err(), Error::FrameCount { frames: 0 });
    assert_eq!(run(&images, &images, p()).unwrap_err(), Error::FrameCount { frames: 17 });
    assert!(matches!(run(&images[..3], &images[..2], p()), Err(Error::Shape { .. })));
    let other = constant(21, 10, 2, 5);
    assert!(matches!(run(&images[..2], &other, p()), Err(Error::Shape { .. })));
    let none = constant(0, 0, 2, 5);
    assert!(matches!(run(&none, &none, p()), Err(Error::Shape { .. })));
    let wide = constant(65_536, 1, 1, 5);
    assert!(matches!(run(&wide, &wide, p()), Err(Error::Shape { .. })));
}

#[test]
fn wrong_parameters_are_errors_that_name_the_field() {
    type Spoil = fn(&mut Params);
    let cases: [(&str, Spoil); 9] = [
        ("disparity.max_px", |p| p.disparity = DisparityRange { min_px: 5, max_px: 4 }),
        ("disparity.min_px", |p| p.disparity.min_px = i32::MIN),
        ("disparity.max_px", |p| p.disparity.max_px = i32::MAX),
        ("zncc_min", |p| p.zncc_min = f32::NAN),
        ("advanced.census_radius", |p| p.advanced.census_radius = 9),
        ("advanced.retry_radius", |p| p.advanced.retry_radius = 1),
        ("advanced.subset_radius", |p| p.advanced.subset_radius = 8),
        ("advanced.iterations_max", |p| p.advanced.iterations_max = 0),
        ("advanced.threads", |p| p.advanced.threads = Some(0)),
    ];
    for (field, spoil) in cases {
        let mut p = params(Method::IcGn, -9, 9);
        spoil(&mut p);
        match Matcher::new(p) {
            Err(Error::Parameter { name, .. }) => assert_eq!(name, field),
            other => panic!("{field}: {other:?}"),
        }
    }
}

#[test]
fn one_candidate_and_candidates_outside_the_image() {
    let images = noise(40, 20, 3, 9);
    for method in METHODS {
        // Everything is at disparity 0, the only candidate: nothing competes with it.
        // The dense method leaves a rim out.
        let least = if method == Method::Dense { 600 } else { 700 };
        let matched = run(&images, &images, params(method, 0, 0)).unwrap();
        assert!(valid(&matched) > least, "{method:?}: {}", valid(&matched));
        let matched = run(&images, &images, params(method, 41, 900)).unwrap();
        assert_eq!(valid(&matched), 0);
        let matched = run(&images, &images, params(method, -16_384, 16_384)).unwrap();
        assert!(valid(&matched) > least, "{method:?}: {}", valid(&matched));
    }
}

#[test]
fn a_matcher_takes_stacks_of_changing_size() {
    let mut matcher = Matcher::new(params(Method::IcGn, -5, 15)).unwrap();
    for (width, height, frames) in [(90, 30, 3), (40, 50, 10), (7, 3, 1), (90, 30, 3)] {
        let scene = Scene::new(width, height, frames, vec![Layer::everywhere(|_, _| 3.4)]);
        let rendered = scene.render();
        let again = rendered.with_stack(|s| matcher.match_stack(s)).unwrap();
        let fresh = run(&rendered.left, &rendered.right, params(Method::IcGn, -5, 15)).unwrap();
        let bits = |m: &Matched| -> Vec<u32> {
            m.disparity_px.as_slice().iter().map(|v| v.to_bits()).collect()
        };
        assert!(bits(&again) == bits(&fresh), "{width}x{height}x{frames}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_small_stack_is_matched_without_panic(
        width in 1usize..45,
        height in 1usize..24,
        frames in 1usize..=16,
        min_px in -60i32..40,
        span in 0i32..70,
        radii in (1usize..=8, 0usize..=7, 2usize..=7),
        kind in 0usize..4,
        second in any::<bool>(),
        method in 0usize..3,
        level in 0usize..4,
        seed in any::<u64>(),
    ) {
        let mut p = params(METHODS[method], min_px, min_px + span);
        p.shape = if second { ShapeFunction::Second } else { ShapeFunction::First };
        p.advanced.census_radius = radii.0;
        p.advanced.retry_radius = (radii.0 + radii.1).min(8);
        p.advanced.subset_radius = radii.2;
        p.advanced.level_max = Some(Level::ALL[level]);
        p.advanced.region_min = (seed % 20) as usize;
        let (left, right) = match kind {
            0 => (noise(width, height, frames, seed), noise(width, height, frames, seed ^ 1)),
            1 => { let i = noise(width, height, frames, seed); (i.clone(), i) }
            2 => { let i = constant(width, height, frames, seed as Sample); (i.clone(), i) }
            _ => {
                let mut scene = Scene::new(width, height, frames,
                    vec![Layer::everywhere(|x, y| 3.0 + 0.2 * x - 0.1 * y)]);
                scene.seed = seed % 1000;
                let r = scene.render();
                (r.left, r.right)
            }
        };
        let mut random = Random(seed);
        let mut mask = || Image::new(width, height, 0u8).map(|_| (random.uniform() < 0.9) as u8);
        let (left_mask, right_mask) = (mask(), mask());
        let (l, r): (Vec<_>, Vec<_>) = (left.iter().collect(), right.iter().collect());
        let stack = StereoStack {
            left_mask: (seed % 3 == 0).then_some(&left_mask),
            right_mask: (seed % 5 < 2).then_some(&right_mask),
            ..StereoStack::new(&l, &r)
        };
        let matched = Matcher::new(p).unwrap().match_stack(&stack).unwrap();
        prop_assert_eq!(matched.disparity_px.width(), width);
        for (d, z) in matched.disparity_px.as_slice().iter().zip(matched.zncc.as_slice()) {
            if METHODS[method] != Method::Parabola {
                prop_assert_eq!(d.is_nan(), z.is_nan());
            }
            // The sub-pixel stages move a match by little.
            prop_assert!(d.is_nan() || (*d > min_px as f32 - 4.0 && *d < (min_px + span) as f32 + 4.0));
            prop_assert!(z.is_nan() || (*z >= 0.8 && *z <= 1.001));
        }
    }
}
