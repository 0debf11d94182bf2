//! Motion: the rate of the disparity per pixel, and disparities that refer to the newest frame's time.
//!
//! Both images of a pair are taken at one instant, so that a moving surface obeys
//! d(x, t_k) = d(x) + v(x) t_k frame by frame. A fit that takes d for constant returns its mean over
//! the window's frames, weighted by where in time a pixel's dots happened to shine: for 2 px of
//! travel over ten frames that scatters by a tenth of a pixel. With b_t and S_t = I_t^2 of the dense
//! fit ([`super`]) the rate obeys the 2 x 2 system
//!
//! ```text
//! | sum S    sum S t   | | shift |              | sum b   |
//! | sum S t  sum S t^2 | | v     | = -(1 - w_x) | sum b t |
//! ```
//!
//! summed over a wide window, since v is smooth. The steps:
//!
//! 1. `along`: the sums above per block of 16 x 16 pixels, from every fourth row, made by the fit
//!    itself; where they show motion `sums`, which does the same for any disparities and rates;
//! 2. `rates`: a plane through the rates of the blocks around that move alike, its significance, and
//!    from both the rate per pixel. Without significant motion nothing more is done, and the rate is
//!    zero: a scene at rest pays neither noise nor much time;
//! 3. where there is motion: the sums again with each frame warped at its own place, then the fit
//!    itself that way, referred to the newest frame;
//! 4. the sums once more; what they add to the rate moves the disparity by that much.

pub(super) mod along;
mod lag;
mod rates;
pub(super) mod sums;
mod weight;

use super::{DenseFit, DenseMaps, warp::moving};
use crate::{Image, Level, ShapeFunction, StereoStack};
use rates::Rates;
use sums::{Blocks, Frame};

/// Pixels of a block's side.
pub(crate) const BLOCK: usize = 16;
/// Fewest frames whose motion is estimated.
pub(crate) const FRAMES_MIN: usize = 3;
/// Rounds of the rate before the fit: the first one sees frames up to a pixel off.
const ROUNDS: usize = 2;

/// When the frames were taken, in frame intervals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Times {
    /// Against the newest frame, at most zero but in a stack that is not in order.
    pub to_newest: [f32; 16],
    /// Against the frames' mean, scaled to -1..=1.
    pub centred: [f32; 16],
    /// Frame intervals that one unit of `centred` stands for.
    pub unit: f32,
    /// The mean against the newest frame.
    pub mean: f32,
    /// Mean interval in seconds, where times are known.
    pub interval_s: Option<f64>,
    /// Number of frames.
    pub frames: usize,
}

impl Times {
    /// Of a checked stack; `None` where its frames do not span time.
    pub fn of(stack: &StereoStack<'_>) -> Option<Self> {
        let frames = stack.frames();
        if frames < FRAMES_MIN {
            return None;
        }
        let even: [f64; 16] = std::array::from_fn(|k| k as f64);
        let times = stack.times_s.unwrap_or(&even[..frames]);
        let newest = times.iter().copied().fold(f64::MIN, f64::max);
        let oldest = times.iter().copied().fold(f64::MAX, f64::min);
        let interval = (newest - oldest) / (frames - 1) as f64;
        if !(interval > 0.0 && interval.is_finite()) {
            return None;
        }
        let at = |k: usize| times.get(k).map_or(0.0, |t| (t - newest) / interval);
        let mean = (0..frames).map(at).sum::<f64>() / frames as f64;
        let unit = (0..frames).map(|k| (at(k) - mean).abs()).fold(0.0, f64::max);
        Some(Self {
            to_newest: std::array::from_fn(|k| at(k) as f32),
            centred: std::array::from_fn(|k| {
                if k < frames { ((at(k) - mean) / unit) as f32 } else { 0.0 }
            }),
            unit: unit as f32,
            mean: mean as f32,
            interval_s: stack.times_s.map(|_| interval),
            frames,
        })
    }
}

/// A fit's motion: what the warp of each frame needs.
#[derive(Debug, Clone)]
pub(crate) struct Motion {
    /// Rate of the disparity in px per frame interval; zero at rest.
    pub rate: Image<f32>,
    /// Each frame's time against that of the disparities.
    pub offsets: [f32; 16],
    /// Number of frames.
    pub frames: usize,
}

impl Motion {
    /// The warp's part of a row; `None` where nothing of it moves. `rate` is scratch.
    pub fn of_row<'a>(
        &'a self,
        y: usize,
        (x0, x1): (usize, usize),
        len: usize,
        rate: &'a mut Vec<f32>,
    ) -> Option<moving::Moving<'a>> {
        let row = &self.rate.row(y)[x0..x1];
        if row.iter().all(|v| *v == 0.0) {
            return None;
        }
        rate.clear();
        rate.extend_from_slice(row);
        rate.resize(len, 0.0);
        Some(moving::Moving { rate, offsets: &self.offsets[..self.frames] })
    }
}

/// What the sums of a frame have in common.
struct Maker<'a> {
    level: Level,
    stack: &'a StereoStack<'a>,
    step: &'a Image<u8>,
    times: &'a Times,
}

