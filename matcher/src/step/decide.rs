//! The verdict on one pixel.

use super::{
    INSIDE_RADIUS,
    candidates::{Candidate, Candidates, plane},
    signature::{Signature, signature},
};
use crate::{Image, StereoStack};

/// Fewest frames whose grey values tell surfaces apart.
pub const FRAMES_MIN: usize = 6;

/// Least light, as a part of that inside the surface: a pixel that the surface covers by half has a
/// quarter. Less is asked for, as the light of one pixel in N patterns varies by chance.
pub const LIGHT_MIN: f32 = 0.15;

/// Least similarity of the grey values over time.
pub const SIMILARITY_MIN: f32 = 0.75;

/// Pixels of the same surface in the row along the step differ by less.
const ALONG_PX: f32 = 2.5;

/// Fewest pixels that the light inside a surface is taken from.
const INSIDE_MIN: usize = 3;

/// What verdicts are made from.
pub(super) struct Judge<'a> {
    pub stack: &'a StereoStack<'a>,
    pub disparity_px: &'a Image<f32>,
    pub beside: &'a Image<u8>,
    /// Covariance at the pixels' own disparities inside surfaces; NaN elsewhere.
    pub light: &'a [f32],
}

/// How well a surface explains a pixel.
#[derive(Debug, Clone, Copy)]
struct Evidence {
    /// As a part of the light inside the surface; enough where nothing is known of its inside.
    light: f32,
    similarity: f32,
}

impl Evidence {
    fn suffices(&self) -> bool {
        self.light >= LIGHT_MIN && self.similarity >= SIMILARITY_MIN
    }
}

impl Judge<'_> {
    /// `None` when the pixel's disparity stands, else what takes its place (`Some(None)`: nothing).
    pub fn pixel(&self, x: usize, y: usize) -> Option<Option<f32>> {
        let own_px = self.disparity_px.row(y)[x];
        let own = plane(self.disparity_px, x, y, own_px);
        // Where the right camera's view ends, nothing can be said.
        let own_evidence = self.evidence(x, y, &own)?;
        let mut best: Option<(Evidence, f32)> = None;
        for other in Candidates::around(self.disparity_px, x, y, &own).iter() {
            let Some(evidence) = self.evidence(x, y, other).filter(Evidence::suffices) else {
                continue;
            };
            if best.is_none_or(|(b, _)| evidence.similarity > b.similarity) {
                best = Some((evidence, other.disparity_px));
            }
        }
        match (Some(own_evidence).filter(Evidence::suffices), best) {
            (None, None) => Some(None),
            (None, Some((_, to))) => Some(Some(to)),
            (Some(_), None) => None,
            (Some(own), Some((other, to))) => {
                // Of two surfaces that cover half a pixel each, the nearer one is mixed on both sides
                // and has a similarity of 1/2, the farther one on the left alone and has sqrt(1/2).
                let (near, far) = if to > own_px {
                    (other.similarity, own.similarity)
                } else {
                    (own.similarity, other.similarity)
                };
                let nearer = near > far * far;
                (nearer == (to > own_px)).then_some(Some(to))
            }
        }
    }

    /// Pools the pixel and those of its neighbours beside the same step; `None` where the right camera
    /// does not see the candidate.
    fn evidence(&self, x: usize, y: usize, candidate: &Candidate) -> Option<Evidence> {
        let own_px = self.disparity_px.row(y)[x];
        let mut pooled = Signature::default();
        let mut count = 0;
        for dy in -1..=1 {
            for dx in -1..=1 {
                let at = (x.checked_add_signed(dx as isize), y.checked_add_signed(dy as isize));
                let (Some(px), Some(py)) = at else { continue };
                if self.beside.get(px, py).is_none_or(|b| b == 0) {
                    continue;
                }
                if (self.disparity_px.row(py)[px] - own_px).abs() >= ALONG_PX
                    || self.disparity_px.row(py)[px].is_nan()
                {
                    continue;
                }
                if let Some(one) = signature(self.stack, px, py, candidate.at(dx, dy)) {
                    pooled.add(&one);
                    count += 1;
                }
            }
        }
        if count == 0 {
            return None;
        }
        let inside = self.inside(x, y, candidate);
        let light = inside.map_or(1.0, |inside| pooled.cov / (count as f32 * inside));
        Some(Evidence { light, similarity: pooled.similarity() })
    }

    /// Mean light of the candidate's surface around the pixel, away from steps.
    fn inside(&self, x: usize, y: usize, candidate: &Candidate) -> Option<f32> {
        let (width, height) = (self.disparity_px.width(), self.disparity_px.height());
        let r = INSIDE_RADIUS;
        let (mut sum, mut count) = (0.0, 0);
        for py in y.saturating_sub(r)..(y + r + 1).min(height) {
            let dy = py as i32 - y as i32;
            for px in x.saturating_sub(r)..(x + r + 1).min(width) {
                let dx = px as i32 - x as i32;
                let light = self.light[py * width + px];
                let off = (self.disparity_px.row(py)[px] - candidate.disparity_px).abs();
                let limit = ALONG_PX + 0.75 * dx.abs().max(dy.abs()) as f32;
                if off < limit && !light.is_nan() {
                    sum += light;
                    count += 1;
                }
            }
        }
        (count >= INSIDE_MIN && sum > 0.0).then(|| sum / count as f32)
    }
}
