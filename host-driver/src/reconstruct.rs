//! Depth of a recording: choose the window, rectify, match, reproject.

use std::collections::BTreeSet;
use std::ops::Range;

use stspp_matcher::{
    DisparityRange, Error as MatchError, Image, Matched, Matcher, Method, Params, Sample,
    ShapeFunction, StereoStack,
};

use crate::cpu_time::{Step, Stopwatch};
use crate::recording::{Recording, RecordingError, StereoPair};
use crate::rectify::{Canvas, DepthRange, Rectifier, RectifyError, RectifyScratch};
use crate::{DepthFrame, SlotLabel, StereoCalibration, reproject};

/// Most frames that the matcher takes.
pub const FRAMES_MAX: usize = 16;
/// Frames of a window when neither user nor recording says otherwise: the paper's.
pub const FRAMES_DEFAULT: usize = 10;

/// How a recording is reconstructed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Depths that are measured.
    pub depth: DepthRange,
    /// Size of the rectified images.
    pub canvas: Canvas,
    /// How the sub-pixel disparity is found.
    pub method: Method,
    /// Order of the shape function.
    pub shape: ShapeFunction,
    /// Half the side of the subset without its centre, 2 to 8 (for IC-GN at most 7): 4 is a subset of
    /// 9 x 9 pixels. Larger ones have less noise and less detail.
    pub subset_radius: usize,
    /// Points with a lower ZNCC are invalid.
    pub zncc_min: f32,
    /// Frames to use: all up to 16 when `None`, the first 10 of a longer recording.
    pub frames: Option<usize>,
    /// First pair to use.
    pub first: usize,
    /// Threads of the matcher; all cores when `None`.
    pub threads: Option<usize>,
    /// Whether the dense method takes depth steps as the coarse search places them, instead of letting
    /// the pixels' own grey values decide.
    pub keep_steps: bool,
}

impl Default for Options {
    fn default() -> Self {
        let params = Params::new(DisparityRange { min_px: 0, max_px: 0 });
        Self {
            depth: DepthRange::default(),
            canvas: Canvas::default(),
            method: params.method,
            shape: params.shape,
            subset_radius: params.advanced.subset_radius,
            zncc_min: params.zncc_min,
            frames: None,
            first: 0,
            threads: params.advanced.threads,
            keep_steps: !params.advanced.settle_steps,
        }
    }
}

impl Options {
    /// The rectification of a sensor's images.
    ///
    /// # Errors
    /// As [`Rectifier::new`].
    pub fn rectifier(&self, calibration: &StereoCalibration) -> Result<Rectifier, RectifyError> {
        Rectifier::with_canvas(calibration, self.depth, self.canvas)
    }

    /// The matcher's parameters for images rectified so.
    pub fn params(&self, rectifier: &Rectifier) -> Params {
        self.params_in(rectifier.disparity_range())
    }

