//! Every stage against its slow, obvious reference.

mod reference;
mod synthetic;

use reference::{Volume, census, check, icgn, parabola, wta};
use stspp_matcher::{
    DisparityRange, Image, Interpolation, Level, Method, Params, Sample, ShapeFunction,
    StereoStack,
    bspline::{self, LANES},
    census::{CensusKernel, CensusRow, PaddedStack, Side, outside_bit},
    check as fast_check,
    icgn::{
        Refiner,
        guess::{CoarseMap, Guess, Guesser},
        prepare::Prepared,
        shape::Shape,
        window::Window,
    },
    regions::Regions,
    search,
};
use synthetic::{Layer, Random, Rendered, Scene};

fn small_scene(frames: usize) -> Rendered {
    let layers = vec![
        Layer {
            disparity: Box::new(|x, _| 9.0 + 0.05 * x),
            support: Box::new(|x, y| (x - 30.0).hypot(y - 12.0) < 8.0),
        },
        Layer::everywhere(|x, y| 1.3 + 0.04 * x - 0.02 * y),
    ];
    Scene::new(61, 25, frames, layers).render()
}

/// A mask with a bite out of one side and single holes.
fn mask(seed: u64) -> Image<u8> {
    let mut random = Random(seed);
    let mut mask = Image::new(61, 25, 1u8);
    for y in 0..25 {
        for x in 0..61 {
            if x < 2 + y / 4 || random.uniform() < 0.01 {
                mask.set(x, y, 0);
            }
        }
    }
    mask
}

fn volume(images: &[Image<Sample>], mask: Option<&Image<u8>>) -> Volume {
    let keep = |x: usize, y: usize| mask.is_none_or(|m| m.row(y)[x] != 0);
    images
        .iter()
        .map(|i| {
            (0..i.height())
                .map(|y| {
                    let row = i.row(y).iter().enumerate();
                    row.map(|(x, &v)| if keep(x, y) { v as f64 } else { f64::NAN }).collect()
                })
                .collect()
        })
        .collect()
}

fn padded(side: Side, images: &[Image<Sample>], mask: Option<&Image<u8>>) -> PaddedStack {
    let mut stack = PaddedStack::default();
    stack.fill(side, &images.iter().collect::<Vec<_>>(), mask);
    stack
}

/// Bits of samples outside: none in rows outside the image, elsewhere those documented.
fn outside(side: Side) -> impl Fn(usize, i64, i64) -> bool {
    move |t, x, y| (0..25).contains(&y) && outside_bit(side, t, x as isize, y as usize)
}

#[test]
fn census_bits_follow_equations_1_to_3() {
    for (frames, radius) in [(1, 2), (3, 2), (2, 4)] {
        let rendered = small_scene(frames);
        let mask = mask(3);
        let expected = volume(&rendered.left, Some(&mask));
        let stack = padded(Side::Left, &rendered.left, Some(&mask));
        for level in Level::available() {
            let mut row = CensusRow::default();
            for y in [0, 1, 12, 24] {
                row.fill(&stack, y, radius, CensusKernel::new(level));
                for x in 0..61 {
                    let bits = census::census(
                        &expected,
                        (x as i64, y as i64),
                        radius as i64,
                        &outside(Side::Left),
                    );
                    assert_eq!(row.invalid()[x] == 0, bits.is_some());
                    for (k, bit) in bits.into_iter().flatten().enumerate() {
                        assert_eq!(row.bit(x, k), bit, "{level} ({x}, {y}) bit {k}");
                    }
                }
            }
        }
    }
}

