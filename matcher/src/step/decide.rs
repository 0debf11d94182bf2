//! The verdict on one pixel.

use super::{
    ALONG_PX, INSIDE_RADIUS, STEEP,
    candidates::{Candidate, Candidates, own},
    signature::{Signature, signature},
};
use crate::{Image, StereoStack};

/// Fewest frames whose grey values tell surfaces apart.
pub const FRAMES_MIN: usize = 6;

/// Least light, as a part of the mean inside the surface: a pixel that the surface covers by half has
/// a quarter. Less is asked for, as the light of single pixels in N patterns varies by chance.
pub const LIGHT_MIN: f32 = 0.1;

/// Least light, as a part of the next pixel's inside the surface: the same dots light both, so that it
/// varies less. With the nominal blur a pixel whose centre is on the silhouette has 0.3 to 0.4.
pub const NEXT_LIGHT_MIN: f32 = 0.39;

/// Least similarity of the grey values over time. On the simulated statue of three seeds, N = 10: 0.8
/// leaves 0.06 to 0.07 % of points that are off by more than 5 mm at 95.9 % completeness, 0.88 leaves
/// 0.033 to 0.040 % at 95.6 %, 0.9 a quarter less at 95.0 %. A stricter limit on the light costs twice
/// as many points for the same effect.
pub const SIMILARITY_MIN: f32 = 0.88;

/// Least similarity for a pixel to be moved to another surface.
pub const MOVED_SIMILARITY_MIN: f32 = 0.9;

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
    /// As a part of the light of the next pixel inside; enough where that is not known.
    next_light: f32,
    similarity: f32,
}

impl Evidence {
    fn suffices(&self) -> bool {
        self.light >= LIGHT_MIN
            && self.next_light >= NEXT_LIGHT_MIN
            && self.similarity >= SIMILARITY_MIN
    }

    /// Enough for a surface that the map did not have at the pixel.
    fn convinces(&self) -> bool {
        self.suffices() && self.similarity >= MOVED_SIMILARITY_MIN
    }
}

impl Judge<'_> {
    /// `None` when the pixel's disparity stands, else what takes its place (`Some(None)`: nothing).
    pub fn pixel(&self, x: usize, y: usize) -> Option<Option<f32>> {
        let own_px = self.disparity_px.row(y)[x];
        let own = own(self.disparity_px, x, y);
        // Where the right camera's view ends, nothing can be said.
        let own_evidence = self.evidence(x, y, &own)?;
        let mut best: Option<(Evidence, f32)> = None;
        for other in Candidates::around(self.disparity_px, x, y, &own).iter() {
            let Some(evidence) = self.evidence(x, y, other).filter(Evidence::convinces) else {
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

    /// Pools the pixel and its two neighbours along the step; `None` where the right camera
    /// does not see the candidate.
    fn evidence(&self, x: usize, y: usize, candidate: &Candidate) -> Option<Evidence> {
        let own_px = self.disparity_px.row(y)[x];
        let mut pooled = Signature::default();
        let (mut next, mut count) = (0.0, 0);
        // The row along the step: across the direction inwards.
        let (ix, iy) = (candidate.inwards.0.signum(), candidate.inwards.1.signum());
        let along = [(0, 0), (-iy, ix), (iy, -ix)];
        for &(dx, dy) in if (ix, iy) == (0, 0) { &along[..1] } else { &along[..] } {
            let at = (x.checked_add_signed(dx as isize), y.checked_add_signed(dy as isize));
            let (Some(px), Some(py)) = at else { continue };
            // Neighbours beside the same step; NaN is not.
            let same = self.beside.get(px, py).is_some_and(|b| b != 0)
                && (self.disparity_px.row(py)[px] - own_px).abs() < ALONG_PX;
            if !same {
                continue;
            }
            if let Some(one) = signature(self.stack, px, py, candidate.at(dx, dy)) {
                pooled.add(&one);
                next += self.next(px, py, candidate.at(dx, dy), candidate);
                count += 1;
            }
        }
        if count == 0 {
            return None;
        }
        let inside = self.inside(x, y, candidate);
        let light = inside.map_or(1.0, |inside| pooled.cov / (count as f32 * inside));
        // NaN where a pixel has no next one: no comparison holds then.
        let known = next > 0.0 && candidate.inwards != (0, 0);
        let next_light = if known { pooled.cov / next } else { 1.0 };
        Some(Evidence { light, next_light, similarity: pooled.similarity() })
    }

    /// Light of the pixel inwards of (x, y) on the candidate's surface, whose disparity at (x, y) is
    /// `at_px`; NaN where there is none.
    fn next(&self, x: usize, y: usize, at_px: f32, candidate: &Candidate) -> f32 {
        let (dx, dy) = candidate.inwards;
        let at = (x.checked_add_signed(dx as isize), y.checked_add_signed(dy as isize));
        let (Some(px), Some(py)) = at else { return f32::NAN };
        let Some(known) = self.disparity_px.get(px, py) else { return f32::NAN };
        let limit = ALONG_PX + STEEP * dx.abs().max(dy.abs()) as f32;
        // Where the map has another surface there, this one is continued.
        let on = (known - at_px).abs() < limit;
        let disparity_px = if on { known } else { at_px };
        signature(self.stack, px, py, disparity_px).map_or(f32::NAN, |s| s.cov)
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
                let limit = ALONG_PX + STEEP * dx.abs().max(dy.abs()) as f32;
                if off < limit && !light.is_nan() {
                    sum += light;
                    count += 1;
                }
            }
        }
        (count >= INSIDE_MIN && sum > 0.0).then(|| sum / count as f32)
    }
}
