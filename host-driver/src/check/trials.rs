//! Checks whose answer is known: a simulated sensor whose right camera was turned after calibration.

use serde::Serialize;
use stspp_hil_sim::world::{SceneSpec, SensorModel, WorldError};

use super::drift::Axes;
use super::report::Report;
use super::{CheckError, Options, check};
use crate::accuracy::capture::Capture;
use crate::sim::calibration_of;

/// A turn injected, and what was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trial {
    /// Pitch, yaw and roll injected.
    pub turned_deg: [f64; 3],
    /// Found minus injected, along each axis.
    pub error_deg: [f64; 3],
    /// The report.
    pub report: Report,
}

/// Why a trial failed.
#[derive(Debug, thiserror::Error)]
pub enum TrialError {
    /// The scene cannot be simulated.
    #[error(transparent)]
    World(#[from] WorldError),
    /// The check failed.
    #[error(transparent)]
    Check(#[from] CheckError),
}

/// Records `frames` speckle pairs of a scene by a sensor whose right camera is turned, and checks the
/// calibration from before the turn.
///
/// # Errors
/// When the scene cannot be rendered, or the check fails.
pub fn injected(
    scene: &SceneSpec,
    model: &SensorModel,
    turned_deg: [f64; 3],
    frames: usize,
    options: &Options,
    axes: Axes,
) -> Result<Trial, TrialError> {
    let calibration = calibration_of(model);
    let turned = model.clone().with_right_camera_turned(turned_deg);
    let capture = Capture::record(scene, turned, frames, &mut |_| {})?;
    let checked = check(&calibration, &capture.pairs, options, axes, &mut |_| {})?;
    // What is left between the corrected rig and the true one, as a turn of the right camera.
    let truth = capture.calibration.right_from_left.rotation;
    let left = checked.corrected.right_from_left.rotation * truth.inverse();
    Ok(Trial {
        turned_deg,
        error_deg: left.scaled_axis().map(f64::to_degrees).into(),
        report: Report::new(&calibration, &checked),
    })
}