/// The whole search, candidate by candidate.
#[allow(clippy::needless_range_loop)]
fn reference_search(left: &Volume, right: &Volume, params: &Params) -> Vec<Vec<f64>> {
    let (h, w) = (left[0].len(), left[0][0].len());
    let a = &params.advanced;
    let (dmin, dmax) = (params.disparity.min_px as i64, params.disparity.max_px as i64);
    let descriptors = |v: &Volume, side: Side, y: usize, radius: usize| {
        let outside = outside(side);
        let at = |x: i64| census::census(v, (x, y as i64), radius as i64, &outside);
        (0..w as i64).map(at).collect::<Vec<_>>()
    };
    let mut out = vec![vec![f64::NAN; w]; h];
    for y in 0..h {
        for x in 0..w {
            for (attempt, radius) in [a.census_radius, a.retry_radius].into_iter().enumerate() {
                let l = descriptors(left, Side::Left, y, radius);
                let r = descriptors(right, Side::Right, y, radius);
                let rows = (y + radius + 1).min(h) - y.saturating_sub(radius);
                let bits = (rows * (2 * radius + 1) * left.len()) as f64;
                let cost = |x: i64, d: i64| {
                    let l = l.get(usize::try_from(x).ok()?)?.as_ref()?;
                    census::cost(l, r.get(usize::try_from(x - d).ok()?)?.as_ref(), bits)
                };
                let costs: Vec<_> = (dmin..=dmax).map(|d| (d, cost(x as i64, d))).collect();
                let Some((d, least)) = wta::winner(&costs) else { break };
                let at = |d: i64| if d < dmin || d > dmax { None } else { cost(x as i64, d) };
                let subpixel = parabola::subpixel(d, at(d - 1), least, at(d + 1));
                let margin =
                    (a.uniqueness as f64).max(stspp_matcher::wta::MARGIN_MIN as f64 / bits);
                let unique =
                    wta::runner_up(&costs, d, 2).is_none_or(|c| c - least >= margin - 1e-9);
                // The right pixel's own winner; of equal ones the lowest left column.
                let column = x as i64 - d;
                let back = (dmin..=dmax)
                    .filter_map(|d| Some((cost(column + d, d)?, d)))
                    .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
                    .expect("the left pixel is one");
                let consistent = (back.1 as f64 - subpixel).abs() <= a.left_right_px as f64;
                let floor = [a.retry_similarity, stspp_matcher::retry::SIMILARITY_MIN][attempt];
                let reliable = 1.0 - least > floor as f64;
                if unique && consistent && reliable {
                    out[y][x] = subpixel;
                    break;
                }
            }
        }
    }
    out
}

#[test]
fn search_finds_what_brute_force_in_f64_finds() {
    let mut params = Params::new(DisparityRange { min_px: -3, max_px: 16 });
    params.advanced.uniqueness = 0.013;
    for frames in [1, 3] {
        let rendered = small_scene(frames);
        let (left_mask, right_mask) = (mask(5), mask(6));
        let expected = reference_search(
            &volume(&rendered.left, Some(&left_mask)),
            &volume(&rendered.right, Some(&right_mask)),
            &params,
        );
        let left = padded(Side::Left, &rendered.left, Some(&left_mask));
        let right = padded(Side::Right, &rendered.right, Some(&right_mask));
        for level in Level::available() {
            let found = search::search(&left, &right, &params, level).disparity_px;
            let mut matched = 0;
            for (y, row) in expected.iter().enumerate() {
                for (x, &e) in row.iter().enumerate() {
                    let f = found.row(y)[x] as f64;
                    let same = (e.is_nan() && f.is_nan()) || (e - f).abs() < 1e-5;
                    assert!(same, "{level} N={frames} ({x}, {y}): {f}, expected {e}");
                    matched += e.is_finite() as usize;
                }
            }
            assert!(matched > 300, "{matched} points matched");
        }
    }
}

#[test]
fn checks_follow_their_definitions() {
    let mut random = Random(11);
    let map: Vec<Vec<f64>> = (0..19)
        .map(|y| {
            (0..23)
                .map(|x| match random.uniform() {
                    u if u < 0.15 => f64::NAN,
                    u if u < 0.25 => (40.0 * random.uniform()).floor(),
                    _ => (0.25 * x as f64 + 0.5 * y as f64) + if x > 11 { 9.0 } else { 0.0 },
                })
                .collect()
        })
        .collect();
    let values = map.iter().flatten().map(|&v| v as f32).collect();
    let image = Image::from_vec(23, 19, values).unwrap();
    let same = |image: &Image<f32>, expected: &[Vec<f64>]| {
        let expected = expected.iter().flatten();
        image
            .as_slice()
            .iter()
            .zip(expected)
            .all(|(&a, &b)| a as f64 == b || (a.is_nan() && b.is_nan()))
    };
    let mut out = image.clone();
    fast_check::median_3x3(&image, &mut out);
    assert!(same(&out, &check::median_3x3(&map, 1.0)));
    for least in [1, 2, 5, 30, 1000] {
        let mut out = image.clone();
        Regions::default().remove(&mut out, least);
        assert!(same(&out, &check::remove_small_regions(&map, least)), "{least}");
    }
}