impl<'a> Maker<'a> {
    /// Sums at the disparities of a fit that took the scene for still with windows of radius `smeared`,
    /// or that knew how it moves.
    fn of<'b>(
        &'b self,
        disparity_px: &'b Image<f32>,
        zncc: &'b Image<f32>,
        smeared: Option<usize>,
    ) -> Frame<'b>
    where
        'a: 'b,
    {
        let Self { level, stack, step, times } = *self;
        Frame { level, stack, step, times, disparity_px, zncc, smeared }
    }
}

/// Estimates motion; keeps its buffers between frames.
#[derive(Debug)]
pub struct MotionFit {
    level: Level,
    blocks: Blocks,
    rates: Rates,
    motion: Motion,
    start: Image<f32>,
    /// The rate that was found last.
    found: Image<f32>,
    /// Whether anything moved then.
    moves: bool,
    moving: Image<bool>,
}

impl MotionFit {
    /// A fit at rest.
    pub fn new(level: Level) -> Self {
        let rate = Image::new(0, 0, 0.0);
        Self {
            level: level.usable(),
            blocks: Blocks::default(),
            rates: Rates::default(),
            motion: Motion { rate, offsets: [0.0; 16], frames: 0 },
            start: Image::new(0, 0, f32::NAN),
            found: Image::new(0, 0, 0.0),
            moves: false,
            moving: Image::new(0, 0, false),
        }
    }

    /// Looks for motion in the disparities of a fit (`maps`, which `fit` has made of `start` and
    /// `step`). Where there is some, the fit is made again, each frame at its own place, and `maps`
    /// then refers to the newest frame's time. Gives the rate per pixel in px per second, or per frame
    /// interval where the stack has no times; `None` when nothing moves.
    pub fn run(
        &mut self,
        stack: &StereoStack<'_>,
        fit: &mut DenseFit,
        start: &Image<f32>,
        step: &Image<u8>,
        maps: &mut DenseMaps,
    ) -> Option<&Image<f32>> {
        self.moves = false;
        let times = Times::of(stack)?;
        let (width, height) = (stack.width(), stack.height());
        if (self.start.width(), self.start.height()) != (width, height) {
            self.start = Image::new(width, height, f32::NAN);
            self.motion.rate = Image::new(width, height, 0.0);
            self.found = Image::new(width, height, 0.0);
        }
        self.motion.frames = times.frames;
        self.motion.offsets = std::array::from_fn(|k| times.centred[k] * times.unit);
        let frame = Maker { level: self.level, stack, step, times: &times };
        // The first order's bias on curved surfaces would look like motion.
        let both = fit.shape != ShapeFunction::First;
        let best = if both { &maps.second_px } else { &maps.first_px };
        // What the fit saw along its way tells whether there is anything to look at more closely.
        if let Some(seen) = fit.seen() {
            self.rates.begin();
            self.rates.add(seen, &times);
            if !self.rates.any() {
                return None;
            }
        }
        self.blocks.sum(&frame.of(best, &maps.zncc, None), None);
        self.rates.begin();
        self.rates.add(&self.blocks, &times);
        if !self.rates.any() {
            return None;
        }
        for _ in 0..ROUNDS {
            self.rates.expand(&self.blocks, &maps.first_px, &mut self.motion.rate);
            let smeared = Some(fit.radius);
            self.blocks.sum(&frame.of(&maps.first_px, &maps.zncc, smeared), Some(&self.motion));
            self.rates.add(&self.blocks, &times);
        }
        self.rates.expand(&self.blocks, &maps.first_px, &mut self.motion.rate);
        self.motion.offsets = times.to_newest;
        self.begin(start, maps, &times);
        self.rates.moving(&mut self.moving);
        fit.refit(stack, &self.start, step, Some(&self.motion), &self.moving, maps);

        let best = if both { &maps.second_px } else { &maps.first_px };
        self.blocks.sum(&frame.of(best, &maps.zncc, None), Some(&self.motion));
        self.rates.add(&self.blocks, &times);
        // The fit stands for the frames' mean, whatever rate it was made with.
        self.rates.expand(&self.blocks, &maps.first_px, &mut self.found);
        let rates = self.found.as_mut_slice().iter_mut().zip(self.motion.rate.as_slice());
        let fits = maps.first_px.as_mut_slice().iter_mut().zip(maps.second_px.as_mut_slice());
        let scale = times.interval_s.map_or(1.0, |s| (1.0 / s) as f32);
        for ((rate, before), (first, second)) in rates.zip(fits) {
            let shift = (*rate - before) * -times.mean;
            *first += shift;
            *second += shift;
            *rate *= scale;
        }
        self.moves = true;
        self.found()
    }

    /// What the last [`MotionFit::run`] gave.
    pub fn found(&self) -> Option<&Image<f32>> {
        self.moves.then_some(&self.found)
    }

    /// The start of the second fit, at the newest frame's time.
    fn begin(&mut self, start: &Image<f32>, maps: &DenseMaps, times: &Times) {
        let found = maps.first_px.as_slice().iter().zip(start.as_slice());
        let to = self.start.as_mut_slice().iter_mut().zip(self.motion.rate.as_slice());
        for ((to, rate), (&found, &start)) in to.zip(found) {
            let near = (found - start).abs() < 2.0;
            *to = if near { found } else { start } - rate * times.mean;
        }
    }
}
