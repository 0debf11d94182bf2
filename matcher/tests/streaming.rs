//! A matcher that is kept over a stream gives what a fresh one gives: nothing of earlier windows, however
//! different, is left in a result.

use stspp_matcher::{
    DisparityRange, Image, Matched, Matcher, Method, Params, Sample, ShapeFunction, StereoStack,
    synthetic::{Layer, Rendered, Scene},
};

const FRAMES: usize = 5;

fn params() -> Params {
    let mut params = Params::new(DisparityRange { min_px: -20, max_px: 90 });
    params.method = Method::Dense;
    params.shape = ShapeFunction::Auto;
    params
}

fn scene(disparity: f64, rate: f64, seed: u64) -> Rendered {
    let mut layer = Layer::everywhere(move |x, y| disparity + 0.05 * x - 0.03 * y);
    layer.rate_px_per_frame = rate;
    let mut scene = Scene::new(210, 100, FRAMES, vec![layer]);
    scene.seed = seed;
    scene.render()
}

fn bits(matched: &Matched) -> Vec<u32> {
    let maps = [Some(&matched.disparity_px), Some(&matched.zncc), matched.rate_px_per_s.as_ref()];
    let values = maps.into_iter().flatten().flat_map(|map| map.as_slice());
    values.map(|v| v.to_bits()).collect()
}

/// Slides a window over three scenes that share nothing: other depth, other dots, one in fast motion.
#[test]
fn after_a_jump_of_the_scene_the_result_is_the_one_from_scratch() {
    let scenes = [scene(12.0, 0.0, 1), scene(61.0, 0.15, 2), scene(30.0, 0.0, 3)];
    let images = |side: fn(&Rendered) -> &Vec<Image<Sample>>| -> Vec<&Image<Sample>> {
        scenes.iter().flat_map(side).collect()
    };
    let (left, right) = (images(|s| &s.left), images(|s| &s.right));
    let times: Vec<f64> = (0..left.len()).map(|k| k as f64 / 30.0).collect();
    let mut kept = Matcher::new(params()).unwrap();
    let mut valid = Vec::new();
    for first in 0..=left.len() - FRAMES {
        let window = first..first + FRAMES;
        let stack = StereoStack {
            times_s: Some(&times[window.clone()]),
            ..StereoStack::new(&left[window.clone()], &right[window])
        };
        let found = kept.match_stack(&stack).unwrap();
        let fresh = Matcher::new(params()).unwrap().match_stack(&stack).unwrap();
        assert_eq!(bits(&found), bits(&fresh), "window from {first}");
        let part = found.disparity_px.as_slice().iter().filter(|d| !d.is_nan()).count();
        valid.push(part as f64 / (210.0 * 100.0));
        if first % FRAMES == 0 {
            let truth = &scenes[first / FRAMES].truth_px;
            let pairs = found.disparity_px.as_slice().iter().zip(truth.as_slice());
            let wrong = pairs.filter(|(d, t)| (*d - *t).abs() > 0.2).count();
            assert!(wrong < 100, "window from {first}: {wrong} wrong");
        }
    }
    // The first window of each scene alone is whole again.
    for scene in 0..scenes.len() {
        assert!(valid[scene * FRAMES] > 0.55, "{valid:?}");
    }
}

#[test]
fn another_order_from_frame_to_frame_leaves_no_trace() {
    let scene = scene(20.0, 0.1, 4);
    let mut kept = Matcher::new(params()).unwrap();
    for shape in
        [ShapeFunction::Auto, ShapeFunction::First, ShapeFunction::Second, ShapeFunction::Auto]
    {
        kept.set_shape(shape);
        let found = scene.with_stack(|stack| kept.match_stack(stack)).unwrap();
        let mut fresh = Matcher::new(Params { shape, ..params() }).unwrap();
        let fresh = scene.with_stack(|stack| fresh.match_stack(stack)).unwrap();
        assert_eq!(bits(&found), bits(&fresh), "{shape:?}");
    }
}
