//! The accuracy tables on a small simulated sensor: what they say must follow from the physics.
#![cfg(feature = "sim")]

use stspp::accuracy::tables::{Case, to_text};
use stspp::accuracy::{bound, maps, similar};
use stspp::reconstruct::Options;
use stspp_hil_sim::world::{SceneSpec, SensorModel};
use stspp_matcher::Method;

fn case(scene: &str, options: &[(&str, &str)], frames: usize) -> Case {
    let spec = SceneSpec::parse(scene, options).unwrap();
    Case::new(
        &spec,
        SensorModel::default().scaled_down(2),
        frames,
        &Options::default(),
        &mut |_| {},
    )
    .unwrap()
}

#[test]
fn refinement_and_more_frames_bring_accuracy() {
    let case = case("sphere", &[], 6);
    let icgn = Options { method: Method::IcGn, ..Options::default() };
    let parabola = Options { method: Method::Parabola, ..Options::default() };
    let (few, _) = case.line("sphere", 2, icgn).unwrap();
    let (many, frame) = case.line("sphere", 6, icgn).unwrap();
    let (coarse, _) = case.line("sphere", 6, parabola).unwrap();
    println!("{}", to_text(&[few.clone(), many.clone(), coarse.clone()]));
    // Half the resolution: a pixel of disparity is twice as deep as the sensor's.
    assert!(many.core_rms_mm.unwrap() < 0.1, "{many:?}");
    assert!(many.core_rms_mm < few.core_rms_mm, "{few:?} {many:?}");
    assert!(many.core_rms_mm.unwrap() < 0.5 * coarse.core_rms_mm.unwrap(), "{coarse:?}");
    assert!(many.core_radius_error_mm.unwrap().abs() < 0.1, "{many:?}");
    assert!(many.score.completeness > 0.97 && many.score.outliers < 0.003, "{many:?}");
    assert!(many.score.surface_median_mm < many.score.surface_rms_mm);
    // The truth is of the canvas: a frame made of it has no error at all.
    let mut exact = frame.clone();
    exact.depth_m = case.truth().depth_m.clone();
    let perfect = stspp::accuracy::score::score(&exact, case.truth());
    assert_eq!((perfect.completeness, perfect.outliers, perfect.surface_rms_mm), (1.0, 0.0, 0.0));
    assert_eq!(perfect.normal_rms_mm, 0.0);
    // The sphere's limb and the wall seen askew: nearer to the surface than along the ray.
    assert!(many.score.normal_rms_mm < many.score.surface_rms_mm, "{many:?}");
    // Errors are seen, wherever they are.
    let (x, y) = (exact.depth_m.width() / 2, exact.depth_m.height() / 2);
    exact.depth_m.set(x, y, 0.5);
    exact.depth_m.set(x + 1, y, f32::NAN);
    let spoilt = stspp::accuracy::score::score(&exact, case.truth());
    assert!((spoilt.outliers * spoilt.points as f64 - 1.0).abs() < 1e-6);
    assert!(
        (spoilt.completeness * spoilt.visible as f64 - (spoilt.visible as f64 - 2.0)).abs() < 1e-6
    );
    let mut picture = Vec::new();
    maps::write_error_png(&mut picture, &exact, case.truth(), 0.1).unwrap();
    assert!(picture.starts_with(b"\x89PNG"));
}

/// On a plane nothing is lost: a fit that is told the truth is as good as the matcher's, whose kernels
/// smooth a little, and a window of nine times fewer pixels three times worse.
#[test]
fn windows_told_the_truth_do_as_well_on_a_plane_as_the_matcher() {
    let case = case("plane", &[("distance_m", "1")], 6);
    let dense = Options { method: Method::Dense, ..Options::default() };
    let dense = Options { shape: stspp_matcher::ShapeFunction::First, ..dense };
    let (_, frame) = case.line("plane 1 m", 6, dense).unwrap();
    let classes = bound::bound(case.stack(), 6, &frame, case.truth());
    println!("{}", bound::to_text(&classes));
    // And a plane is the same in both views: nearly every pixel is alike at its true place, and at another
    // hardly one.
    let alike = similar::similar(case.stack(), 6, &frame, case.truth());
    println!("{}", similar::to_text(&alike));
    assert!(alike[2].alike[3] > 0.97 && alike[2].found > 0.97, "{alike:?}");
    assert_eq!((alike[1].visible, alike[0].visible), (0, alike[2].visible));
    let elsewhere = self::case("plane", &[("distance_m", "1.1")], 6);
    let unlike = similar::similar(case.stack(), 6, &frame, elsewhere.truth());
    assert!(unlike[2].alike[3] < 0.1, "{unlike:?}");
    let far = &classes[4];
    assert!(far.points > 10_000 && classes[5].points >= far.points);
    let [first, second, .., small] = far.window_normal_rms_mm;
    assert!((0.95..1.3).contains(&(first / far.frame_normal_rms_mm)), "{far:?}");
    assert!((1.5..2.3).contains(&(second / first)), "{far:?}");
    assert!((2.2..4.0).contains(&(small / first)), "{far:?}");
    // Facing the cameras a step comes back all the way; only windows that show nothing keep what they are told.
    assert!(far.left_of_shift.iter().all(|left| left.abs() < 0.05), "{far:?}");
    assert!((1.0..1.3).contains(&(far.rest_normal_rms_mm[0] / first)), "{far:?}");
}
