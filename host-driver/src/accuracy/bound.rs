//! How near any fit of windows can come: the dense estimate (`stspp_matcher::dense`) written from its
//! equations in f64, slowly, and told the truth.
//!
//! Every pixel of a window is compared at its true disparity, and only pixels of the centre's own
//! surface that both cameras see take part. A search, a start, an iteration or a mask has no part in what
//! is left: noise, and what the lens's blur, the pixels' size and the window's shape function lose of the
//! surface. Where one window loses much, a matcher may do better with another, but not than the best of
//! them. The interpolation here does not smooth; one that does has up to a fifth less noise on flat
//! surfaces.
//!
//! A fit that is told the truth also keeps some of it: one step from a place beside the truth does not
//! come back all the way, least where one camera sees the surface foreshortened, so that its images are
//! smoother along the row than the other's and differ less from step to step than the gradient says. Each
//! window is therefore fitted a second time from 0.1 px beside the truth: the part of that which is left
//! says where steps come to rest.

use std::fmt::Write as _;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use serde::Serialize;
use stspp_matcher::{Image, dense::kernels::Kernels};

use super::CanvasTruth;
use super::budget::{NEAR_PX, step_distances, true_disparity_px};
use super::score::OUTLIER_M;
use crate::DepthFrame;
use crate::measure::rms;
use crate::reconstruct::{FRAMES_MAX, RectifiedStack};

/// Windows that are fitted: radius in px, order of the shape function and name.
pub const WINDOWS: [(usize, usize, &str); 5] = [
    (4, 1, "9x9 first"),
    (4, 2, "9x9 second"),
    (2, 1, "5x5 first"),
    (2, 2, "5x5 second"),
    (1, 1, "3x3 first"),
];
/// Radius of the largest.
const RADIUS: usize = 4;
const SIDE: usize = 2 * RADIUS + 1;
/// Gain and offset are taken over windows of at least this radius.
const GAIN_RADIUS: usize = 2;
/// Neighbours of one surface have true disparities that differ by less.
const JOINED_PX: f32 = 1.5;
/// Steeper slopes are not asked for: they are edges.
const SLOPE_MAX: f64 = 1.0;
/// One pixel in so many is fitted.
const SAMPLE: usize = 8;
/// How far beside the truth the second fit begins.
const SHIFT_PX: f64 = 0.1;
/// Most of a shift that is taken to be left; the sphere's rim has 0.6. What has more shows nothing, and its
/// steps lead nowhere.
const LEFT_MAX: f64 = 0.7;
/// Taps of the interpolation between right pixels.
const TAPS: usize = 8;
/// Upper ends of the classes by distance from true steps.
const DISTANCES_PX: [u8; 5] = [1, 2, 4, NEAR_PX, u8::MAX];

/// The pixels at one distance from true steps.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Class {
    /// That distance in px, "all" in the end.
    pub distance_px: &'static str,
    /// Pixels that were fitted: a sample of the frame's points that both cameras see.
    pub points: usize,
    /// RMS of the frame's own distance from the true surface there, in millimetres.
    pub frame_normal_rms_mm: f64,
    /// The same of the fits of [`WINDOWS`].
    pub window_normal_rms_mm: [f64; WINDOWS.len()],
    /// The same of where further steps of these fits come to rest.
    pub rest_normal_rms_mm: [f64; WINDOWS.len()],
    /// The part of a shift that is left after one step: the median.
    pub left_of_shift: [f64; WINDOWS.len()],
}

/// One pixel of a window.
struct Sample {
    /// Place relative to the centre, px.
    at: (f64, f64),
    left: [f64; FRAMES_MAX],
    /// Right grey values at the true disparity, and [`SHIFT_PX`] beside it.
    right: [[f64; FRAMES_MAX]; 2],
    /// Left gradient along the row.
    gradient: [f64; FRAMES_MAX],
    /// True disparity less the centre's, px, and its slope along the row.
    w: f64,
    slope: f64,
}

