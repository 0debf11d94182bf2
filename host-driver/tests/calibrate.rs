//! Calibration from simulated sightings: exact without noise, as uncertain as it says with noise.

use stspp::calibrate::bundle::Loss;
use stspp::calibrate::tour::{self, Draw, Tour};
use stspp::calibrate::{Board, View, detect, rendered, solve};
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

/// Errors of detected points against where the true cameras see them, in px.
fn errors(
    board: &Board,
    view: &stspp::calibrate::View,
    truth: &stspp::calibrate::View,
) -> Vec<f64> {
    let _ = board;
    let mut errors = Vec::new();
    for side in 0..2 {
        for s in view.side(side) {
            let t = truth.side(side).iter().find(|t| t.point == s.point);
            let t = t.unwrap_or_else(|| panic!("point {} is not visible", s.point));
            errors.push((t.pixel - s.pixel).norm());
        }
    }
    errors
}

#[test]
fn rendered_boards_are_found_to_a_fraction_of_a_pixel() {
    for text in ["charuco:11x8:35", "circles:12x9:30"] {
        let board: Board = text.parse().unwrap();
        let model = SensorModel::with_seed(2);
        let truth = calibration_of(&model);
        let poses = Tour { views: 7, ..Tour::default() }.left_from_board(&truth);
        let expected = tour::sightings(&truth, &board, &poses, 0.0, &mut Draw::new(1));
        let texture = rendered::texture(&board);
        for (k, pose) in poses.iter().enumerate() {
            let t = std::time::Instant::now();
            let pair = rendered::pair(&texture, &model, pose, rendered::EXPOSURE_US, 1).unwrap();
            let t1 = t.elapsed();
            let t = std::time::Instant::now();
            let left = detect::detect(&pair.left, &board);
            let right = detect::detect(&pair.right, &board);
            println!("render {t1:?} detect {:?}", t.elapsed());
            let name = format!("{k}");
            println!(
                "{:?} {:?}",
                left.as_ref().map(|l| l.quality),
                right.as_ref().map(|l| l.quality)
            );
            let view = View {
                name,
                left: left.map(|l| l.sightings).unwrap_or_default(),
                right: right.map(|r| r.sightings).unwrap_or_default(),
            };
            let errors = errors(&board, &view, &expected.views[k]);
            let seen = expected.views[k].left.len() + expected.views[k].right.len();
            let max = errors.iter().copied().fold(0.0, f64::max);
            println!(
                "{text} view {k}: {} of {seen} points, rms {:.4} px, worst {max:.4}",
                errors.len(),
                stspp::calibrate::solve::rms(errors.iter().copied()),
            );
        }
    }
}
