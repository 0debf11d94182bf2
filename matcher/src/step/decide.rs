//! The verdict on one pixel.

use super::{
    ALONG_PX, Limits, STEEP,
    candidates::{Candidate, Candidates, own},
    signature::{Samples, Signature},
};
use crate::{Image, StereoStack};

/// Fewest frames whose grey values tell surfaces apart: one has no changes over time.
pub const FRAMES_MIN: usize = 2;

/// Pixels of the row along a step whose grey values are pooled...
const POOLED: usize = 3;
/// ...and with fewer frames than [`FEW`], whose values agree by chance more often.
const POOLED_OF_FEW: usize = 5;
const FEW: usize = 6;

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

/// How far beyond the next pixel the light inside a surface is taken.
const INSIDE_STEPS: i32 = 3;

/// What verdicts are made from.
pub(super) struct Judge<'a> {
    samples: Samples<'a>,
    disparity_px: &'a Image<f32>,
    beside: &'a Image<u8>,
    limits: &'a Limits,
    /// How many pixels of the row along the step are pooled.
    in_row: usize,
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
    fn suffices(&self, limits: &Limits) -> bool {
        self.light >= limits.light_min
            && self.next_light >= limits.next_light_min
            && self.similarity >= limits.similarity_min
    }

    /// Enough for a surface that the map did not have at the pixel.
    fn convinces(&self, limits: &Limits) -> bool {
        self.suffices(limits) && self.similarity >= MOVED_SIMILARITY_MIN
    }
}

impl<'a> Judge<'a> {
    pub fn new(
        stack: &'a StereoStack<'a>,
        disparity_px: &'a Image<f32>,
        beside: &'a Image<u8>,
        limits: &'a Limits,
    ) -> Self {
        let in_row = if stack.frames() < FEW { POOLED_OF_FEW } else { POOLED };
        Self { samples: Samples::new(stack), disparity_px, beside, limits, in_row }
    }

    /// As [`Self::pixel`], of a place in the map.
    #[inline(always)]
    pub fn place(&self, i: usize) -> Option<Option<f32>> {
        let width = self.disparity_px.width();
        self.pixel(i % width, i / width)
    }

    /// `None` when the pixel's disparity stands, else what takes its place (`Some(None)`: nothing).
    #[inline(always)]
    pub fn pixel(&self, x: usize, y: usize) -> Option<Option<f32>> {
        let own_px = self.disparity_px.row(y)[x];
        let own = own(self.disparity_px, x, y);
        // Where the right camera's view ends, nothing can be said.
        let own_evidence = self.evidence(x, y, &own, self.limits.similarity_min)?;
        let mut best: Option<(Evidence, f32)> = None;
        for other in Candidates::around(self.disparity_px, x, y, &own).iter() {
            let evidence = self.evidence(x, y, other, MOVED_SIMILARITY_MIN);
            let Some(evidence) = evidence.filter(|e| e.convinces(self.limits)) else {
                continue;
            };
            if best.is_none_or(|(b, _)| evidence.similarity > b.similarity) {
                best = Some((evidence, other.disparity_px));
            }
        }
        match (Some(own_evidence).filter(|e| e.suffices(self.limits)), best) {
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

    /// Pools the pixel and its next neighbours along the step; `None` where the right camera
    /// does not see the candidate. Below a similarity of `least` nothing else is looked at.
    #[inline(always)]
    fn evidence(&self, x: usize, y: usize, candidate: &Candidate, least: f32) -> Option<Evidence> {
        let own_px = self.disparity_px.row(y)[x];
        // The row along the step: across the direction inwards.
        let (ix, iy) = (candidate.inwards.0.signum(), candidate.inwards.1.signum());
        let along = [(0, 0), (-iy, ix), (iy, -ix), (-2 * iy, 2 * ix), (2 * iy, -2 * ix)];
        let along = &along[..if (ix, iy) == (0, 0) { 1 } else { self.in_row }];
        let mut pooled = Signature::default();
        let mut found = [(0, 0, 0.0, f32::NAN); POOLED_OF_FEW];
        for (&(dx, dy), found) in along.iter().zip(&mut found) {
            let at = (x.checked_add_signed(dx as isize), y.checked_add_signed(dy as isize));
            let (Some(px), Some(py)) = at else { continue };
            // Neighbours beside the same step; NaN is not.
            let same = self.beside.get(px, py).is_some_and(|b| b != 0)
                && (self.disparity_px.row(py)[px] - own_px).abs() < ALONG_PX;
            if !same {
                continue;
            }
            let at_px = candidate.at(dx, dy);
            if let Some(one) = self.samples.signature(px, py, at_px) {
                pooled.add(&one);
                *found = (px, py, at_px, one.cov);
            }
        }
        let found = || found.iter().filter(|(.., cov)| !cov.is_nan());
        found().next()?;
        let similarity = pooled.similarity();
        let none = Evidence { light: 0.0, next_light: 0.0, similarity };
        if similarity < least {
            return Some(none);
        }
        let (mut next, mut inside, mut inside_own) = (0.0, 0.0, 0.0);
        for &(px, py, at_px, _) in found() {
            next += self.inwards(px, py, at_px, candidate, 0);
        }
        // NaN where a pixel has no next one: no comparison holds then.
        let known = next > 0.0 && candidate.inwards != (0, 0);
        if known && self.limits.light_min <= 0.0 {
            return Some(Evidence { light: 1.0, next_light: pooled.cov / next, similarity });
        }
        for &(px, py, at_px, cov) in found() {
            let deep = self.inwards(px, py, at_px, candidate, INSIDE_STEPS);
            if !deep.is_nan() {
                (inside, inside_own) = (inside + deep, inside_own + cov);
            }
        }
        let light = if inside > 0.0 { inside_own / inside } else { 1.0 };
        let next_light = if known { pooled.cov / next } else { 1.0 };
        Some(Evidence { light, next_light, similarity })
    }

    /// Light of the pixel inwards of (x, y) on the candidate's surface, whose disparity at (x, y) is
    /// `at_px`, or of the one that is `beyond` pixels farther; NaN where there is none.
    #[inline(always)]
    fn inwards(&self, x: usize, y: usize, at_px: f32, candidate: &Candidate, beyond: i32) -> f32 {
        let (ix, iy) = candidate.inwards;
        let (dx, dy) = (ix + beyond * ix.signum(), iy + beyond * iy.signum());
        let at = (x.checked_add_signed(dx as isize), y.checked_add_signed(dy as isize));
        let (Some(px), Some(py)) = at else { return f32::NAN };
        let Some(known) = self.disparity_px.get(px, py) else { return f32::NAN };
        let limit = ALONG_PX + STEEP * dx.abs().max(dy.abs()) as f32;
        let on = (known - at_px).abs() < limit;
        if beyond > 0 && !on {
            return f32::NAN;
        }
        // Where the map has another surface next to the pixel, this one is continued.
        let disparity_px = if on { known } else { at_px };
        self.samples.signature(px, py, disparity_px).map_or(f32::NAN, |s| s.cov)
    }
}