/// What a window is cut from.
struct Scene<'a> {
    stack: &'a RectifiedStack,
    frames: usize,
    true_px: &'a Image<f32>,
    visible: &'a Image<u8>,
}

/// Fits sampled points of a frame of the stack's first `frames` pairs with all [`WINDOWS`]. Points off by
/// more than 5 mm are left out, as they are of a [`Score`](super::Score)'s RMS.
pub fn bound(
    stack: &RectifiedStack,
    frames: usize,
    frame: &DepthFrame,
    truth: &CanvasTruth,
) -> Vec<Class> {
    let true_px = true_disparity_px(frame, truth);
    let distance = step_distances(frame, truth);
    let scene = Scene { stack, frames, true_px: &true_px, visible: &truth.visible_to_both };
    let (width, height) = (true_px.width(), true_px.height());
    let margin = RADIUS + TAPS / 2;
    let rows = margin..height.saturating_sub(margin);
    let points: Vec<Point> = rows
        .into_par_iter()
        .flat_map_iter(|y| {
            let (scene, distance) = (&scene, &distance);
            (margin..width.saturating_sub(margin)).filter_map(move |x| {
                let z = frame.depth_m.row(y)[x];
                let error_m = truth.error_normal_m(x, y, z);
                let off = (z - truth.depth_m.row(y)[x]).abs() > OUTLIER_M;
                let skipped = (x + 3 * y) % SAMPLE != 0 || scene.visible.row(y)[x] == 0;
                if skipped || error_m.is_nan() || off {
                    return None;
                }
                let samples = scene.window(x, y);
                let true_px = f64::from(scene.true_px.row(y)[x]);
                let normal_m = |off_px: f64| {
                    let z_m = frame.geometry.depth_left_m(x as f64, y as f64, true_px + off_px)?;
                    Some(truth.error_normal_m(x, y, z_m as f32))
                };
                let class = DISTANCES_PX.iter().position(|d| distance.row(y)[x] <= *d)?;
                let mut point = Point { class, error_m, windows: Default::default() };
                for (to, &(radius, order, _)) in point.windows.iter_mut().zip(&WINDOWS) {
                    let off_px = fit(&samples, frames, radius, order, 0)?;
                    let shifted_px = fit(&samples, frames, radius, order, 1)?;
                    let left = (shifted_px - off_px) / SHIFT_PX;
                    let rest_px = off_px / (1.0 - left.clamp(0.0, LEFT_MAX));
                    *to = Fitted { error_m: normal_m(off_px)?, rest_m: normal_m(rest_px)?, left };
                }
                Some(point)
            })
        })
        .collect();
    let names = ["0 to 1", "1 to 2", "2 to 4", "4 to 8", "over 8", "all"];
    let class = |(k, distance_px): (usize, &'static str)| {
        let of = || points.iter().filter(move |p| p.class == k || k == DISTANCES_PX.len());
        let rms_mm = |of_window: fn(&Fitted) -> f64| {
            std::array::from_fn(|w| rms(of().map(|p| of_window(&p.windows[w]) * 1e3)))
        };
        Class {
            distance_px,
            points: of().count(),
            frame_normal_rms_mm: rms(of().map(|p| p.error_m * 1e3)),
            window_normal_rms_mm: rms_mm(|fitted| fitted.error_m),
            rest_normal_rms_mm: rms_mm(|fitted| fitted.rest_m),
            left_of_shift: std::array::from_fn(|w| {
                let mut left: Vec<f64> = of().map(|p| p.windows[w].left).collect();
                left.sort_by(f64::total_cmp);
                left.get(left.len() / 2).copied().unwrap_or(f64::NAN)
            }),
        }
    };
    names.into_iter().enumerate().map(class).collect()
}

/// A point that was fitted.
struct Point {
    class: usize,
    /// The frame's error.
    error_m: f64,
    windows: [Fitted; WINDOWS.len()],
}

