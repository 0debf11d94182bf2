//! How many frames a scene in motion leaves usable.
//!
//! Over ten frames a surface may travel about 2.7 px, 12 mm/s at 1 m and 30 frames a second: beyond,
//! descriptors no longer match and rates converge to wrong values. Of half the frames it travels less
//! than half as far. Both tests look at one stack alone, so that no result depends on an earlier one.

use crate::{
    DisparityRange, Image, Level, Sample, StereoStack,
    coarse::{Coarse, CoarseMap, INVALID, is_dark},
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

/// Whether much of what the images show lit is lost, and fewer frames, `fewer`, would find far more of
/// it, or find it elsewhere: tried on the rows that lost most.
pub(super) fn loses(
    level: Level,
    range: DisparityRange,
    stack: &StereoStack<'_>,
    fewer: &StereoStack<'_>,
    (disparity, rate): (&Image<f32>, Option<&Image<f32>>),
) -> bool {
    let (width, height) = (stack.width(), stack.height());
    let lit = |y: usize, x: usize| !is_dark(stack.left, x, y);
    // Per band: lit samples, and those of them that are found.
    let mut bands = vec![(0usize, 0usize); height.div_ceil(BAND)];
    for y in (GRID / 2..height).step_by(GRID) {
        let (seen, found) = &mut bands[y / BAND];
        for x in (GRID / 2..width).step_by(GRID).filter(|&x| lit(y, x)) {
            *seen += 1;
            *found += usize::from(!disparity.row(y)[x].is_nan());
        }
    }
    let sum = |of: fn(&(usize, usize)) -> usize| bands.iter().map(of).sum::<usize>() as f32;
    let (seen, found) = (sum(|b| b.0), sum(|b| b.1));
    let samples = (width / GRID * (height / GRID)) as f32;
    if seen < LIT_PART * samples || found >= FOUND_PART * seen {
        return false;
    }
    let most = bands.iter().enumerate().max_by_key(|(_, (seen, found))| seen - found);
    let Some((band, &(seen, found))) = most else { return false };
    let rows = band * BAND..((band + 1) * BAND).min(height);
    let crop = |images: &[&Image<Sample>]| -> Vec<Image<Sample>> {
        let part = |image: &&Image<Sample>| {
            let pixels = image.as_slice()[rows.start * width..rows.end * width].to_vec();
            Image::from_vec(width, rows.len(), pixels)
        };
        images.iter().filter_map(part).collect()
    };
    let (left, right) = (crop(fewer.left), crop(fewer.right));
    let (left, right): (Vec<_>, Vec<_>) = (left.iter().collect(), right.iter().collect());
    let part = StereoStack::new(&left, &right);
    let (mut coarse, mut map) = (Coarse::new(level, range), CoarseMap::new(0, 0));
    coarse.describe(&part);
    coarse.search(&part, true, &mut map);
    // The mean of the fewer frames' times against the newest.
    let mean_time = match fewer.times_s {
        Some(times) => {
            let newest = times.last().copied().unwrap_or(0.0);
            times.iter().map(|t| t - newest).sum::<f64>() as f32 / times.len() as f32
        }
        None => -0.5 * fewer.frames().saturating_sub(1) as f32,
    };
    let (mut again, mut both, mut off) = (0, 0, 0);
    for y in (rows.start + GRID / 2..rows.end).step_by(GRID) {
        for x in (GRID / 2..width).step_by(GRID).filter(|&x| lit(y, x)) {
            let (now, before) = (map.disparity.row(y - rows.start)[x], disparity.row(y)[x]);
            if now == INVALID {
                continue;
            }
            again += 1;
            let moved = rate.map_or(0.0, |rate| rate.row(y)[x]) * mean_time;
            let apart = (f32::from(now) - before - moved).abs();
            both += usize::from(apart < OFF_PX.1);
            off += usize::from(apart > OFF_PX.0 && apart < OFF_PX.1);
        }
    }
    again > 2 * found + seen / 4 || off as f32 > OFF_PART * both.max(8) as f32
}
