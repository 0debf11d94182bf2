//! The matching thread: rectify the newest pair, keep the window, match when it is complete.

use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::{Receiver, SendTimeoutError, Sender};
use stspp_matcher::{Image, Matcher, Params, Sample, ShapeFunction, StereoStack};

use super::budget::Budget;
use super::stats::{Mark, Progress};
use super::stream::StopHandle;
use super::{LabelledPair, PAIR_QUEUE};
use crate::clock::Clock;
use crate::error::Error;
use crate::reconstruct::{FRAMES_DEFAULT, FRAMES_MAX, Options};
use crate::rectify::{Rectifier, RectifyScratch};
use crate::sync::window::{SlotLight, Step, Window};
use crate::{DepthFrame, ProjectionTiming, SlotLabel, StereoCalibration, reproject};

/// How often a full queue is tried again, and the stop flag looked at.
const RETRY: Duration = Duration::from_millis(20);

/// A rectified pair of the window.
struct Rectified {
    left: Image<Sample>,
    right: Image<Sample>,
}

/// How a stream matches.
#[derive(Debug, Clone)]
pub struct MatchInfo {
    /// The matcher's parameters.
    pub params: Params,
    /// Threads of the matcher.
    pub threads: usize,
    /// SIMD level of the matcher.
    pub simd: &'static str,
    /// Canvas pixels that the left camera sees: what completeness is a part of.
    pub seen_pixels: usize,
    /// Canvas pixels that the left camera sees (non-zero).
    pub left_mask: Image<u8>,
}

/// Slots of a cycle, and which of them are matched.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Cycle {
    pub slots: Vec<SlotLight>,
    pub used: Vec<bool>,
    /// Time between two windows; zero where it is not known.
    pub period: Duration,
}

impl Cycle {
    /// The cycle of a timing: slots with speckle are matched.
    pub fn of(timing: &ProjectionTiming) -> Self {
        let slots: Vec<_> = timing
            .slots
            .iter()
            .map(|s| SlotLight { projector_mask: s.projector_mask, floodlight: s.floodlight })
            .collect();
        let used = slots.iter().map(|slot| slot.is_speckle()).collect();
        let period = Duration::from_micros(u64::from(timing.frame_period_us));
        Self { slots, used, period }
    }
}

/// Makes depth frames of labelled pairs, one window at a time.
pub(crate) struct DepthEngine {
    rectifier: Rectifier,
    matcher: Matcher,
    scratch: RectifyScratch,
    window: Window<Rectified>,
    generation: Option<u16>,
    frames: Option<usize>,
    texture: Option<Image<Sample>>,
    spare: Vec<Rectified>,
    sequence: u64,
    with_labels: bool,
    /// Order of the shape function at full quality.
    shape: ShapeFunction,
}

impl DepthEngine {
    pub fn new(calibration: &StereoCalibration, options: &Options) -> Result<Self, Error> {
        let rectifier = options.rectifier(calibration)?;
        let params = options.params(&rectifier);
        if let Some(frames) = options.frames.filter(|frames| !(1..=FRAMES_MAX).contains(frames)) {
            return Err(stspp_matcher::Error::FrameCount { frames }.into());
        }
        Ok(Self {
            rectifier,
            matcher: Matcher::new(params)?,
            scratch: RectifyScratch::default(),
            window: Window::new(Vec::new(), 0),
            generation: None,
            frames: options.frames,
            texture: None,
            spare: Vec::new(),
            sequence: 0,
            with_labels: true,
            shape: options.shape,
        })
    }

    /// Leaves labels and times out of the depth frames: the source has none.
    pub fn without_labels(mut self) -> Self {
        self.with_labels = false;
        self
    }

    /// What is known before the first frame.
    pub fn info(&self) -> MatchInfo {
        let left_mask = self.rectifier.left_mask().clone();
        MatchInfo {
            params: self.matcher.params().clone(),
            threads: self.matcher.threads(),
            simd: self.matcher.level().name(),
            seen_pixels: left_mask.as_slice().iter().filter(|seen| **seen != 0).count(),
            left_mask,
        }
    }

