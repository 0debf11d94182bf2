//! The accuracy tables: sphere over the number of frames, planes over distance.

use serde::Serialize;
use stspp_hil_sim::world::{SceneSpec, SensorModel, WorldError};
use stspp_matcher::{Error as MatchError, Matcher, Method};

use super::circles::{self, FoundCircle};
use super::score::{central_plane_mm, score, sphere_rms_mm};
use super::{CanvasTruth, Capture, Score};
use crate::DepthFrame;
use crate::reconstruct::{Options, RectifiedStack};
use crate::rectify::RectifyError;

/// Radius of the sphere in metres.
const SPHERE_RADIUS_M: f64 = 0.075;
/// Pixels around a fitted point that belong to the same surface: half a 9x9 subset and one more.
const MARGIN_PX: usize = 5;

/// Incidence up to which the sphere's "core" is fitted: beyond, a camera sees the surface foreshortened
/// to less than half, and a square subset is no longer small on it.
const CORE_DEG: f32 = 60.0;

/// Why a table could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AccuracyError {
    /// The scene or the sensor cannot be simulated.
    #[error(transparent)]
    World(#[from] WorldError),
    /// The simulated images cannot be rectified.
    #[error(transparent)]
    Rectify(#[from] RectifyError),
    /// The stack cannot be matched.
    #[error(transparent)]
    Match(#[from] MatchError),
}

/// A scene, simulated and rectified, with the truth of its canvas.
pub struct Case {
    capture: Capture,
    saturated: f64,
    stack: RectifiedStack,
    truth: CanvasTruth,
    /// Of a moving scene: the truth at the newest frame's time.
    newest: Option<CanvasTruth>,
}

/// One line of a table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Line {
    /// The scene.
    pub scene: String,
    /// Frames matched.
    pub frames: usize,
    /// Sub-pixel method.
    pub method: String,
    /// Order of the shape function.
    pub shape_function: String,
    /// RMS of the plane fit over the central half, or of the sphere fit, in millimetres.
    pub fit_rms_mm: Option<f64>,
    /// Mean error along the ray of a plane's central half, in millimetres.
    pub bias_mm: Option<f64>,
    /// Error of the fitted sphere's radius in millimetres.
    pub radius_error_mm: Option<f64>,
    /// The sphere's fit RMS over points that neither camera sees at more than 60 degrees.
    pub core_rms_mm: Option<f64>,
    /// Error of that fit's radius in millimetres.
    pub core_radius_error_mm: Option<f64>,
    /// Against the truth.
    pub score: Score,
    /// Part of the raw pixels at full scale.
    pub saturated: f64,
    /// Wall time of the match in milliseconds.
    pub match_wall_ms: f64,
}

impl Case {
    /// Simulates `frames` pairs of a scene, for the depths and the canvas of `options`.
    ///
    /// # Errors
    /// For a scene or a sensor that cannot be simulated.
    pub fn new(
        scene: &SceneSpec,
        model: SensorModel,
        frames: usize,
        options: &Options,
        progress: &mut dyn FnMut(usize),
    ) -> Result<Self, AccuracyError> {
        let capture = Capture::record(scene, model, frames, progress)?;
        Self::of_capture(capture, options)
    }

    /// Rectifies a capture and traces its truth.
    ///
    /// # Errors
    /// For images that cannot be rectified.
    pub fn of_capture(mut capture: Capture, options: &Options) -> Result<Self, AccuracyError> {
        let rectifier = options.rectifier(&capture.calibration)?;
        let stack = RectifiedStack::new(rectifier, &capture.pairs, capture.labels.clone())?;
        let saturated = capture.saturated();
        // The raw images are not needed again, and there may be several cases.
        capture.pairs = Vec::new();
        let at = |time_ns| {
            let (geometry, mask) = (stack.rectifier.geometry(), stack.rectifier.left_mask());
            CanvasTruth::trace(&capture.world, geometry, mask, time_ns)
        };
        let truth = at(capture.centre_ns(0..stack.len()));
        let newest = (!capture.world.is_still()).then(|| at(capture.newest_ns(stack.len())));
        Ok(Self { capture, saturated, stack, truth, newest })
    }

    /// Rectified images of the case.
    pub fn stack(&self) -> &RectifiedStack {
        &self.stack
    }

    /// The truth of its canvas, of a moving scene that at the middle of the recording.
    pub fn truth(&self) -> &CanvasTruth {
        &self.truth
    }

    /// The truth of its canvas that a match of `frames` pairs is compared with: a matcher that estimates
    /// motion gives the newest frame's depth, others that of the window's middle.
    pub fn truth_for(&self, options: Options, frames: usize) -> &CanvasTruth {
        let with_motion = options.method == Method::Dense && frames == self.stack.len();
        self.newest.as_ref().filter(|_| with_motion).unwrap_or(&self.truth)
    }

    /// The scene's circles in a frame of the first `frames` pairs.
    pub fn circles(&self, frame: &DepthFrame, frames: usize) -> Vec<FoundCircle> {
        circles::find(frame, &self.capture.world, self.capture.centre_ns(0..frames))
    }

    /// Matches the first `frames` pairs as `options` say and compares with the truth. Also gives the depth
    /// frame.
    ///
    /// # Errors
    /// From the matcher.
    pub fn line(
        &self,
        scene: &str,
        frames: usize,
        options: Options,
    ) -> Result<(Line, DepthFrame), AccuracyError> {
        let params = options.params_in(self.stack.rectifier.disparity_range());
        let mut matcher = Matcher::new(params)?;
        let start = std::time::Instant::now();
        let frame = self.stack.depth_frame(&mut matcher, 0..frames)?;
        let match_wall_ms = start.elapsed().as_secs_f64() * 1e3;
        let world = &self.capture.world;
        let truth = self.truth_for(options, frames);
        let sphere = |incidence_max_deg| {
            let fit =
                sphere_rms_mm(&frame, truth, world, SPHERE_RADIUS_M, MARGIN_PX, incidence_max_deg);
            fit.map_or((None, None), |(rms, radius)| (Some(rms), Some(radius)))
        };
        let (mut fit, mut core, mut bias_mm) = ((None, None), (None, None), None);
        if scene.starts_with("sphere") {
            (fit, core) = (sphere(90.0), sphere(CORE_DEG));
        } else if scene.contains("plane")
            && let Ok((rms, bias)) = central_plane_mm(&frame, truth)
        {
            (fit.0, bias_mm) = (Some(rms), Some(bias));
        }
        let line = Line {
            scene: scene.to_owned(),
            frames,
            method: format!("{:?}", options.method),
            shape_function: format!("{:?}", options.shape),
            fit_rms_mm: fit.0,
            bias_mm,
            radius_error_mm: fit.1,
            core_rms_mm: core.0,
            core_radius_error_mm: core.1,
            score: score(&frame, truth),
            saturated: self.saturated,
            match_wall_ms,
        };
        Ok((line, frame))
    }
}

/// Lines as text columns.
pub fn to_text(lines: &[Line]) -> String {
    const HEADS: [(&str, &str, usize); 17] = [
        ("scene", "", 16),
        ("N", "", 2),
        ("method", "", 9),
        ("order", "", 7),
        ("fit RMS", "mm", 9),
        ("bias", "mm", 9),
        ("radius", "mm", 9),
        ("core RMS", "mm", 9),
        ("radius", "mm", 9),
        ("points", "", 8),
        ("complete", "%", 9),
        ("outliers", "%", 9),
        ("ray RMS", "mm", 9),
        ("normal", "mm", 9),
        ("median", "mm", 9),
        ("full", "%", 7),
        ("match", "ms", 8),
    ];
    let row = |cells: [String; 17]| {
        let cells = cells.iter().zip(HEADS).enumerate().map(|(k, (cell, (_, _, width)))| {
            if k == 0 || k == 2 || k == 3 {
                format!("{cell:<width$}")
            } else {
                format!("{cell:>width$}")
            }
        });
        cells.collect::<Vec<_>>().join(" ") + "\n"
    };
    let mut text = row(HEADS.map(|head| head.0.to_owned()));
    text += &row(HEADS.map(|head| head.1.to_owned()));
    let number = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.4}"));
    for line in lines {
        let score = &line.score;
        text += &row([
            line.scene.clone(),
            line.frames.to_string(),
            line.method.clone(),
            line.shape_function.clone(),
            number(line.fit_rms_mm),
            number(line.bias_mm),
            number(line.radius_error_mm),
            number(line.core_rms_mm),
            number(line.core_radius_error_mm),
            score.points.to_string(),
            format!("{:.3}", 100.0 * score.completeness),
            format!("{:.4}", 100.0 * score.outliers),
            format!("{:.4}", score.surface_rms_mm),
            format!("{:.4}", score.normal_rms_mm),
            format!("{:.4}", score.surface_median_mm),
            format!("{:.3}", 100.0 * line.saturated),
            format!("{:.0}", line.match_wall_ms),
        ]);
    }
    text
}