    /// The matcher's parameters for candidate disparities.
    pub(crate) fn params_in(&self, disparity: DisparityRange) -> Params {
        let mut params = Params::new(disparity);
        params.method = self.method;
        params.shape = self.shape;
        params.zncc_min = self.zncc_min;
        params.advanced.subset_radius = self.subset_radius;
        params.advanced.threads = self.threads;
        params.advanced.settle_steps = !self.keep_steps;
        params
    }
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
    let usable = match labels {
        Some(labels) => from_whole_cycle(usable, labels, options.frames),
        None => usable,
    };
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

/// Pairs from the first one on from which a window is whole: all slots of the recording, or `frames` of
/// them, without a lost pair in between. All of them where there is no such window: then what there is of
/// a cycle has to do.
fn from_whole_cycle(usable: Vec<usize>, labels: &[SlotLabel], frames: Option<usize>) -> Vec<usize> {
    let slots: BTreeSet<u16> = usable.iter().map(|&k| labels[k].slot).collect();
    let length = frames.unwrap_or(slots.len()).max(1);
    let is_whole = |pairs: &[usize]| {
        let (first, last) = (pairs[0], pairs[length - 1]);
        labels[last].sequence - labels[first].sequence == (last - first) as u32
    };
    match usable.windows(length).position(is_whole) {
        Some(from) => usable[from..].to_vec(),
        None => usable,
    }
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

/// Reads the window of a recording that [`reconstruct`] would match, and its labels.
///
/// # Errors
/// When the recording or the window are wrong.
pub fn read_window(
    recording: &Recording,
    options: &Options,
) -> Result<(Vec<crate::recording::StereoPair>, Vec<SlotLabel>), ReconstructError> {
    let window = choose_window(recording, options)?;
    let mut raw = Vec::new();
    for run in runs(&window.pairs) {
        raw.extend(recording.read_window(run)?);
    }
    Ok((raw, window.labels))
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
    let rectifier = options.rectifier(&recording.calibration)?;
    watch.step("rectification maps");
    let stack = RectifiedStack::new(rectifier, &raw, window.labels)?;
    drop(raw);
    watch.step("rectify");

    progress("matching");
    let mut matcher = Matcher::new(options.params(&stack.rectifier))?;
    let mut matched = stack.matched(&mut matcher, 0..stack.len())?;
    watch.step("match");

    progress("reprojecting");
    let intensity = match texture {
        Some(raw) => {
            let mut canvas = stack.rectifier.canvas();
            stack.rectifier.rectify_left(&raw, &mut canvas, &mut RectifyScratch::default())?;
            reproject::mean_intensity(&[&canvas])
        }
        None => reproject::brightness(&mut matched, &stack.left.iter().collect::<Vec<_>>()),
    };
    let geometry = stack.rectifier.geometry();
    let frame = reproject::depth_frame(geometry, matched, intensity, stack.labels);
    watch.step("reproject");
    Ok(Reconstruction {
        frame,
        params: matcher.params().clone(),
        pairs: window.pairs,
        bits: recording.bits(),
        seen_pixels: stack.rectifier.seen_pixels(),
        threads: matcher.threads(),
        simd: matcher.level().name(),
        steps: watch.steps().to_vec(),
    })
}

/// Rectified pairs, ready to be matched in any number and by any method.
pub struct RectifiedStack {
    /// How they were rectified.
    pub rectifier: Rectifier,
    /// Left canvases in time order.
    pub left: Vec<Image<Sample>>,
    /// Right canvases in time order.
    pub right: Vec<Image<Sample>>,
    /// What lit each pair; empty when unknown.
    pub labels: Vec<SlotLabel>,
}

impl RectifiedStack {
    /// Rectifies pairs.
    ///
    /// # Errors
    /// For images of another size than the calibration's.
    pub fn new(
        rectifier: Rectifier,
        pairs: &[StereoPair],
        labels: Vec<SlotLabel>,
    ) -> Result<Self, RectifyError> {
        let mut scratch = RectifyScratch::default();
        let (mut left, mut right) = (Vec::new(), Vec::new());
        for pair in pairs {
            let (mut l, mut r) = (rectifier.canvas(), rectifier.canvas());
            rectifier.rectify_left(&pair.left, &mut l, &mut scratch)?;
            rectifier.rectify_right(&pair.right, &mut r, &mut scratch)?;
            left.push(l);
            right.push(r);
        }
        Ok(Self { rectifier, left, right, labels })
    }

    /// Number of pairs.
    pub fn len(&self) -> usize {
        self.left.len()
    }

    /// Whether there is no pair.
    pub fn is_empty(&self) -> bool {
        self.left.is_empty()
    }

    /// Matches pairs `window`.
    ///
    /// # Errors
    /// From the matcher.
    ///
    /// # Panics
    /// When `window` reaches beyond [`Self::len`].
    pub fn matched(
        &self,
        matcher: &mut Matcher,
        window: Range<usize>,
    ) -> Result<Matched, MatchError> {
        let left: Vec<_> = self.left[window.clone()].iter().collect();
        let right: Vec<_> = self.right[window.clone()].iter().collect();
        let times_s = self.labels.get(window).and_then(times_s);
        matcher.match_stack(&StereoStack {
            left: &left,
            right: &right,
            left_mask: Some(self.rectifier.left_mask()),
            right_mask: Some(self.rectifier.right_mask()),
            times_s: times_s.as_deref(),
        })
    }

    /// Matches pairs `window` and makes a depth frame of them.
    ///
    /// # Errors
    /// From the matcher.
    ///
    /// # Panics
    /// When `window` reaches beyond [`Self::len`].
    pub fn depth_frame(
        &self,
        matcher: &mut Matcher,
        window: Range<usize>,
    ) -> Result<DepthFrame, MatchError> {
        let mut matched = self.matched(matcher, window.clone())?;
        let left: Vec<_> = self.left[window.clone()].iter().collect();
        let labels = self.labels.get(window).map(<[_]>::to_vec).unwrap_or_default();
        let intensity = reproject::brightness(&mut matched, &left);
        Ok(reproject::depth_frame(self.rectifier.geometry(), matched, intensity, labels))
    }
}

/// Exposure centres, when the labels hold times at all.
pub(crate) fn times_s(labels: &[SlotLabel]) -> Option<Vec<f64>> {
    let times: Vec<f64> = labels.iter().map(SlotLabel::exposure_centre_s).collect();
    times.windows(2).all(|t| t[1] > t[0]).then_some(times).filter(|t| t.len() > 1)
}
