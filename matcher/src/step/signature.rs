//! How well a pixel's grey values over time agree with the right images at a disparity.

use super::is_hidden;
use crate::{SAMPLES_PER_DN8, Sample, StereoStack};

/// Second moments over time of a left pixel and the right position it is compared with, in squared DN
/// of 8 bits.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Signature {
    /// Covariance.
    pub cov: f32,
    /// Variance of the left values.
    pub left: f32,
    /// Variance of the right values.
    pub right: f32,
}

impl Signature {
    /// Adds another's moments.
    pub fn add(&mut self, other: &Self) {
        self.cov += other.cov;
        self.left += other.left;
        self.right += other.right;
    }

    /// Correlation coefficient; 0 without variance.
    pub fn similarity(&self) -> f32 {
        let norm = (self.left * self.right).sqrt();
        if norm > 0.0 { self.cov / norm } else { 0.0 }
    }
}

/// Most frames of a stack.
const FRAMES_MOST: usize = 16;

/// A stack's grey values, at hand.
pub(crate) struct Samples<'a> {
    stack: &'a StereoStack<'a>,
    frames: [(&'a [Sample], &'a [Sample]); FRAMES_MOST],
}

impl<'a> Samples<'a> {
    /// Of a checked stack.
    pub fn new(stack: &'a StereoStack<'a>) -> Self {
        let mut frames: [(&[Sample], &[Sample]); FRAMES_MOST] = [(&[], &[]); FRAMES_MOST];
        for (to, (left, right)) in frames.iter_mut().zip(stack.left.iter().zip(stack.right)) {
            *to = (left.as_slice(), right.as_slice());
        }
        Self { stack, frames }
    }

    /// Compares left pixel (x, y) with the right images at x - `disparity_px`; `None` where the right
    /// camera does not see that, or not all pixels that the interpolation takes. Between right pixels by
    /// Keys' cubic (1981).
    #[inline(always)]
    pub fn signature(&self, x: usize, y: usize, disparity_px: f32) -> Option<Signature> {
        let (width, frames) = (self.stack.width(), self.stack.frames());
        let at = x as f32 - disparity_px;
        if is_hidden(self.stack, x, y, disparity_px) || width < 4 {
            return None;
        }
        // At the image's sides the outer interval's cubic is continued.
        let whole = at.floor().clamp(1.0, width as f32 - 3.0);
        let column = whole as usize;
        if let Some(mask) = self.stack.right_mask {
            // Nothing is said by what a mask hides.
            let seen: &[u8; 4] = mask.row(y)[column - 1..].first_chunk()?;
            if seen.contains(&0) {
                return None;
            }
        }
        let f = at - whole;
        let taps = [
            0.5 * f * (-1.0 + f * (2.0 - f)),
            1.0 + 0.5 * f * f * (-5.0 + 3.0 * f),
            0.5 * f * (1.0 + f * (4.0 - 3.0 * f)),
            0.5 * f * f * (f - 1.0),
        ];
        let (from_left, from_right) = (y * width + x, y * width + column - 1);
        // First gathered, then summed: the sums are vectors over time.
        let (mut l, mut r) = ([0f32; FRAMES_MOST], [0f32; FRAMES_MOST]);
        for ((l, r), (left, right)) in l.iter_mut().zip(&mut r).zip(&self.frames[..frames]) {
            *l = f32::from(left[from_left]);
            let samples: &[Sample; 4] = right[from_right..].first_chunk()?;
            let [a, b, c, d] = samples.map(f32::from);
            *r = (a * taps[0] + b * taps[1]) + (c * taps[2] + d * taps[3]);
        }
        let mut sums = [[0f32; 8]; 5];
        for half in 0..2 {
            for k in 0..8 {
                let (l, r) = (l[8 * half + k], r[8 * half + k]);
                let terms = [l, r, l * r, l * l, r * r];
                for (sum, term) in sums.iter_mut().zip(terms) {
                    sum[k] += term;
                }
            }
        }
        let [l1, r1, lr, ll, rr] =
            sums.map(|s| ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7])));
        let n = 1.0 / frames as f32;
        let unit = n / f32::from(SAMPLES_PER_DN8).powi(2);
        Some(Signature {
            cov: (lr - l1 * r1 * n) * unit,
            left: (ll - l1 * l1 * n) * unit,
            right: (rr - r1 * r1 * n) * unit,
        })
    }
}
