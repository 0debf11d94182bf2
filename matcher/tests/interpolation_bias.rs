//! The estimate's bias over the sub-pixel phase, for dots from the smallest that a camera can resolve on.

use stspp_matcher::{
    DisparityRange, Matcher, Method, Params, ShapeFunction,
    synthetic::{Layer, Scene},
};

#[test]
fn bias_is_below_a_thousandth_of_a_pixel_at_every_phase() {
    for sigma in [0.75, 0.9, 1.3] {
        for phase in [0.0, 0.125, 0.21, 0.34, 0.5, 0.78, 0.96] {
            let truth = 21.0 + phase;
            let layer = Layer::everywhere(move |_, _| truth);
            let mut scene = Scene::new(150, 90, 10, vec![layer]);
            scene.dot_sigma_px = sigma;
            scene.peak_dn = 70.0;
            scene.noise = false;
            let mut params = Params::new(DisparityRange { min_px: 0, max_px: 40 });
            params.method = Method::Dense;
            params.shape = ShapeFunction::First;
            let mut matcher = Matcher::new(params).unwrap();
            let found = scene.render().with_stack(|stack| matcher.match_stack(stack)).unwrap();
            let (mut sum, mut n) = (0.0, 0.0);
            for y in 10..80 {
                for d in &found.disparity_px.row(y)[40..140] {
                    assert!(!d.is_nan());
                    (sum, n) = (sum + f64::from(*d) - truth, n + 1.0);
                }
            }
            let bias = sum / n;
            assert!(bias.abs() < 1e-3, "dots of {sigma} px, phase {phase}: {bias:.5}");
        }
    }
}
