//! Pixels at depth steps against the truth of a synthetic scene: a disc before a plane, whose coarse
//! map is wrong in the ways that windowed searches are.

use stspp_matcher::{
    DisparityRange, Image, Level, Matcher, Method, Params, ShapeFunction, StereoStack,
    dense::{DenseMaps, mark_steps, settle::Settle},
    step::{FRAMES_MIN, StepJudge, Verdict},
    synthetic::{Layer, Rendered, Scene},
};

const CENTRE: (f64, f64) = (110.0, 60.0);
const RADIUS: f64 = 35.0;
const NEAR_PX: f32 = 30.4;
const FAR_PX: f32 = 8.3;

fn scene(frames: usize) -> Rendered {
    let disc = |x: f64, y: f64| (x - CENTRE.0).hypot(y - CENTRE.1) < RADIUS;
    let layers =
        vec![Layer::everywhere(|_, _| FAR_PX as f64), Layer::patch(|_, _| NEAR_PX as f64, disc)];
    Scene::new(220, 120, frames, layers).render()
}

/// The map of a disc `grown` pixels too large.
fn wrong(truth: &Rendered, grown: f64) -> Image<f32> {
    let (width, height) = (truth.truth_px.width(), truth.truth_px.height());
    let mut map = Image::new(width, height, f32::NAN);
    for y in 0..height {
        for x in 0..width {
            let rho = (x as f64 - CENTRE.0).hypot(y as f64 - CENTRE.1);
            let seen = truth.visible.row(y)[x] != 0;
            let value = if rho < RADIUS + grown {
                NEAR_PX
            } else if seen {
                FAR_PX
            } else {
                f32::NAN
            };
            map.set(x, y, value);
        }
    }
    map
}

/// Judged map, and its wrong, missing and valid pixels.
fn judged(truth: &Rendered, start: &Image<f32>) -> (Image<f32>, Image<Verdict>, [usize; 3]) {
    let mut map = start.clone();
    let mut verdicts = Image::new(map.width(), map.height(), Verdict::Kept);
    truth.with_stack(|stack: &StereoStack<'_>| {
        StepJudge::new(Level::Scalar).judge(stack, &mut map, &mut verdicts);
    });
    let counts = count(truth, &map);
    (map, verdicts, counts)
}

fn count(truth: &Rendered, map: &Image<f32>) -> [usize; 3] {
    let mut counts = [0; 3];
    for y in 0..map.height() {
        for x in 0..map.width() {
            let (d, t) = (map.row(y)[x], truth.truth_px.row(y)[x]);
            let seen = truth.visible.row(y)[x] != 0;
            counts[0] += usize::from(!d.is_nan() && (d - t).abs() > 2.0);
            counts[1] += usize::from(seen && d.is_nan());
            counts[2] += usize::from((d - t).abs() <= 2.0);
        }
    }
    counts
}

#[test]
fn a_disc_that_is_too_large_or_too_small_gets_its_size_back() {
    let truth = scene(10);
    for grown in [1.0, 2.0, -1.0, -2.0] {
        let start = wrong(&truth, grown);
        let before = count(&truth, &start)[0];
        let (_, verdicts, [bad, missing, _]) = judged(&truth, &start);
        println!("grown by {grown}: {before} wrong before, {bad} after, {missing} missing");
        assert!(bad * 5 <= before, "grown by {grown}: {before} wrong before, {bad} after");
        // The circumference has 220 pixels, and many of them show both surfaces on one side.
        assert!(missing < 220, "{missing} missing");
        assert!(verdicts.as_slice().contains(&Verdict::Moved));
    }
}

#[test]
fn a_right_map_is_left_alone() {
    let truth = scene(10);
    let start = wrong(&truth, 0.0);
    let (map, verdicts, [bad, missing, valid]) = judged(&truth, &start);
    let changed = verdicts.as_slice().iter().filter(|v| **v != Verdict::Kept).count();
    println!("{changed} changed of {valid}, {bad} wrong, {missing} missing");
    // The circumference has 220 pixels; many of them show both surfaces on one side.
    assert!(changed < 220 && bad <= 2, "{changed} changed, {bad} wrong");
    // Away from the step nothing was touched.
    for y in 0..map.height() {
        for x in 0..map.width() {
            let rho = (x as f64 - CENTRE.0).hypot(y as f64 - CENTRE.1);
            if rho < RADIUS - 4.0 {
                assert_eq!(map.row(y)[x].to_bits(), start.row(y)[x].to_bits());
            }
        }
    }
}

