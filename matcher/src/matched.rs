//! The matcher's output.

use crate::Image;

/// Wall and CPU time of one stage of the last frame.
#[derive(Debug, Clone, PartialEq)]
pub struct StageTime {
    /// The stage, as its file is named.
    pub stage: &'static str,
    /// Wall time in milliseconds.
    pub wall_ms: f64,
    /// CPU time of the whole process in milliseconds, where the system tells it: of the matcher alone only
    /// where nothing else runs.
    pub cpu_ms: Option<f64>,
}

/// Disparity and similarity of one stereo stack, on the left rectified canvas.
#[derive(Debug, Clone)]
pub struct Matched {
    /// Disparity x_left - x_right in pixels; NaN is invalid.
    pub disparity_px: Image<f32>,
    /// ZNCC = 1 - ZNSSD / 2 of the refined subset, -1..=1; NaN where the disparity is.
    pub zncc: Image<f32>,
    /// Whether the disparity is the newest frame's, as it is where motion is estimated; otherwise a
    /// moving surface's is a mean over the frames.
    pub at_newest: bool,
    /// Disparity's rate in px per second, zero where nothing moves significantly and NaN where the
    /// disparity is; `None` where motion is not estimated or the stack has no times.
    pub rate_px_per_s: Option<Image<f32>>,
    /// Mean of the left images in grey levels of 8 bits, where the method has it at hand: with
    /// [`crate::Method::Dense`].
    pub brightness: Option<Image<u8>>,
    /// Time of each stage, in order.
    pub stages: Vec<StageTime>,
}

impl Default for Matched {
    /// Empty maps, for [`crate::Matcher::match_into`].
    fn default() -> Self {
        Self {
            disparity_px: Image::new(0, 0, f32::NAN),
            zncc: Image::new(0, 0, f32::NAN),
            at_newest: false,
            rate_px_per_s: None,
            brightness: None,
            stages: Vec::new(),
        }
    }
}