    /// Starts over with pairs of another timing.
    pub fn set_cycle(&mut self, generation: u16, cycle: Cycle) {
        let used = cycle.used.iter().filter(|used| **used).count();
        let most = if used <= FRAMES_MAX { used } else { FRAMES_DEFAULT };
        let length = self.frames.unwrap_or(most);
        self.window = Window::with_used(cycle.slots, cycle.used, length);
        self.generation = Some(generation);
        self.texture = None;
    }

    pub fn generation(&self) -> Option<u16> {
        self.generation
    }

    /// Rectifies a pair into the window. [`Step::Complete`] when it can be matched.
    pub fn push(&mut self, pair: &LabelledPair) -> Result<Step, Error> {
        let step = self.window.check(&pair.label);
        if step == Step::Mislabelled {
            self.window.clear();
            return Ok(step);
        }
        let label = pair.label;
        if step == Step::NotSpeckle || (label.floodlight && label.projector_mask == 0) {
            if label.floodlight {
                let mut canvas = self.texture.take().unwrap_or_else(|| self.rectifier.canvas());
                self.rectifier.rectify_left(&pair.left, &mut canvas, &mut self.scratch)?;
                self.texture = Some(canvas);
            }
            return Ok(self.window.push(label, Rectified::empty()));
        }
        let mut rectified = self.spare.pop().unwrap_or_else(|| Rectified {
            left: self.rectifier.canvas(),
            right: self.rectifier.canvas(),
        });
        let Self { rectifier, scratch, matcher, .. } = self;
        matcher.pool().frame(|| {
            rectifier.rectify_left(&pair.left, &mut rectified.left, scratch)?;
            rectifier.rectify_right(&pair.right, &mut rectified.right, scratch)
        })?;
        Ok(self.window.push(label, rectified))
    }

    /// Goes over to the first-order shape function, or back.
    pub fn set_reduced(&mut self, reduced: bool) {
        self.matcher.set_shape(if reduced { ShapeFunction::First } else { self.shape });
    }

    /// Matches the complete window.
    pub fn match_window(&mut self) -> Result<DepthFrame, Error> {
        let pool = self.matcher.pool().clone();
        pool.frame(|| self.depth_frame())
    }

    fn depth_frame(&mut self) -> Result<DepthFrame, Error> {
        let labels: Vec<SlotLabel> = self.window.pairs().map(|(label, _)| *label).collect();
        let left: Vec<_> = self.window.pairs().map(|(_, pair)| &pair.left).collect();
        let right: Vec<_> = self.window.pairs().map(|(_, pair)| &pair.right).collect();
        let times_s = crate::reconstruct::times_s(&labels).filter(|_| self.with_labels);
        let stack = StereoStack {
            left: &left,
            right: &right,
            left_mask: Some(self.rectifier.left_mask()),
            right_mask: Some(self.rectifier.right_mask()),
            times_s: times_s.as_deref(),
        };
        let mut matched = self.matcher.match_stack(&stack)?;
        let intensity = match &self.texture {
            Some(texture) => reproject::mean_intensity(&[texture]),
            None => reproject::brightness(&mut matched, &left),
        };
        let labels = if self.with_labels { labels } else { Vec::new() };
        let mut frame =
            reproject::depth_frame(self.rectifier.geometry(), matched, intensity, labels);
        frame.sequence = self.sequence;
        self.sequence += 1;
        Ok(frame)
    }
}

impl Rectified {
    fn empty() -> Self {
        Self { left: Image::new(0, 0, 0), right: Image::new(0, 0, 0) }
    }
}

/// Looks up the cycle of a generation.
pub(crate) type Cycles = Box<dyn Fn(u16) -> Option<Cycle> + Send>;

pub(crate) struct MatchThread {
    pub engine: DepthEngine,
    pub input: Receiver<Result<LabelledPair, Error>>,
    pub out: Sender<Result<DepthFrame, Error>>,
    /// The other end of `out`, to make room in.
    pub oldest: Receiver<Result<DepthFrame, Error>>,
    pub cycles: Cycles,
    pub progress: Arc<Progress>,
    pub clock: Arc<dyn Clock>,
    pub stop: StopHandle,
    pub lossless: bool,
    pub live: bool,
    /// Windows skipped since the last match.
    pub skipped_in_row: usize,
    /// What gives when the machine is too slow.
    pub budget: Budget,
}

