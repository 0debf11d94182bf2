//! What a fit asks of its tiles: the frame, and where its results go.

use super::{
    motion::{BLOCK, Motion, along::Watch, sums::Block},
    solve::Fits,
};
use crate::{Image, Level, Sample};

/// Fewest rows of a task: each that does not follow its thread's last one computes some rows beyond its
/// own anew.
pub(super) const BAND: usize = 64;

/// What all tiles of a frame share.
pub(crate) struct Job<'a> {
    pub level: Level,
    /// Another one for each frame.
    pub stamp: u64,
    /// Left images, an even number.
    pub left: &'a [&'a Image<Sample>],
    /// Right images, likewise.
    pub right: &'a [&'a Image<Sample>],
    /// Number of frames that are not padding.
    pub frames: usize,
    /// Starting disparities; NaN is invalid.
    pub start: &'a Image<f32>,
    /// Non-zero where a window holds a depth step.
    pub step: &'a Image<u8>,
    pub radius: usize,
    pub fits: Fits,
    /// Largest difference of a window pixel from the centre at steps.
    pub surface_px: f32,
    /// Subtracted from disparities for precision.
    pub origin: f32,
    /// Each frame's own place, where the surface moves.
    pub motion: Option<&'a Motion>,
    /// Where motion is looked for.
    pub watch: Option<Watch>,
}

impl Job<'_> {
    /// What to look for motion with in row `y`, if that row is looked at.
    pub fn watch_at(&self, y: isize) -> Option<&Watch> {
        let inside = (0..self.start.height() as isize).contains(&y);
        self.watch.as_ref().filter(|_| inside && Watch::samples(y))
    }
}

/// The rows a tile writes: full image rows, of which it fills the columns it was asked for.
pub(crate) struct Output<'a> {
    pub first: &'a mut [f32],
    pub second: &'a mut [f32],
    pub zncc: &'a mut [f32],
    /// Mean of the left images' grey values, where it is wanted.
    pub brightness: Option<&'a mut [u8]>,
    /// Blocks of motion, of all columns.
    pub blocks: &'a mut [Block],
}

/// Row `y` of each image.
pub(crate) fn image_rows<'a>(images: &[&'a Image<Sample>], y: isize) -> [&'a [Sample]; 16] {
    std::array::from_fn(|i| images.get(i).map_or(&[][..], |image| image.row(y as usize)))
}

/// Ranges of columns of a band of [`BAND`] rows whose blocks are set in `again`.
pub(super) fn columns(width: usize, band: usize, again: &Image<bool>) -> Vec<(usize, usize)> {
    let per_band = BAND / BLOCK;
    let rows = band * per_band..((band + 1) * per_band).min(again.height());
    let set = |column: usize| rows.clone().any(|row| again.row(row)[column]);
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for column in (0..again.width()).filter(|&c| set(c)) {
        let (from, to) = (column * BLOCK, ((column + 1) * BLOCK).min(width));
        match ranges.last_mut() {
            Some(last) if last.1 == from => last.1 = to,
            _ => ranges.push((from, to)),
        }
    }
    ranges
}

/// A whole number near the mean disparity, subtracted inside for precision. A few thousand pixels tell it:
/// each is a line from memory, while other threads wait.
pub(super) fn origin(start: &Image<f32>) -> f32 {
    let (mut sum, mut n) = (0.0f64, 0u32);
    let apart = (start.as_slice().len() / 4096) | 1;
    for &v in start.as_slice().iter().step_by(apart).filter(|v| v.is_finite()) {
        sum += f64::from(v);
        n += 1;
    }
    if n == 0 { 0.0 } else { (sum / f64::from(n)).round() as f32 }
}