#[test]
fn splines_are_the_interpolating_b_splines() {
    let mut random = Random(2);
    for (kind, degree) in [(Interpolation::Cubic, 3), (Interpolation::Quintic, 5)] {
        for len in [1usize, 2, 5, 33] {
            let samples: Vec<f64> = (0..len).map(|_| 100.0 * random.uniform()).collect();
            let spline = reference::bspline::Spline::new(&samples, degree);
            let mut row: Vec<f32> = samples.iter().flat_map(|&v| [v as f32; LANES]).collect();
            bspline::prefilter(&mut row, kind);
            let weights = kind.polynomials();
            for step in 0..(len - 1) * 8 + 1 {
                let x = step as f64 / 8.0;
                let (whole, fraction) = (x.floor(), (x - x.floor()) as f32);
                let value: f32 = (0..kind.taps())
                    .map(|tap| {
                        let weight = (0..6).rev().fold(0.0, |w, p| w * fraction + weights[p][tap]);
                        let at = whole as isize + tap as isize + 1 - kind.taps() as isize / 2;
                        weight * row[bspline::mirrored(at, len) * LANES + 3]
                    })
                    .sum();
                let expected = spline.value(x);
                assert!((value as f64 - expected).abs() < 1e-3, "{kind:?} {len} {x}");
            }
        }
    }
}

fn points(radius: i32) -> Vec<(f64, f64)> {
    (-radius..=radius).flat_map(|y| (-radius..=radius).map(move |x| (x as f64, y as f64))).collect()
}

fn in_dn(mut volume: Volume) -> Volume {
    volume.iter_mut().flatten().flatten().for_each(|v| *v /= 64.0);
    volume
}

#[test]
fn icgn_converges_to_the_reference_solution() {
    let field = |x: f64, y: f64| {
        2.3 + 0.06 * (x - 24.0) - 0.04 * y + 0.002 * (x - 24.0) * (x - 24.0) + 0.001 * x * y
    };
    let rendered = Scene::new(49, 21, 3, vec![Layer::everywhere(field)]).render();
    let (left, right) = (in_dn(volume(&rendered.left, None)), in_dn(volume(&rendered.right, None)));
    for (kind, degree) in [(Interpolation::Cubic, 3), (Interpolation::Quintic, 5)] {
        let mut params = Params::new(DisparityRange { min_px: 0, max_px: 9 });
        params.advanced.convergence_px = 2e-5;
        params.advanced.iterations_max = 60;
        let mut prepared = Prepared::default();
        rendered.with_stack(|stack| prepared.fill(stack, kind));
        for order in [1, 2] {
            for level in Level::available() {
                let refiner = Refiner::new(&prepared, &params, order == 2, level);
                let window = Window::full(4, &prepared);
                for (x, y) in [(24, 10), (31, 8), (17, 14)] {
                    let mut start = [0.0; 6];
                    start[0] = -field(x as f64, y as f64) + 0.2;
                    let got = refiner.refine(&window, x, y, Shape(start)).expect("converges");
                    let at = (x as i64, y as i64);
                    let start = icgn::T::from_row_slice(&start);
                    let expected =
                        icgn::solve(&left, &right, at, &points(4), start, order, degree).unwrap();
                    let difference = (got.shape.0[0] - expected.t[0]).abs();
                    assert!(difference < 3e-4, "{kind:?} {order} {level}: {difference}");
                    assert!((got.zncc - expected.zncc).abs() < 1e-4);
                    let by_definition = stspp_matcher::zncc::from_znssd(expected.znssd);
                    assert!((by_definition - expected.zncc).abs() < 1e-12);
                    for k in 1..6 {
                        assert!((got.shape.0[k] - expected.t[k]).abs() < 3e-4, "parameter {k}");
                    }
                }
            }
        }
    }
}

