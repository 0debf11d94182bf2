//! The surfaces that a pixel could show.

use super::{ALONG_PX, JUMP_PX, STEEP};
use crate::{
    Image,
    regions::{BEND_PX, STEEP_PX},
};

/// How far another surface is looked for: beyond the width of fattening, and one more.
const REACH: usize = 4;

/// Candidates that differ by less are one.
const SAME_PX: f32 = 1.0;

/// A surface near a pixel, continued to it as a plane.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Candidate {
    /// Disparity at the pixel.
    pub disparity_px: f32,
    /// Its change per column and row.
    pub slope: [f32; 2],
    /// Way from the pixel to the next one that is on the surface, farther from the step.
    pub inwards: (i32, i32),
}

impl Candidate {
    /// Disparity of the plane at an offset from the pixel.
    pub fn at(&self, dx: i32, dy: i32) -> f32 {
        self.disparity_px + self.slope[0] * dx as f32 + self.slope[1] * dy as f32
    }
}

/// Up to four other surfaces around a pixel.
#[derive(Debug, Default)]
pub(crate) struct Candidates {
    found: [Option<Candidate>; 4],
}

impl Candidates {
    /// Looks along the four axes from (x, y), whose own surface is `own`, for the first pixel of
    /// another surface.
    #[inline(always)]
    pub fn around(map: &Image<f32>, x: usize, y: usize, own: &Candidate) -> Self {
        let mut candidates = Self::default();
        for (k, (sx, sy)) in [(-1, 0), (1, 0), (0, -1), (0, 1)].into_iter().enumerate() {
            for step in 1..=REACH as i32 {
                let (dx, dy) = (sx * step, sy * step);
                let (Some(px), Some(py)) =
                    (x.checked_add_signed(dx as isize), y.checked_add_signed(dy as isize))
                else {
                    break;
                };
                let Some(value) = map.get(px, py) else { break };
                // NaN is not far from anything.
                let other = (value - own.at(dx, dy)).abs() > JUMP_PX;
                if !other {
                    continue;
                }
                let plane = plane(map, px, py, value);
                let continued = plane.at(-dx, -dy);
                let candidate = Candidate { disparity_px: continued, inwards: (dx, dy), ..plane };
                let known = candidates.iter().any(|c| (c.disparity_px - continued).abs() < SAME_PX);
                let same = (continued - own.disparity_px).abs() < SAME_PX;
                if !known && !same {
                    candidates.found[k] = Some(candidate);
                }
                break;
            }
        }
        candidates
    }

    pub fn iter(&self) -> impl Iterator<Item = &Candidate> {
        self.found.iter().flatten()
    }
}

/// The plane through (x, y) with the slopes to its neighbours two pixels away that are on the same
/// surface; level where there are none.
#[inline(always)]
pub(crate) fn plane(map: &Image<f32>, x: usize, y: usize, value: f32) -> Candidate {
    let slope = |sx: isize, sy: isize| {
        let side = |sign: isize| {
            let known = |steps: isize| {
                let px = x.checked_add_signed(steps * sign * sx)?;
                map.get(px, y.checked_add_signed(steps * sign * sy)?)
            };
            let (next, far) = (known(1)?, known(2)?);
            let difference = (far - value) * (0.5 * sign as f32);
            // A steep surface is even from pixel to pixel.
            let even = (next - 0.5 * (far + value)).abs() <= 0.5 * BEND_PX;
            (difference.abs() <= JUMP_PX || (even && difference.abs() <= STEEP_PX))
                .then_some(difference)
        };
        match (side(-1), side(1)) {
            (Some(a), Some(b)) => 0.5 * (a + b),
            (Some(a), None) | (None, Some(a)) => a,
            (None, None) => 0.0,
        }
    };
    Candidate { disparity_px: value, slope: [slope(1, 0), slope(0, 1)], inwards: (0, 0) }
}

/// The surface that the map gives pixel (x, y), which is a number there. Inwards is where most of the
/// pixels around on the same surface are, in one of eight directions; nowhere when they are all around.
#[inline(always)]
pub(crate) fn own(map: &Image<f32>, x: usize, y: usize) -> Candidate {
    let plane = plane(map, x, y, map.row(y)[x]);
    let (mut sx, mut sy) = (0i32, 0i32);
    for dy in -2..=2i32 {
        for dx in -2..=2i32 {
            let at = (x.checked_add_signed(dx as isize), y.checked_add_signed(dy as isize));
            let (Some(px), Some(py)) = at else { continue };
            let Some(value) = map.get(px, py) else { continue };
            let limit = ALONG_PX + STEEP * dx.abs().max(dy.abs()) as f32;
            if (value - plane.disparity_px).abs() < limit {
                (sx, sy) = (sx + dx, sy + dy);
            }
        }
    }
    // Within 22.5 degrees of an axis the direction is that axis: tan 22.5 = 0.414.
    let inwards = if sx * sx + sy * sy <= 2 {
        (0, 0)
    } else if 1000 * sy.abs() <= 414 * sx.abs() {
        (sx.signum(), 0)
    } else if 1000 * sx.abs() <= 414 * sy.abs() {
        (0, sy.signum())
    } else {
        (sx.signum(), sy.signum())
    };
    Candidate { inwards, ..plane }
}
