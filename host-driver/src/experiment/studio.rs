//! Scenes rendered once and kept as recording folders, matched in many ways.

use std::path::{Path, PathBuf};

use stspp_hil_sim::world::{SceneSpec, SensorModel, World};
use stspp_matcher::{DisparityRange, Matcher, Method, Params, ShapeFunction};

use super::ExperimentError;
use crate::accuracy::{CanvasTruth, Capture};
use crate::reconstruct::RectifiedStack;
use crate::rectify::{DepthRange, Rectifier};
use crate::{DepthFrame, Recording, recording};

/// Pairs of a recording.
pub const FRAMES: usize = 10;
/// Frames a second.
pub const RATE_HZ: f64 = 30.0;

/// Where scenes are rendered and kept.
pub struct Studio<'a> {
    folder: PathBuf,
    seed: u64,
    params: Params,
    asked: (Option<Method>, Option<ShapeFunction>),
    depth: DepthRange,
    progress: &'a mut dyn FnMut(String),
    /// Recordings rendered and reused.
    pub rendered: usize,
    /// See [`Studio::rendered`].
    pub reused: usize,
}

/// A scene, recorded and rectified.
pub struct Take {
    /// Scene and sensor, for truth.
    pub world: World,
    /// Rectified images.
    pub stack: RectifiedStack,
    /// Centre of all exposures, nanoseconds of the scene's time.
    pub centre_ns: u64,
}

impl Take {
    /// The time that a frame's depth refers to, nanoseconds of the scene's time.
    pub fn time_ns(&self, frame: &DepthFrame) -> u64 {
        frame.time_device_s.map_or(self.centre_ns, |time_s| (time_s * 1e9) as u64)
    }
}

impl<'a> Studio<'a> {
    /// A studio that keeps its recordings in `folder`. `asked` say how is matched where the figures' own
    /// ways are not wanted.
    pub fn new(
        folder: &Path,
        seed: u64,
        asked: (Option<Method>, Option<ShapeFunction>),
        threads: Option<usize>,
        progress: &'a mut dyn FnMut(String),
    ) -> Self {
        // The disparities are each canvas's own.
        let mut params = Params::new(DisparityRange { min_px: -400, max_px: 119 });
        params.advanced.threads = threads;
        Self {
            folder: folder.to_owned(),
            seed,
            params,
            asked,
            depth: DepthRange::default(),
            progress,
            rendered: 0,
            reused: 0,
        }
    }

    /// Depths that are searched from here on; they must hold the scene.
    pub fn depths(&mut self, depth: DepthRange) {
        self.depth = depth;
    }

    /// Matches this way from here on, unless another was asked for.
    pub fn use_way(&mut self, (method, shape): (Method, ShapeFunction)) {
        self.params.method = self.asked.0.unwrap_or(method);
        self.params.shape = self.asked.1.unwrap_or(shape);
    }

    /// Tells what goes on.
    pub fn say(&mut self, what: impl Into<String>) {
        (self.progress)(what.into());
    }

    /// How is matched.
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// Records [`FRAMES`] pairs of a scene by its name and options, from frame `first` of its time on, or
    /// reads what was recorded before.
    ///
    /// # Errors
    /// For a scene that cannot be, or a folder that cannot be written.
    pub fn take(
        &mut self,
        name: &str,
        options: &[(&str, &str)],
        first: usize,
    ) -> Result<Take, ExperimentError> {
        self.take_frames(name, options, first, FRAMES)
    }

    /// As [`Studio::take`], of `frames` pairs.
    ///
    /// # Errors
    /// As [`Studio::take`].
    pub fn take_frames(
        &mut self,
        name: &str,
        options: &[(&str, &str)],
        first: usize,
        frames: usize,
    ) -> Result<Take, ExperimentError> {
        let spec = SceneSpec::parse(name, options)?;
        let world = World::new(&spec, SensorModel::with_seed(self.seed))?;
        let options: Vec<String> =
            options.iter().map(|(name, value)| format!("{name}={value}")).collect();
        let label = format!("{name} {}", options.join(" "));
        // What the images depend on; a recording of anything else is made anew.
        let slate = format!(
            "{spec:?} seed {} first {first} frames {frames} stspp {}\n",
            self.seed,
            env!("CARGO_PKG_VERSION")
        );
        let folder = self.folder.join(folder_name(name, &options, first, self.seed));
        let slate_path = folder.join("scene.txt");
        let capture = if std::fs::read_to_string(&slate_path).is_ok_and(|kept| kept == slate) {
            self.reused += 1;
            self.say(format!("{label}: reading the recording"));
            let recording = Recording::open(&folder)?;
            let pairs = recording.read_window(0..frames.min(recording.len()))?;
            Capture {
                world,
                calibration: recording.calibration.clone(),
                pairs,
                labels: recording.labels.clone().unwrap_or_default(),
            }
        } else {
            self.rendered += 1;
            let progress = &mut *self.progress;
            let capture = Capture::record_from(world, first, frames, &mut |k| {
                progress(format!("{label}: exposing pair {} of {frames}", k + 1));
            });
            let Capture { calibration, pairs, labels, .. } = &capture;
            recording::write(&folder, calibration, pairs, labels, true)?;
            std::fs::write(&slate_path, slate)
                .map_err(|source| ExperimentError::Write { path: slate_path, source })?;
            capture
        };
        self.say(format!("{label}: rectifying"));
        let rectifier = Rectifier::new(&capture.calibration, self.depth)?;
        let stack = RectifiedStack::new(rectifier, &capture.pairs, capture.labels.clone())?;
        let centre_ns = capture.centre_ns(0..stack.len());
        Ok(Take { world: capture.world, stack, centre_ns })
    }

    /// Matches the first `frames` pairs of a take, after `change` of the parameters.
    ///
    /// # Errors
    /// From the matcher.
    pub fn matched(
        &mut self,
        take: &Take,
        frames: usize,
        change: impl FnOnce(&mut Params),
    ) -> Result<DepthFrame, ExperimentError> {
        self.say(format!("matching {frames} of {} pairs", take.stack.len()));
        let mut params = self.params.clone();
        params.disparity = take.stack.rectifier.disparity_range();
        change(&mut params);
        let mut matcher = Matcher::new(params)?;
        Ok(take.stack.depth_frame(&mut matcher, 0..frames)?)
    }

    /// Traces the truth of a still take's canvas.
    pub fn truth(&mut self, take: &Take) -> CanvasTruth {
        self.truth_at(take, take.centre_ns)
    }

    /// Traces the truth of a take's canvas at a time.
    pub fn truth_at(&mut self, take: &Take, time_ns: u64) -> CanvasTruth {
        self.say("tracing the truth");
        let rectifier = &take.stack.rectifier;
        CanvasTruth::trace(&take.world, rectifier.geometry(), rectifier.left_mask(), time_ns)
    }
}

fn folder_name(scene: &str, options: &[String], first: usize, seed: u64) -> String {
    let mut name = scene.to_owned();
    for option in options {
        name += "_";
        name += option;
    }
    name += &format!("_{first}_{seed}");
    name.chars()
        .map(|c| if c.is_ascii_alphanumeric() || "-_.=".contains(c) { c } else { '-' })
        .collect()
}
