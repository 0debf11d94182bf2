//! Depth of a recording: choose the window, rectify, match, reproject.

use std::ops::Range;

use stspp_matcher::{Error as MatchError, Matcher, Method, Params, ShapeFunction, StereoStack};

use crate::cpu_time::{Step, Stopwatch};
use crate::recording::{Recording, RecordingError};
use crate::rectify::{DepthRange, Rectifier, RectifyError, RectifyScratch};
use crate::{DepthFrame, SlotLabel, reproject};

/// Most frames that the matcher takes.
pub const FRAMES_MAX: usize = 16;
/// Frames of a window when neither user nor recording says otherwise: the paper's.
pub const FRAMES_DEFAULT: usize = 10;

/// How a recording is reconstructed.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Options {
    /// Depths that are measured.
    pub depth: DepthRange,
    /// How the sub-pixel disparity is found.
    pub method: Method,
    /// Order of the shape function.
    pub shape: ShapeFunction,
    /// Frames to use: all up to 16 when `None`, the first 10 of a longer recording.
    pub frames: Option<usize>,
    /// First pair to use.
    pub first: usize,
    /// Threads of the matcher; all cores when `None`.
    pub threads: Option<usize>,
}

/// Why a recording has no depth.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReconstructError {
    /// The recording is wrong.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The images cannot be rectified.
    #[error(transparent)]
    Rectify(#[from] RectifyError),
    /// The stack cannot be matched.
    #[error(transparent)]
    Match(#[from] MatchError),
    /// The recording has not the window that was asked for.
    #[error("{}: window: expected {expected}, got {got}", folder.display())]
    Window {
        /// The recording's folder.
        folder: std::path::PathBuf,
        /// What the window has to be.
        expected: String,
        /// What it is.
        got: String,
    },
}

/// A depth frame and how it came about.
#[derive(Debug)]
pub struct Reconstruction {
    /// The depth frame.
    pub frame: DepthFrame,
    /// The matcher's parameters.
    pub params: Params,
    /// The pairs that were matched.
    pub pairs: Vec<usize>,
    /// Significant bits of the images.
    pub bits: u8,
    /// Canvas pixels that the left camera saw.
    pub seen_pixels: usize,
    /// Threads of the matcher.
    pub threads: usize,
    /// SIMD level of the matcher.
    pub simd: &'static str,
    /// Wall and CPU time of reading, rectifying, matching and reprojecting.
    pub steps: Vec<Step>,
}

/// The pairs to match, and one lit by the floodlight alone if there is any.
#[derive(Debug)]
struct Window {
    pairs: Vec<usize>,
    labels: Vec<SlotLabel>,
    floodlit: Option<usize>,
}

fn choose_window(recording: &Recording, options: &Options) -> Result<Window, ReconstructError> {
    let error = |expected: String, got: String| {
        let folder = recording.folder().to_owned();
        Err(ReconstructError::Window { folder, expected, got })
    };
    let labels = recording.labels.as_deref();
    let texture_only = |k: &usize| {
        labels.is_some_and(|labels| labels[*k].floodlight && labels[*k].projector_mask == 0)
    };
    let floodlit = (0..recording.len()).find(texture_only);
    let usable: Vec<usize> =
        (options.first..recording.len()).filter(|k| !texture_only(k)).collect();
    if usable.is_empty() {
        let expected = "at least one pair lit by projectors".into();
        return error(expected, format!("none from pair {} on", options.first));
    }
    // A slot that comes again ends the window: the timing's period.
    let period = labels.map_or(usable.len(), |labels| {
        let slot = |n: usize| labels[usable[n]].slot;
        (1..usable.len()).find(|&n| (0..n).any(|k| slot(k) == slot(n))).unwrap_or(usable.len())
    });
    let count = match options.frames {
        Some(frames) if !(1..=FRAMES_MAX).contains(&frames) => {
            return error(format!("1 to {FRAMES_MAX} frames"), frames.to_string());
        }
        Some(frames) if frames > usable.len() => {
            return error(format!("{frames} pairs of images"), usable.len().to_string());
        }
        Some(frames) if frames > period => {
            let got = format!("slot {} again", labels.map_or(0, |l| l[usable[period]].slot));
            return error(format!("{frames} different slots from pair {}", options.first), got);
        }
        Some(frames) => frames,
        None if period <= FRAMES_MAX => period,
        None => FRAMES_DEFAULT,
    };
    let pairs = usable[..count].to_vec();
    let labels = labels.map_or_else(Vec::new, |l| pairs.iter().map(|&k| l[k]).collect());
    Ok(Window { pairs, labels, floodlit })
}

/// Runs of consecutive numbers.
fn runs(numbers: &[usize]) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for &number in numbers {
        match runs.last_mut() {
            Some(run) if run.end == number => run.end += 1,
            _ => runs.push(number..number + 1),
        }
    }
    runs
}

