//! Calibration from simulated sightings: exact without noise, as uncertain as it says with noise.

use stspp::calibrate::bundle::Loss;
use stspp::calibrate::tour::{self, Draw, Tour};
use stspp::calibrate::{Board, solve};
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