#[test]
fn initial_guess_is_the_least_squares_surface() {
    let rendered = small_scene(1);
    let mut prepared = Prepared::default();
    rendered.with_stack(|stack| prepared.fill(stack, Interpolation::Quintic));
    let mut random = Random(8);
    let mut map = Image::new(61, 25, 0f32);
    for y in 0..25 {
        for x in 0..61 {
            // A step that subsets near it must not cross.
            let step = if x >= 40 { 7.0 } else { 0.0 };
            map.set(x, y, (3.0 + 0.1 * x as f64 + 0.2 * random.normal() + step) as f32);
        }
    }
    let mut coarse = CoarseMap::default();
    coarse.fill(&map);
    let mut part = Window::empty();
    for order in [1usize, 2] {
        let guesser =
            Guesser::new(4, if order == 1 { 3 } else { 6 }, 1.5, &prepared, Level::best());
        for (x, full) in [(20i32, true), (38, false), (41, false)] {
            let guess = guesser.guess(&coarse, &prepared, x as usize, 12, &mut part);
            let (shape, is_full) = match guess {
                Guess::Full(shape) => (shape, true),
                Guess::Part(shape) => (shape, false),
                Guess::None => panic!("no surface"),
            };
            assert_eq!(is_full, full);
            let same_side: Vec<_> = points(4)
                .into_iter()
                .filter(|(dx, _)| (x as f64 + dx >= 40.0) == (x >= 40))
                .map(|(dx, dy)| {
                    let (px, py) = ((x as f64 + dx) as usize, (12.0 + dy) as usize);
                    ((dx, dy), map.row(py)[px] as f64)
                })
                .collect();
            assert!(full || part.count() == same_side.len());
            let expected = icgn::initial_guess(&same_side, order);
            for k in 0..6 {
                assert!((shape.0[k] - expected[k]).abs() < 1e-4, "x {x} order {order} {k}");
            }
        }
    }
}

#[test]
fn composition_agrees_with_the_reference() {
    let t = Shape([-2.3, 0.06, -0.03, 0.002, 0.001, -0.001]);
    let step = Shape([0.01, 0.002, -0.001, 1e-4, -2e-4, 1e-4]);
    let got = t.compose_inverse(&step).unwrap();
    let vector = |s: &Shape| icgn::T::from_row_slice(&s.0);
    let expected = icgn::compose_inverse(&vector(&t), &vector(&step), &points(1), 2);
    for k in 0..6 {
        assert!((got.0[k] - expected[k]).abs() < 2e-5, "{k}: {got:?} {expected}");
    }
}

#[test]
fn masked_pixels_never_matter() {
    // Two stacks that differ only where a mask hides it give the same result. Eight frames are as many as
    // all stages take part with.
    [3, 8].into_iter().for_each(masked_pixels_of);
}

fn masked_pixels_of(frames: usize) {
    let rendered = small_scene(frames);
    let (left_mask, right_mask) = (mask(21), mask(22));
    let spoil = |images: &[Image<Sample>], mask: &Image<u8>| -> Vec<Image<Sample>> {
        let mut random = Random(5);
        let mut images = images.to_vec();
        for image in &mut images {
            for (v, &m) in image.as_mut_slice().iter_mut().zip(mask.as_slice()) {
                if m == 0 {
                    *v = random.bits() as i16;
                }
            }
        }
        images
    };
    let run = |left: &[Image<Sample>], right: &[Image<Sample>]| {
        let (left, right): (Vec<_>, Vec<_>) = (left.iter().collect(), right.iter().collect());
        let stack = StereoStack {
            left_mask: Some(&left_mask),
            right_mask: Some(&right_mask),
            ..StereoStack::new(&left, &right)
        };
        let mut params = Params::new(DisparityRange { min_px: -3, max_px: 16 });
        (params.method, params.shape) = (Method::IcGn, ShapeFunction::Second);
        stspp_matcher::Matcher::new(params).unwrap().match_stack(&stack).unwrap()
    };
    let a = run(&rendered.left, &rendered.right);
    let b = run(&spoil(&rendered.left, &left_mask), &spoil(&rendered.right, &right_mask));
    let bits = |i: &Image<f32>| i.as_slice().iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    assert!(bits(&a.disparity_px) == bits(&b.disparity_px) && bits(&a.zncc) == bits(&b.zncc));
    assert!(a.disparity_px.as_slice().iter().filter(|d| d.is_finite()).count() > 500);
    for (d, &m) in a.disparity_px.as_slice().iter().zip(left_mask.as_slice()) {
        assert!(m != 0 || d.is_nan());
    }
}