/// Reconstructs a window of a recording. `progress` is told what begins.
///
/// # Errors
/// When the recording, the window or the parameters are wrong.
pub fn reconstruct(
    recording: &Recording,
    options: &Options,
    progress: &mut dyn FnMut(&'static str),
) -> Result<Reconstruction, ReconstructError> {
    let mut watch = Stopwatch::default();
    let window = choose_window(recording, options)?;
    progress("reading");
    let mut raw = Vec::new();
    for run in runs(&window.pairs) {
        raw.extend(recording.read_window(run)?);
    }
    let texture = match window.floodlit {
        Some(index) => Some(recording.read_pair(index)?.left),
        None => None,
    };
    watch.step("read");

    progress("rectifying");
    let rectifier = Rectifier::new(&recording.calibration, options.depth)?;
    watch.step("rectification maps");
    let mut scratch = RectifyScratch::default();
    let (mut left, mut right) = (Vec::new(), Vec::new());
    for pair in raw {
        let (mut l, mut r) = (rectifier.canvas(), rectifier.canvas());
        rectifier.rectify_left(&pair.left, &mut l, &mut scratch)?;
        rectifier.rectify_right(&pair.right, &mut r, &mut scratch)?;
        left.push(l);
        right.push(r);
    }
    let left: Vec<_> = left.iter().collect();
    let right: Vec<_> = right.iter().collect();
    watch.step("rectify");

    progress("matching");
    let mut params = Params::new(rectifier.disparity_range());
    params.method = options.method;
    params.shape = options.shape;
    params.advanced.threads = options.threads;
    let mut matcher = Matcher::new(params)?;
    let times_s = times_s(&window.labels);
    let stack = StereoStack {
        left: &left,
        right: &right,
        left_mask: Some(rectifier.left_mask()),
        right_mask: Some(rectifier.right_mask()),
        times_s: times_s.as_deref(),
    };
    let matched = matcher.match_stack(&stack)?;
    watch.step("match");

    progress("reprojecting");
    let intensity = match texture {
        Some(raw) => {
            let mut canvas = rectifier.canvas();
            rectifier.rectify_left(&raw, &mut canvas, &mut scratch)?;
            reproject::mean_intensity(&[&canvas])
        }
        None => reproject::mean_intensity(&left),
    };
    let frame = reproject::depth_frame(rectifier.geometry(), matched, intensity, window.labels);
    watch.step("reproject");
    Ok(Reconstruction {
        frame,
        params: matcher.params().clone(),
        pairs: window.pairs,
        bits: recording.bits(),
        seen_pixels: rectifier.left_mask().as_slice().iter().filter(|seen| **seen != 0).count(),
        threads: matcher.threads(),
        simd: matcher.level().name(),
        steps: watch.steps().to_vec(),
    })
}

/// Exposure centres, when the labels hold times at all.
pub(crate) fn times_s(labels: &[SlotLabel]) -> Option<Vec<f64>> {
    let times: Vec<f64> = labels.iter().map(SlotLabel::exposure_centre_s).collect();
    times.windows(2).all(|t| t[1] > t[0]).then_some(times).filter(|t| t.len() > 1)
}
