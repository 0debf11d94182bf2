//! The scene `sim:calibration`: a calibration board shown to the sensor at one place after another, as
//! by a hand that brings it there and holds it still.

use stspp_hil_sim::world::{OptionInfo, SceneInfo, SceneSpec, SensorModel, list_scenes};

use super::calibration_of;
use crate::UriError;
use crate::calibrate::Board;
use crate::calibrate::rendered::texture;
use crate::calibrate::tour::Tour;

/// Name of the scene.
pub const NAME: &str = "calibration";

/// What `stspp list --scenes` says of it.
pub const INFO: SceneInfo = SceneInfo {
    name: NAME,
    summary: "a calibration board held still at one place after another, for `stspp calibrate`",
    options: &[
        OptionInfo {
            name: "board",
            default: "charuco:11x8:35",
            summary: "charuco:COLUMNSxROWS:MM or circles:COLUMNSxROWS:MM",
        },
        OptionInfo { name: "places", default: "25", summary: "places of the tour, 1 to 200" },
        OptionInfo { name: "dwell_ms", default: "200", summary: "time at each place, 50 to 60000" },
    ],
};

/// All scenes of `sim:`.
pub fn scenes() -> Vec<SceneInfo> {
    list_scenes().iter().copied().chain([INFO]).collect()
}

/// The scene from its options.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardTour {
    board: Board,
    places: usize,
    dwell_s: f64,
}

impl BoardTour {
    /// Reads the options.
    ///
    /// # Errors
    /// For an option or a value that it does not take.
    pub fn parse(options: &[(&str, &str)]) -> Result<Self, UriError> {
        let mut tour = Self { board: Board::default(), places: 25, dwell_s: 0.2 };
        for &(name, value) in options {
            let wrong = |expected: String| UriError::OptionValue {
                name: name.to_owned(),
                value: value.to_owned(),
                expected,
            };
            let number = |low: f64, high: f64| {
                let number = value.parse::<f64>().ok().filter(|v| (low..=high).contains(v));
                number.ok_or_else(|| wrong(format!("a number from {low} to {high}")))
            };
            match name {
                "board" => {
                    tour.board = value
                        .parse()
                        .map_err(|e: crate::calibrate::BoardError| wrong(e.to_string()))?;
                }
                "places" => tour.places = number(1.0, 200.0)? as usize,
                "dwell_ms" => tour.dwell_s = 1e-3 * number(50.0, 60_000.0)?,
                _ => {
                    let known = "board, places, dwell_ms, and the sensor's (stspp list --scenes)";
                    let name = name.to_owned();
                    return Err(UriError::OptionUnknown { scheme: "sim", name, known });
                }
            }
        }
        Ok(tour)
    }

    /// The scene before a sensor: the places depend on what its cameras see.
    pub fn scene(&self, model: &SensorModel) -> SceneSpec {
        let rig_from_left = model.left_from_rig().inverse();
        let tour = Tour { views: self.places, ..Tour::default() };
        let poses = tour.left_from_board(&calibration_of(model));
        let poses = poses.iter().map(|pose| rig_from_left * pose).collect();
        SceneSpec::board_tour(texture(&self.board), poses, self.dwell_s)
    }
}