/// What a window gives.
#[derive(Clone, Copy, Default)]
struct Fitted {
    error_m: f64,
    /// The error where further steps come to rest.
    rest_m: f64,
    /// The part of a shift that is left after one step.
    left: f64,
}

impl Scene<'_> {
    /// The window around a pixel: what is joined to it without a step.
    fn window(&self, x: usize, y: usize) -> Vec<Sample> {
        let at = |i: usize, j: usize| (x + i - RADIUS, y + j - RADIUS);
        let known = |i: usize, j: usize| {
            let (x, y) = at(i, j);
            let seen = self.visible.row(y)[x] != 0;
            if seen { self.true_px.row(y)[x] } else { f32::NAN }
        };
        let mut member = [[false; SIDE]; SIDE];
        let mut open = vec![(RADIUS, RADIUS)];
        member[RADIUS][RADIUS] = true;
        while let Some((i, j)) = open.pop() {
            let beside = [(i.wrapping_sub(1), j), (i + 1, j), (i, j.wrapping_sub(1)), (i, j + 1)];
            for (a, b) in beside.into_iter().filter(|&(a, b)| a < SIDE && b < SIDE) {
                if !member[b][a] && (known(a, b) - known(i, j)).abs() < JOINED_PX {
                    member[b][a] = true;
                    open.push((a, b));
                }
            }
        }
        let centre_px = f64::from(self.true_px.row(y)[x]);
        let places = (0..SIDE * SIDE).map(|k| (k % SIDE, k / SIDE));
        let members = places.filter(|&(i, j)| member[j][i]);
        members.filter_map(|(i, j)| self.sample(at(i, j), (x, y), centre_px)).collect()
    }

    /// A pixel of the window around `centre`; none where the interpolation leaves the right image.
    fn sample(
        &self,
        (x, y): (usize, usize),
        centre: (usize, usize),
        centre_px: f64,
    ) -> Option<Sample> {
        let row = self.true_px.row(y);
        // Per start of a fit the first of its taps and their weights.
        let taps_at = |shift_px: f64| {
            let place = x as f64 - f64::from(row[x]) - shift_px;
            let first = place.floor() - (TAPS / 2 - 1) as f64;
            let inside = first >= 0.0 && first as usize + TAPS <= row.len();
            inside.then(|| (first as usize, lanczos(place - place.floor())))
        };
        let starts = [taps_at(0.0)?, taps_at(SHIFT_PX)?];
        let half = f64::from(row[x + 1] - row[x - 1]) / 2.0;
        let mut sample = Sample {
            at: (x as f64 - centre.0 as f64, y as f64 - centre.1 as f64),
            left: [0.0; FRAMES_MAX],
            right: [[0.0; FRAMES_MAX]; 2],
            gradient: [0.0; FRAMES_MAX],
            w: f64::from(row[x]) - centre_px,
            slope: if half.abs() < SLOPE_MAX { half } else { 0.0 },
        };
        for k in 0..self.frames {
            let (left, right) = (self.stack.left[k].row(y), self.stack.right[k].row(y));
            sample.left[k] = f64::from(left[x]);
            for (to, (first, taps)) in sample.right.iter_mut().zip(&starts) {
                let rights = right[*first..].iter().zip(taps);
                to[k] = rights.map(|(v, tap)| f64::from(*v) * tap).sum();
            }
            let apart = |d: usize| f64::from(left[x + d]) - f64::from(left[x - d]);
            // A central difference of high order has a fifth more noise than this filter for dots.
            let taps = Kernels::get().gradient_exact.iter().zip(1..);
            sample.gradient[k] = taps.map(|(c, d)| c * apart(d)).sum();
        }
        Some(sample)
    }
}

