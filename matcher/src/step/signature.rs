//! How well a pixel's grey values over time agree with the right images at a disparity.

use super::is_hidden;
use crate::{SAMPLES_PER_DN8, StereoStack};

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

/// Compares left pixel (x, y) with the right images at x - `disparity_px`; `None` where the right
/// camera does not see that. Between right pixels by Keys' cubic (1981).
pub(crate) fn signature(
    stack: &StereoStack<'_>,
    x: usize,
    y: usize,
    disparity_px: f32,
) -> Option<Signature> {
    let width = stack.width();
    let at = x as f32 - disparity_px;
    let whole = at.floor();
    if is_hidden(stack, x, y, disparity_px) || width < 4 {
        return None;
    }
    // At the image's sides the outer interval's cubic is continued.
    let whole = whole.clamp(1.0, width as f32 - 3.0);
    let column = whole as usize;
    let f = at - whole;
    let taps = [
        0.5 * f * (-1.0 + f * (2.0 - f)),
        1.0 + 0.5 * f * f * (-5.0 + 3.0 * f),
        0.5 * f * (1.0 + f * (4.0 - 3.0 * f)),
        0.5 * f * f * (f - 1.0),
    ];
    let (mut l1, mut r1, mut lr, mut ll, mut rr) = (0f32, 0f32, 0f32, 0f32, 0f32);
    for (left, right) in stack.left.iter().zip(stack.right) {
        let l = f32::from(left.row(y)[x]);
        let samples: &[i16; 4] = right.row(y)[column - 1..].first_chunk()?;
        let r: f32 = samples.iter().zip(taps).map(|(&s, tap)| f32::from(s) * tap).sum();
        l1 += l;
        r1 += r;
        lr += l * r;
        ll += l * l;
        rr += r * r;
    }
    let n = 1.0 / stack.frames() as f32;
    let unit = n / f32::from(SAMPLES_PER_DN8).powi(2);
    Some(Signature {
        cov: (lr - l1 * r1 * n) * unit,
        left: (ll - l1 * l1 * n) * unit,
        right: (rr - r1 * r1 * n) * unit,
    })
}