#[test]
fn a_surface_does_not_reach_beyond_its_silhouette() {
    // Nothing is lit behind the disc, so the background's map has no surface at all.
    let disc = |x: f64, y: f64| (x - CENTRE.0).hypot(y - CENTRE.1) < RADIUS;
    let mut truth = scene(10);
    let blank = |images: &mut Vec<Image<i16>>, shift: f64| {
        for image in images {
            for y in 0..image.height() {
                for x in 0..image.width() {
                    if !disc(x as f64 + shift, y as f64) {
                        // A hundredth of the light, as blur and stray light leave it.
                        let dim = 64 * 5 + (image.row(y)[x] - 64 * 5) / 100;
                        image.set(x, y, dim);
                    }
                }
            }
        }
    };
    blank(&mut truth.left, 0.0);
    blank(&mut truth.right, f64::from(NEAR_PX));
    let mut start = wrong(&truth, 2.0);
    start.as_mut_slice().iter_mut().filter(|d| **d == FAR_PX).for_each(|d| *d = f32::NAN);
    let (map, verdicts, _) = judged(&truth, &start);
    let removed = verdicts.as_slice().iter().filter(|v| **v == Verdict::Removed).count();
    let beyond = (0..map.height())
        .flat_map(|y| (0..map.width()).map(move |x| (x, y)))
        .filter(|&(x, y)| !disc(x as f64, y as f64) && !map.row(y)[x].is_nan())
        .count();
    println!("{removed} removed, {beyond} left beyond the silhouette");
    assert!(removed > 300, "{removed}");
    assert!(beyond < 40, "{beyond}");
}

#[test]
fn threads_and_too_few_frames_make_no_difference() {
    let truth = scene(10);
    let start = wrong(&truth, 2.0);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (map, ..) = pool.install(|| judged(&truth, &start));
        map.as_slice().iter().map(|d| d.to_bits()).collect::<Vec<_>>()
    };
    assert_eq!(run(1), run(3));
    let few = scene(FRAMES_MIN - 1);
    let start = wrong(&few, 2.0);
    let (_, verdicts, _) = judged(&few, &start);
    assert!(verdicts.as_slice().iter().all(|v| *v == Verdict::Kept));
}

/// The fast path with its steps settled: a fifth of the wrong points at most, half with the least
/// number of frames, the disc's own kept, and the same map with any number of threads.
#[test]
fn the_fast_path_settles_its_steps() {
    for (frames, fewer, kept) in [(10, 5, 98), (5, 5, 98), (3, 3, 97), (FRAMES_MIN, 2, 95)] {
        let truth = scene(frames);
        let matched = |settle_steps: bool, threads: usize| {
            let mut params = Params::new(DisparityRange { min_px: -10, max_px: 60 });
            (params.method, params.shape) = (Method::Dense, ShapeFunction::Auto);
            params.advanced.settle_steps = settle_steps;
            params.advanced.threads = Some(threads);
            let mut matcher = Matcher::new(params).unwrap();
            truth.with_stack(|stack| matcher.match_stack(stack).unwrap().disparity_px)
        };
        let plain = count(&truth, &matched(false, 1));
        let one = matched(true, 1);
        let settled = count(&truth, &one);
        println!("{frames} frames: wrong, missing, right: {plain:?}, settled {settled:?}");
        assert!(settled[0] * fewer <= plain[0], "{frames} frames: {plain:?} to {settled:?}");
        assert!(settled[2] * 100 >= plain[2] * kept, "{frames} frames: {plain:?} to {settled:?}");
        let bits =
            |map: &Image<f32>| map.as_slice().iter().map(|d| d.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&one), bits(&matched(true, 3)));
    }
}