impl MatchThread {
    /// Runs until pairing ends or nobody takes depth frames any more.
    pub fn run(mut self) {
        while let Ok(pair) = self.input.recv() {
            let going_on = match pair {
                Ok(pair) => {
                    let going_on = self.take(&pair);
                    self.progress.end_work();
                    going_on
                }
                Err(error) => self.send(Err(error)),
            };
            if !going_on {
                return;
            }
        }
    }

    fn take(&mut self, pair: &LabelledPair) -> bool {
        if self.engine.generation() != Some(pair.timing_generation) {
            match (self.cycles)(pair.timing_generation) {
                Some(cycle) => {
                    self.budget.set_period(cycle.period);
                    self.engine.set_cycle(pair.timing_generation, cycle);
                }
                None => {
                    self.progress.count(|s| s.pairs_mislabelled += 1);
                    return true;
                }
            }
        }
        let step = match self.engine.push(pair) {
            Ok(step) => step,
            Err(error) => return self.send(Err(error)),
        };
        match step {
            Step::Mislabelled => self.progress.count(|s| s.pairs_mislabelled += 1),
            Step::Gap { .. } => self.progress.count(|s| s.window_gaps += 1),
            Step::Filling | Step::NotSpeckle => {}
            Step::Complete => return self.complete(pair),
        }
        true
    }

    fn complete(&mut self, pair: &LabelledPair) -> bool {
        self.progress.count(|s| s.windows += 1);
        // When a newer pair waits already, this window is late: the newest is matched. A machine on which
        // one always waits matches now and then all the same; so does one that cannot even rectify in
        // time: when its queue fills, pairs will be dropped, and this may be the last complete window.
        let waiting = self.input.len();
        let newer_is_sure = (1..PAIR_QUEUE / 2).contains(&waiting);
        if !self.lossless && newer_is_sure && self.skipped_in_row < PAIR_QUEUE {
            self.skipped_in_row += 1;
            self.progress.count(|s| s.skipped_windows += 1);
            return true;
        }
        if !self.lossless && !self.budget.admit(pair.label.sequence) {
            self.progress.count(|s| s.skipped_windows += 1);
            return true;
        }
        self.skipped_in_row = 0;
        let reduced = !self.lossless && self.budget.is_reduced();
        self.engine.set_reduced(reduced);
        let begun = std::time::Instant::now();
        let frame = self.engine.match_window();
        let took = begun.elapsed();
        self.budget.record(took);
        self.progress.count(|s| {
            s.match_ms = took.as_secs_f64() * 1e3;
            s.over_budget += u64::from(self.budget.is_over(took));
            s.reduced_frames += u64::from(reduced);
            s.match_every = if self.lossless { 1 } else { self.budget.every() };
        });
        self.progress.mark(Mark::Window, self.clock.now_ns());
        match frame {
            Ok(mut frame) => {
                let since_pair = pair.paired_at.elapsed();
                frame.arrived = self
                    .live
                    .then(|| std::time::SystemTime::now().checked_sub(since_pair))
                    .flatten();
                self.progress.publish(pair.arrival_delay + since_pair);
                self.send(Ok(frame))
            }
            Err(error) => self.send(Err(error)),
        }
    }

    /// Hands a result to the user. This thread holds a receiver too, so that the stop flag, not a
    /// closed queue, tells that nobody listens.
    fn send(&self, mut item: Result<DepthFrame, Error>) -> bool {
        while !self.stop.is_stopped() {
            match self.out.send_timeout(item, if self.lossless { RETRY } else { Duration::ZERO }) {
                Ok(()) => return true,
                Err(SendTimeoutError::Disconnected(_)) => return false,
                Err(SendTimeoutError::Timeout(back)) => item = back,
            }
            if !self.lossless && self.oldest.try_recv().is_ok() {
                self.progress.count(|s| s.dropped_depth += 1);
            }
        }
        self.progress.count(|s| s.dropped_depth += u64::from(item.is_ok()));
        false
    }
}
