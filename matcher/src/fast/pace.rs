//! How many frames a scene in motion leaves usable.
//!
//! Over ten frames a surface may travel about 2.7 px, 12 mm/s at 1 m and 30 frames a second: beyond,
//! descriptors no longer match and rates converge to wrong values. Of half the frames it travels less
//! than half as far. Both tests look at one stack alone, so that no result depends on an earlier one.

use rayon::prelude::*;

use crate::{
    DisparityRange, Image, Level, Sample, StereoStack,
    coarse::{Coarse, CoarseMap, INVALID, is_dark},
    parallel::Share,
};

/// Travel over the frames, in px, from which on fewer frames are matched.
const TRAVEL_PX: f32 = 2.5;
/// Part of the valid pixels that must travel that far.
const TRAVEL_PART: f32 = 0.01;
/// Pixels between samples.
const GRID: usize = 16;
/// Rows that are tried with fewer frames.
const BAND: usize = 64;
/// Found part of the lit samples from which on nothing is lost...
const FOUND_PART: f32 = 0.85;
/// ...and least part of all samples that must be lit for something to be lost.
const LIT_PART: f32 = 0.02;
/// Most px between the disparities of pixels half a [`GRID`] apart on one surface.
const SLOPE_PX: u16 = 6;
/// Disparities by fewer frames that are off by more px than whole pixels explain, where the rate is
/// allowed for, and the part of them that tells that the rate is wrong.
const OFF_PX: (f32, f32) = (0.75, 4.0);
const OFF_PART: f32 = 0.25;

/// The newest `frames` of a stack in order of time.
pub(super) fn newest<'a>(stack: &StereoStack<'a>, frames: usize) -> StereoStack<'a> {
    let from = stack.frames() - frames;
    StereoStack {
        left: &stack.left[from..],
        right: &stack.right[from..],
        times_s: stack.times_s.map(|times| &times[from..]),
        ..*stack
    }
}

/// Whether surfaces travel too far over the stack's frames; the rate is in px per second, or per frame
/// where there are no times.
pub(super) fn travels(
    stack: &StereoStack<'_>,
    (disparity, rate): (&Image<f32>, Option<&Image<f32>>),
) -> bool {
    let Some(rate) = rate else { return false };
    let span = match stack.times_s {
        Some([first, .., last]) => (last - first).abs() as f32,
        _ => stack.frames().saturating_sub(1) as f32,
    };
    let (mut valid, mut far) = (0, 0);
    for (rate, d) in rate.as_slice().iter().zip(disparity.as_slice()).step_by(5) {
        valid += u32::from(!d.is_nan());
        far += u32::from(!d.is_nan() && rate.abs() * span > TRAVEL_PX);
    }
    far as f32 > TRAVEL_PART * valid as f32
}

/// A match of a few rows with fewer frames; keeps its buffers.
#[derive(Debug)]
pub(super) struct Trial {
    coarse: Coarse,
    map: CoarseMap,
    left: Vec<Image<Sample>>,
    right: Vec<Image<Sample>>,
    /// Per band: lit samples, and those of them that are found.
    bands: Vec<(usize, usize)>,
}

impl Trial {
    pub fn new(level: Level, range: DisparityRange) -> Self {
        Self {
            coarse: Coarse::new(level, range),
            map: CoarseMap::new(0, 0),
            left: Vec::new(),
            right: Vec::new(),
            bands: Vec::new(),
        }
    }