/// Lanczos' kernel of eight taps for a fraction of a pixel; the taps sum to one.
pub(super) fn lanczos(fraction: f64) -> [f64; TAPS] {
    let taps: [f64; TAPS] = std::array::from_fn(|k| {
        let x = std::f64::consts::PI * (k as f64 - (TAPS / 2 - 1) as f64 - fraction);
        let half = x / (TAPS / 2) as f64;
        if x.abs() < 1e-9 { 1.0 } else { x.sin() / x * half.sin() / half }
    });
    let sum: f64 = taps.iter().sum();
    taps.map(|tap| tap / sum)
}

/// The fit's disparity less the true one at the centre, in px, by the window's samples within `radius`:
/// q = S w - (1 - dw/dx) b and M^-1 sum phi q, as in the dense estimate; one step from the truth (`start`
/// 0) or from [`SHIFT_PX`] beside it (1). `None` where too few take part.
fn fit(
    samples: &[Sample],
    frames: usize,
    radius: usize,
    order: usize,
    start: usize,
) -> Option<f64> {
    let within = |radius: usize| {
        let r = radius as f64;
        samples.iter().filter(move |s| s.at.0.abs() <= r && s.at.1.abs() <= r)
    };
    // Gain and offset of the right image against the left: ZNSSD.
    let moments = |values: &dyn Fn(&Sample) -> [f64; FRAMES_MAX]| {
        let of =
            || within(radius.max(GAIN_RADIUS)).flat_map(|s| values(s).into_iter().take(frames));
        let mean = of().sum::<f64>() / of().count().max(1) as f64;
        (mean, of().map(|v| (v - mean).powi(2)).sum::<f64>())
    };
    let (mean_l, energy_l) = moments(&|s| s.left);
    let (mean_r, energy_r) = moments(&|s| s.right[start]);
    let gain = (energy_l / energy_r).sqrt();
    let terms = if order == 1 { 3 } else { 6 };
    let mut m = DMatrix::zeros(terms, terms);
    let mut rhs = DVector::zeros(terms);
    let unit = radius as f64;
    for sample in within(radius) {
        let (mut s, mut b) = (0.0, 0.0);
        for k in 0..frames {
            let residual = (sample.left[k] - mean_l) - gain * (sample.right[start][k] - mean_r);
            s += sample.gradient[k].powi(2);
            b += sample.gradient[k] * residual;
        }
        let q = s * (sample.w + start as f64 * SHIFT_PX) - (1.0 - sample.slope) * b;
        let (u, v) = (sample.at.0 / unit, sample.at.1 / unit);
        let phi = DVector::from_column_slice(&[1.0, u, v, u * u, u * v, v * v][..terms]);
        m += &phi * phi.transpose() * s;
        rhs += phi * q;
    }
    let solution = m.lu().solve(&rhs)?;
    Some(solution[0]).filter(|d| d.is_finite())
}

/// Classes as text columns: per class a line of the fits that are told the truth, one of where they come to
/// rest, and one of what a step leaves of a shift.
pub fn to_text(classes: &[Class]) -> String {
    let mut text =
        format!("{:<18} {:>8} {:>11} {:<14}", "px to a true step", "points", "frame", "");
    for (.., name) in WINDOWS {
        let _ = write!(text, " {name:>11}");
    }
    text += "\n";
    for class in classes {
        let Class { distance_px, points, frame_normal_rms_mm, .. } = class;
        let _ = write!(text, "{distance_px:<18} {points:>8} {frame_normal_rms_mm:>11.4}");
        let lines = [
            ("told the truth", class.window_normal_rms_mm),
            ("at rest", class.rest_normal_rms_mm),
            ("left of shift", class.left_of_shift),
        ];
        for (k, (name, values)) in lines.into_iter().enumerate() {
            let _ =
                write!(text, "{:>indent$} {name:<14}", "", indent = if k == 0 { 0 } else { 39 });
            for value in values {
                let _ = write!(text, " {value:>11.4}");
            }
            text += "\n";
        }
    }
    text
}
