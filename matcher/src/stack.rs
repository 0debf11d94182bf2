//! The matcher's input: N rectified stereo pairs.

use crate::{Error, Image};

/// One rectified grey value. Signed and with fractional bits, so that neither the rounding nor the
/// overshoot of the rectification's interpolation kernel costs accuracy: [`SAMPLES_PER_DN8`] units
/// are one grey level of an 8-bit camera, whatever the camera's own depth; full scale is 16 320.
pub type Sample = i16;

/// Units of a [`Sample`] per grey level of an 8-bit image.
pub const SAMPLES_PER_DN8: i16 = 64;

/// Most columns of an image.
pub const WIDTH_LIMIT: usize = 65_535;

/// N rectified stereo pairs in slot order, all of one size.
///
/// Rows correspond: a point at (x, y) on the left is at (x - disparity, y) on the right.
#[derive(Debug, Clone, Copy)]
pub struct StereoStack<'a> {
    /// Left images, frame by frame.
    pub left: &'a [&'a Image<Sample>],
    /// Right images, frame by frame; as many and as large as the left ones.
    pub right: &'a [&'a Image<Sample>],
    /// Pixels of the left canvas that the left camera saw (non-zero); all when `None`.
    pub left_mask: Option<&'a Image<u8>>,
    /// Pixels of the right canvas that the right camera saw (non-zero); all when `None`.
    pub right_mask: Option<&'a Image<u8>>,
    /// Exposure-centre time of each frame in seconds, for motion estimation; evenly spaced when
    /// `None`.
    pub times_s: Option<&'a [f64]>,
}

impl<'a> StereoStack<'a> {
    /// A stack without masks or times.
    pub fn new(left: &'a [&'a Image<Sample>], right: &'a [&'a Image<Sample>]) -> Self {
        Self { left, right, left_mask: None, right_mask: None, times_s: None }
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.left.len()
    }

    /// Width in pixels (0 for an empty stack).
    pub fn width(&self) -> usize {
        self.left.first().map_or(0, |i| i.width())
    }

    /// Height in pixels (0 for an empty stack).
    pub fn height(&self) -> usize {
        self.left.first().map_or(0, |i| i.height())
    }

    /// Checks number and sizes of images, masks and times.
    ///
    /// # Errors
    /// [`Error::FrameCount`] and [`Error::Shape`].
    pub fn check(&self) -> Result<(), Error> {
        let n = self.left.len();
        if !(1..=16).contains(&n) {
            return Err(Error::FrameCount { frames: n });
        }
        let shape = |what, expected: String, got: String| Err(Error::Shape { what, expected, got });
        if self.right.len() != n {
            return shape("right stack", format!("{n} frames"), self.right.len().to_string());
        }
        let size = (self.width(), self.height());
        if size.0 == 0 || size.1 == 0 {
            return shape("left stack", "images of at least one pixel".into(), format!("{size:?}"));
        }
        if size.0 > WIDTH_LIMIT {
            return shape(
                "left stack",
                format!("at most {WIDTH_LIMIT} columns"),
                size.0.to_string(),
            );
        }
        for (what, images) in [("left stack", self.left), ("right stack", self.right)] {
            if let Some(i) = images.iter().find(|i| (i.width(), i.height()) != size) {
                return shape(what, format!("{size:?}"), format!("{:?}", (i.width(), i.height())));
            }
        }
        for (what, mask) in [("left mask", self.left_mask), ("right mask", self.right_mask)] {
            if let Some(m) = mask.filter(|m| (m.width(), m.height()) != size) {
                return shape(what, format!("{size:?}"), format!("{:?}", (m.width(), m.height())));
            }
        }
        if let Some(t) = self.times_s.filter(|t| t.len() != n || t.iter().any(|t| !t.is_finite())) {
            return shape("times", format!("{n} finite values"), format!("{} values", t.len()));
        }
        Ok(())
    }
}
