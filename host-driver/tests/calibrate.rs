//! Calibration from simulated sightings: exact without noise, as uncertain as it says with noise.

use stspp::calibrate::bundle::Loss;
use stspp::calibrate::solve::rms;
use stspp::calibrate::tour::{self, Draw, Tour};
use stspp::calibrate::{Board, Sighting, detect, findings, rendered, solve, trials};
use stspp::sim::calibration_of;
use stspp_hil_sim::world::SensorModel;

#[test]
fn sightings_without_noise_give_the_rig_back() {
    for text in ["charuco:11x8:35", "circles:12x9:30"] {
        let board: Board = text.parse().unwrap();
        let truth = calibration_of(&SensorModel::perturbed(3));
        let poses = Tour::default().left_from_board(&truth);
        let observations = tour::sightings(&truth, &board, &poses, 0.0, &mut Draw::new(1));
        let solution = solve(&observations, Loss::Huber).unwrap();
        let found = solution.calibration();
        println!("{text} {} steps, {:e} px", solution.adjusted.steps, solution.rms_px()[0]);
        for (a, b) in [(&found.left, &truth.left), (&found.right, &truth.right)] {
            for (a, b) in a.to_vector().iter().zip(b.to_vector()) {
                assert!((a - b).abs() < 1e-6 * b.abs().max(1e-2), "{text} {a} {b}");
            }
        }
        let apart = found.right_from_left.inverse() * truth.right_from_left;
        assert!(apart.translation.vector.norm() < 1e-8, "{text} {apart}");
    }
}

/// How far detected points are from where the true cameras see them, in px.
fn errors(seen: &[Sighting], truth: &[Sighting]) -> Vec<f64> {
    let error = |s: &Sighting| {
        let t = truth.iter().find(|t| t.point == s.point);
        let t = t.unwrap_or_else(|| panic!("point {} is not in view", s.point));
        (t.pixel - s.pixel).norm()
    };
    seen.iter().map(error).collect()
}

#[test]
fn rendered_boards_are_found_to_a_fiftieth_of_a_pixel() {
    // Half the pixels in each direction, and boards near enough for their markers.
    for text in ["charuco:8x6:40", "circles:10x8:30"] {
        let board: Board = text.parse().unwrap();
        let model = SensorModel::with_seed(2).scaled_down(2);
        let truth = calibration_of(&model);
        let tour = Tour { views: 3, depth_m: [0.8, 1.0], ..Tour::default() };
        let poses = tour.left_from_board(&truth);
        let exact = tour::sightings(&truth, &board, &poses, 0.0, &mut Draw::new(1));
        let texture = rendered::texture(&board);
        let (mut off, mut in_view) = (Vec::new(), 0);
        for (k, pose) in poses.iter().enumerate() {
            let pair = rendered::pair(&texture, &model, pose, rendered::EXPOSURE_US, 1).unwrap();
            for (side, image) in [&pair.left, &pair.right].into_iter().enumerate() {
                in_view += exact.views[k].side(side).len();
                match detect::detect(image, &board) {
                    Ok(found) => off.extend(errors(&found.sightings, exact.views[k].side(side))),
                    Err(problem) => println!("{text} view {k} side {side}: {problem}"),
                }
            }
        }
        let rms = rms(off.iter().copied());
        let worst = off.iter().copied().fold(0.0, f64::max);
        println!("{text}: {} of {in_view} points, rms {rms:.4} px, worst {worst:.4} px", off.len());
        assert!(off.len() * 10 >= in_view * 7, "{text}: {} of {in_view}", off.len());
        assert!(rms < 0.025 && worst < 0.15, "{text}: rms {rms}, worst {worst}");
    }
}

#[test]
fn uncertainties_cover_the_errors_of_seeded_trials() {
    let board = Board::default();
    let result = trials::trials(&board, 50, trials::SIGMA_PX, &mut || {}).unwrap();
    println!("{result:?}");
    assert!((0.6..0.8).contains(&result.covered), "{}", result.covered);
    assert!(result.depth_covered.iter().all(|(_, share)| *share >= 0.55));
    assert!(result.rms_worst_px < 0.1);
    for ((depth_m, worst_mm), limit_mm) in result.depth_bias_worst_mm.iter().zip([0.1, 0.4]) {
        assert!(*worst_mm <= limit_mm, "{worst_mm} mm at {depth_m} m");
    }
}

#[test]
fn every_poor_set_gets_its_own_warning() {
    for board in ["charuco:8x6:40", "circles:10x8:36"] {
        let sets = trials::poor_sets(&board.parse().unwrap(), &mut || {}).unwrap();
        assert!(sets.len() >= 10);
        for set in sets {
            println!("{board}: {}: {:?}", set.name, set.findings);
            assert!(set.is_found(), "{board}: {}: {:?} {:?}", set.name, set.findings, set.error);
        }
    }
}

/// A set that is good gets none of the warnings about what is in the images.
#[test]
fn a_good_set_gets_no_warning() {
    let board = Board::default();
    let truth = calibration_of(&SensorModel::default());
    let poses = Tour { views: 36, ..Tour::default() }.left_from_board(&truth);
    let observations = tour::sightings(&truth, &board, &poses, trials::SIGMA_PX, &mut Draw::new(1));
    let solution = solve(&observations, Loss::Huber).unwrap();
    let found = findings::findings(&observations, &[], Some(&solution), Some(0.4));
    assert!(found.is_empty(), "{found:?}");
}

#[test]
fn false_points_and_too_few_views_are_told() {
    let board = Board::default();
    let truth = calibration_of(&SensorModel::default());
    let poses = Tour::default().left_from_board(&truth);
    let mut observations = tour::sightings(&truth, &board, &poses, 0.012, &mut Draw::new(1));
    // Two points in a hundred are elsewhere: either loss shrugs them off.
    let mut draw = Draw::new(3);
    for view in &mut observations.views {
        for sighting in view.left.iter_mut().chain(&mut view.right) {
            if draw.uniform() < 0.02 {
                sighting.pixel.x += 10.0 * draw.symmetric();
            }
        }
    }
    for loss in [Loss::Huber, Loss::Cauchy] {
        let found = solve(&observations, loss).unwrap().calibration();
        let bias = trials::depth_error(&truth, &found, 1.0).bias_mm;
        println!("{loss:?}: {bias:+.4} mm at 1 m");
        assert!(bias.abs() < 0.15, "{loss:?}: {bias}");
    }
    observations.views.truncate(3);
    let error = solve(&observations, Loss::Huber).unwrap_err().to_string();
    assert!(error.contains("3 of 3") && error.contains("at least 4"), "{error}");
    observations.views.clear();
    assert!(solve(&observations, Loss::Huber).is_err());
}