    /// Whether much of what the images show lit is lost, and fewer frames, `fewer`, would find far more
    /// of it, or find it elsewhere: tried on the rows that lost most.
    pub fn loses(
        &mut self,
        stack: &StereoStack<'_>,
        fewer: &StereoStack<'_>,
        (disparity, rate): (&Image<f32>, Option<&Image<f32>>),
    ) -> bool {
        let (width, height) = (stack.width(), stack.height());
        let lit = |y: usize, x: usize| !is_dark(stack.left, x, y);
        self.bands.clear();
        self.bands.resize(height.div_ceil(BAND), (0, 0));
        self.bands.par_iter_mut().enumerate().share(|(band, (seen, found))| {
            let rows = band * BAND..((band + 1) * BAND).min(height);
            for y in rows.skip(GRID / 2).step_by(GRID) {
                for x in (GRID / 2..width).step_by(GRID) {
                    // What is found is lit: the images are looked at only where nothing is.
                    let here = !disparity.row(y)[x].is_nan();
                    *found += usize::from(here);
                    *seen += usize::from(here || lit(y, x));
                }
            }
        });
        let sum =
            |of: fn(&(usize, usize)) -> usize| self.bands.iter().map(of).sum::<usize>() as f32;
        let (seen, found) = (sum(|b| b.0), sum(|b| b.1));
        let samples = (width / GRID * (height / GRID)) as f32;
        if seen < LIT_PART * samples || found >= FOUND_PART * seen {
            return false;
        }
        let most = self.bands.iter().enumerate().max_by_key(|(_, (seen, found))| seen - found);
        let Some((band, &(seen, found))) = most else { return false };
        // As many rows for the last band, so that buffers keep their size.
        let count = BAND.min(height);
        let top = (band * BAND).min(height - count);
        copy_rows(fewer.left, (top, count), &mut self.left);
        copy_rows(fewer.right, (top, count), &mut self.right);
        let frames = fewer.frames();
        let (left, right): ([_; 16], [_; 16]) = (
            std::array::from_fn(|k| &self.left[k.min(frames - 1)]),
            std::array::from_fn(|k| &self.right[k.min(frames - 1)]),
        );
        let part = StereoStack::new(&left[..frames], &right[..frames]);
        self.coarse.describe(&part);
        self.coarse.search(&part, true, &mut self.map);
        // The mean of the fewer frames' times against the newest.
        let mean_time = match fewer.times_s {
            Some(times) => {
                let newest = times.last().copied().unwrap_or(0.0);
                times.iter().map(|t| t - newest).sum::<f64>() as f32 / times.len() as f32
            }
            None => -0.5 * frames.saturating_sub(1) as f32,
        };
        let (mut again, mut both, mut off) = (0, 0, 0);
        let rows = (GRID / 2..height).step_by(GRID).filter(|y| y / BAND == band);
        for y in rows {
            for x in (GRID / 2..width).step_by(GRID).filter(|&x| lit(y, x)) {
                let (now, before) = (self.map.disparity.row(y - top)[x], disparity.row(y)[x]);
                if now == INVALID {
                    continue;
                }
                // Where the surface is out of range, or out of the right image's sight, few frames find
                // something else for every other pixel: it does not hang together.
                let beside = self.map.disparity.row(y - top)[x.saturating_sub(GRID / 2)];
                let surface = beside != INVALID && now.abs_diff(beside) <= SLOPE_PX;
                again += usize::from(surface);
                let moved = rate.map_or(0.0, |rate| rate.row(y)[x]) * mean_time;
                let apart = (f32::from(now) - before - moved).abs();
                both += usize::from(apart < OFF_PX.1);
                off += usize::from(apart > OFF_PX.0 && apart < OFF_PX.1);
            }
        }
        again > 2 * found + seen / 4 || off as f32 > OFF_PART * both.max(8) as f32
    }
}

/// Copies `count` rows from `top` of each image.
fn copy_rows(
    images: &[&Image<Sample>],
    (top, count): (usize, usize),
    rows: &mut Vec<Image<Sample>>,
) {
    let width = images[0].width();
    if rows.first().is_some_and(|r| (r.width(), r.height()) != (width, count)) {
        rows.clear();
    }
    while rows.len() < images.len() {
        rows.push(Image::new(width, count, 0));
    }
    for (to, image) in rows.iter_mut().zip(images) {
        let from = &image.as_slice()[top * width..][..count * width];
        to.as_mut_slice().copy_from_slice(from);
    }
}