/// A window near a step that gave its pixels a disparity which is off by less than a step: no neighbour
/// tells, only their own grey values.
#[test]
fn a_point_near_a_step_that_its_own_grey_values_do_not_show_is_taken_away() {
    let truth = scene(10);
    let (width, height) = (truth.truth_px.width(), truth.truth_px.height());
    let spoilt = |x: usize, y: usize| {
        let (dx, dy) = (x as f64 - CENTRE.0, y as f64 - CENTRE.1);
        dx < 0.0 && dy.abs() < 10.0 && (RADIUS - 5.0..RADIUS - 1.0).contains(&dx.hypot(dy))
    };
    let mut start = wrong(&truth, 0.0);
    let mut maps = DenseMaps::new(width, height);
    maps.zncc.as_mut_slice().fill(0.995);
    for y in 0..height {
        for x in 0..width {
            // Twice that in two rings: a slope, which is no step either.
            let rho = (x as f64 - CENTRE.0).hypot(y as f64 - CENTRE.1);
            let off = if rho > RADIUS - 3.0 { 2.8 } else { 1.4 };
            start.row_mut(y)[x] += if spoilt(x, y) { off } else { 0.0 };
        }
    }
    (maps.first_px, maps.second_px) = (start.clone(), start.clone());
    let mut step = Image::new(width, height, 0);
    mark_steps(Level::Scalar, &start, 4, 1.5, &mut step);
    truth.with_stack(|stack| {
        Settle::new(Level::Scalar).run(stack, (0.9, true), &step, &mut start, &mut maps);
    });
    let (mut bad, mut left, mut good, mut kept) = (0, 0, 0, 0);
    for y in 0..height {
        for x in 0..width {
            let rho = (x as f64 - CENTRE.0).hypot(y as f64 - CENTRE.1);
            let d = maps.second_px.row(y)[x];
            assert_eq!(d.is_nan(), maps.first_px.row(y)[x].is_nan());
            if spoilt(x, y) {
                (bad, left) = (bad + 1, left + usize::from((d - NEAR_PX).abs() > 1.0));
            } else if rho < RADIUS - 1.0 {
                (good, kept) = (good + 1, kept + usize::from(d == NEAR_PX));
            }
        }
    }
    println!("{left} of {bad} wrong ones left, {kept} of {good} right ones kept");
    assert!(bad > 50 && left * 4 <= bad, "{left} of {bad}");
    assert!(kept * 100 >= good * 99, "{kept} of {good}");
}

/// Noise takes similarity from right points too.
#[test]
fn weak_light_costs_no_points_near_steps() {
    let disc = |x: f64, y: f64| (x - CENTRE.0).hypot(y - CENTRE.1) < RADIUS;
    let layers =
        vec![Layer::everywhere(|_, _| FAR_PX as f64), Layer::patch(|_, _| NEAR_PX as f64, disc)];
    let mut scene = Scene::new(220, 120, 10, layers);
    scene.peak_dn = 5.0;
    let truth = scene.render();
    let matched = |settle_steps: bool| {
        let mut params = Params::new(DisparityRange { min_px: -10, max_px: 60 });
        (params.method, params.shape) = (Method::Dense, ShapeFunction::Auto);
        params.zncc_min = 0.5;
        params.advanced.settle_steps = settle_steps;
        let mut matcher = Matcher::new(params).unwrap();
        truth.with_stack(|stack| {
            let matched = matcher.match_stack(stack).unwrap();
            let mut zncc: Vec<f32> = matched.zncc.as_slice().to_vec();
            zncc.retain(|z| !z.is_nan());
            zncc.sort_by(f32::total_cmp);
            (count(&truth, &matched.disparity_px), zncc[zncc.len() / 2])
        })
    };
    let ((plain, zncc), (settled, _)) = (matched(false), matched(true));
    println!("ZNCC {zncc}; wrong, missing, right: {plain:?}, settled {settled:?}");
    assert!(zncc < 0.97, "{zncc}");
    assert!(settled[2] * 100 >= plain[2] * 98, "{plain:?} to {settled:?}");
}
