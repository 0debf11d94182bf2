//! Where windows of the left canvas are on the right one, to a pixel: all displacements in both
//! directions are tried.
//!
//! Rows alone do not do: a camera turned by 0.1 degrees moves points by three rows, further than
//! speckles are wide. A few windows are searched over all vertical disparities, the others near what
//! those say.

use rayon::prelude::*;
use stspp_matcher::{Image, Sample};

use super::Options;
use crate::reconstruct::RectifiedStack;

/// Windows, of all, that are searched over all vertical disparities.
const SCOUTS: usize = 60;
/// Vertical distance from the scouts' median within which the other windows are searched.
const NEAR_PX: i64 = 3;
/// Least similarity of a window at whole pixels: up to half a pixel off in both directions.
const ZNCC_MIN: f64 = 0.5;
/// How much less similar every place further than `APART_PX` has to be.
const UNIQUE: f64 = 0.08;
const APART_PX: i64 = 4;
/// Every other row of a window is enough to tell where it is.
const ROW_STEP: usize = 2;
/// Bits that grey values lose, so that sums of products fit in 32 bits: 64 units are one grey level.
const SHIFT: u32 = 6;

/// A window and where it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Found {
    /// Its middle on the left canvas.
    pub x: usize,
    /// See `x`.
    pub y: usize,
    /// Displacement along the row: minus the disparity.
    pub u_px: i64,
    /// Displacement across the rows.
    pub v_px: i64,
}

/// All windows that were found.
#[derive(Debug, Clone)]
pub struct Searched {
    /// The windows.
    pub found: Vec<Found>,
    /// How many were looked for.
    pub windows: usize,
}

/// Searches windows on a grid over the left canvas.
pub fn search(stack: &RectifiedStack, options: &Options) -> Searched {
    let coarse = |images: &[Image<Sample>]| -> Vec<Image<i16>> {
        images.iter().map(|image| image.map(|v| v >> SHIFT)).collect()
    };
    let searcher = Searcher {
        left: coarse(&stack.left),
        right: coarse(&stack.right),
        left_mask: stack.rectifier.left_mask(),
        right_mask: stack.rectifier.right_mask(),
        radius: options.radius_px,
    };
    let range = stack.rectifier.disparity_range();
    let us = (-i64::from(range.max_px), -i64::from(range.min_px));
    let places = searcher.places(options.spacing_px);
    let reach = options.search_px as i64;
    let stride = (places.len() / SCOUTS).max(1);
    let scouts: Vec<Found> = places
        .par_iter()
        .step_by(stride)
        .filter_map(|&place| searcher.find(place, us, (-reach, reach)))
        .collect();
    let mut rows: Vec<i64> = scouts.iter().map(|found| found.v_px).collect();
    rows.sort_unstable();
    let Some(&middle) = rows.get(rows.len() / 2) else {
        return Searched { found: Vec::new(), windows: places.len() };
    };
    let near = (middle - NEAR_PX, middle + NEAR_PX);
    let found = places.par_iter().filter_map(|&place| searcher.find(place, us, near)).collect();
    Searched { found, windows: places.len() }
}

struct Searcher<'a> {
    left: Vec<Image<i16>>,
    right: Vec<Image<i16>>,
    left_mask: &'a Image<u8>,
    right_mask: &'a Image<u8>,
    radius: usize,
}

impl Searcher<'_> {
    /// Middles of windows that the left camera saw whole.
    fn places(&self, spacing: usize) -> Vec<(usize, usize)> {
        let (width, height) = (self.left_mask.width(), self.left_mask.height());
        let first = self.radius + 8;
        let ys = (first..height.saturating_sub(first)).step_by(spacing.max(1));
        ys.flat_map(|y| {
            (first..width.saturating_sub(first)).step_by(spacing.max(1)).map(move |x| (x, y))
        })
        .filter(|&(x, y)| self.is_seen(self.left_mask, x as i64, y as i64))
        .collect()
    }

    /// Whether a window's corners and middle are in a mask.
    fn is_seen(&self, mask: &Image<u8>, x: i64, y: i64) -> bool {
        let r = self.radius as i64;
        [(0, 0), (-r, -r), (r, -r), (-r, r), (r, r)].into_iter().all(|(dx, dy)| {
            let (x, y) = (x + dx, y + dy);
            x >= 0 && y >= 0 && mask.get(x as usize, y as usize).is_some_and(|seen| seen != 0)
        })
    }

    /// The most similar place, if it is similar enough and unlike all others.
    fn find(&self, (x, y): (usize, usize), us: (i64, i64), vs: (i64, i64)) -> Option<Found> {
        let r = self.radius;
        let rows: Vec<&[i16]> = self
            .left
            .iter()
            .flat_map(|image| {
                (0..=2 * r).step_by(ROW_STEP).map(move |k| &image.row(y + k - r)[x - r..=x + r])
            })
            .collect();
        let n = (rows.len() * (2 * r + 1)) as f64;
        let (mut l, mut ll) = (0_i32, 0_i32);
        for row in &rows {
            for value in *row {
                l += i32::from(*value);
                ll += i32::from(*value) * i32::from(*value);
            }
        }
        let (l, ll) = (f64::from(l), f64::from(ll));
        let norm_l = (ll - l * l / n).max(0.0).sqrt();
        // A grey value and a half of contrast: less is noise at whole grey values.
        if norm_l < 1.5 * n.sqrt() {
            return None;
        }
        let mut best: Option<(f64, i64, i64)> = None;
        let mut all = Vec::new();
        for v in vs.0..=vs.1 {
            for u in us.0..=us.1 {
                let (rx, ry) = (x as i64 + u, y as i64 + v);
                if !self.is_seen(self.right_mask, rx, ry) {
                    continue;
                }
                let (rx, ry) = (rx as usize, ry as usize);
                let (mut g, mut gg, mut lg) = (0_i32, 0_i32, 0_i32);
                let mut rows = rows.iter();
                for image in &self.right {
                    for k in (0..=2 * r).step_by(ROW_STEP) {
                        let right = &image.row(ry + k - r)[rx - r..=rx + r];
                        let Some(left) = rows.next() else { break };
                        for (a, b) in left.iter().zip(right) {
                            let (a, b) = (i32::from(*a), i32::from(*b));
                            g += b;
                            gg += b * b;
                            lg += a * b;
                        }
                    }
                }
                let (g, gg, lg) = (f64::from(g), f64::from(gg), f64::from(lg));
                let norm_r = (gg - g * g / n).max(0.0).sqrt();
                let zncc = if norm_r > 0.0 { (lg - l * g / n) / (norm_l * norm_r) } else { 0.0 };
                all.push((zncc, u, v));
                if best.is_none_or(|(most, ..)| zncc > most) {
                    best = Some((zncc, u, v));
                }
            }
        }
        let (most, u, v) = best?;
        let second = all
            .iter()
            .filter(|(_, other_u, other_v)| {
                (other_u - u).abs() > APART_PX || (other_v - v).abs() > APART_PX
            })
            .map(|(zncc, ..)| *zncc)
            .fold(0.0, f64::max);
        (most >= ZNCC_MIN && most - second >= UNIQUE).then_some(Found { x, y, u_px: u, v_px: v })
    }
}
