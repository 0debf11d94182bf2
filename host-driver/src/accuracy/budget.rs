//! What a depth frame's error is made of: its pixels in classes by the true surface around them.

use std::fmt::Write as _;

use serde::Serialize;
use stspp_matcher::Image;

use super::CanvasTruth;
use super::score::OUTLIER_M;
use crate::DepthFrame;

/// Neighbours whose true disparities differ by more are on two sides of a step...
const STEP_PX: f32 = 1.5;
/// ...unless the slope beyond one of them is the same to within this.
const BEND_PX: f32 = 1.0;
/// Pixels this near a true step are not classed by their surface's shape.
pub(super) const NEAR_PX: u8 = 8;
/// Half a window of 9 x 9 pixels.
const RADIUS: usize = 4;

/// Pixels of one class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Class {
    /// What the classes of its group differ in.
    pub group: &'static str,
    /// From and to, of that.
    pub range: String,
    /// Part of what both cameras see.
    pub visible: f64,
    /// Visible pixels that are missing, as a part of all visible ones.
    pub missing: f64,
    /// Points off by more than 5 mm, as a part of all points.
    pub outliers: f64,
    /// RMS along the ray of the points within 5 mm, in millimetres.
    pub rms_mm: f64,
    /// RMS of their distance from the true surface, in millimetres.
    pub normal_rms_mm: f64,
    /// Their part in the sum of squared errors of all.
    pub share: f64,
}

/// Sums of a class.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    visible: usize,
    missing: usize,
    wrong: usize,
    good: usize,
    squares_mm2: f64,
    normal_mm2: f64,
}

/// A way to class pixels.
struct Group {
    name: &'static str,
    /// Upper ends of all classes but the last.
    bounds: &'static [f32],
    /// Far from steps only.
    far: bool,
}

const INCIDENCES_DEG: &[f32] = &[30.0, 45.0, 60.0, 75.0, 82.0];
const GROUPS: [Group; 5] = [
    Group { name: "px to a true step", bounds: &[1.0, 2.0, 4.0, 8.0], far: false },
    Group { name: "slope, px/px", bounds: &[0.1, 0.3, 0.6, 1.0, 2.0], far: true },
    Group { name: "bend of 9 x 9, px", bounds: &[0.01, 0.03, 0.1, 0.3], far: true },
    Group { name: "incidence, deg", bounds: INCIDENCES_DEG, far: true },
    Group { name: "at steps too", bounds: INCIDENCES_DEG, far: false },
];

/// Classes the pixels of a frame by their distance from true depth steps and, more than 8 px away from
/// these, by the true disparity's slope, by what a second-order surface over 9 x 9 pixels misses of it,
/// and by how grazing the cameras see it; by that also near steps.
pub fn budget(frame: &DepthFrame, truth: &CanvasTruth) -> Vec<Class> {
    let (width, height) = (truth.depth_m.width(), truth.depth_m.height());
    let disparity = true_disparity_px(frame, truth);
    let distance = distances(&steps(&disparity));
    let mut sums: Vec<Vec<Sums>> =
        GROUPS.iter().map(|g| vec![Sums::default(); g.bounds.len() + 1]).collect();
    let (mut visible, mut points, mut squares_mm2) = (0usize, 0usize, 0.0);
    for y in 0..height {
        for x in 0..width {
            let both = truth.visible_to_both.row(y)[x] != 0;
            let (z, true_z) = (frame.depth_m.row(y)[x], truth.depth_m.row(y)[x]);
            if !both && z.is_nan() {
                continue;
            }
            let error = z - true_z;
            let mut one = Sums { visible: usize::from(both), ..Sums::default() };
            if z.is_nan() {
                one.missing = 1;
            } else if error.abs() <= OUTLIER_M {
                let along = truth.error_along_ray_m(x, y, z) * 1e3;
                let normal = truth.error_normal_m(x, y, z) * 1e3;
                (one.good, one.squares_mm2, one.normal_mm2) = (1, along * along, normal * normal);
            } else {
                one.wrong = 1;
            }
            visible += one.visible;
            points += one.good + one.wrong;
            squares_mm2 += one.squares_mm2;
            let near = distance.row(y)[x];
            for (k, group) in GROUPS.iter().enumerate() {
                if group.far && near <= NEAR_PX {
                    continue;
                }
                let value = match k {
                    0 => f32::from(near),
                    1 => slope(&disparity, x, y),
                    2 => bend(&disparity, x, y),
                    _ => truth.incidence_deg.row(y)[x],
                };
                let class = group.bounds.iter().position(|b| value <= *b);
                let to = &mut sums[k][class.unwrap_or(group.bounds.len())];
                to.visible += one.visible;
                to.missing += one.missing;
                to.wrong += one.wrong;
                to.good += one.good;
                to.squares_mm2 += one.squares_mm2;
                to.normal_mm2 += one.normal_mm2;
            }
        }
    }
    let part = |n: usize, of: usize| n as f64 / of.max(1) as f64;
    let classes = GROUPS.iter().zip(&sums).flat_map(|(group, sums)| {
        sums.iter().enumerate().map(move |(k, s)| {
            let from = if k == 0 { 0.0 } else { group.bounds[k - 1] };
            let range = match group.bounds.get(k) {
                Some(to) => format!("{from} to {to}"),
                None => format!("over {from}"),
            };
            (group.name, range, *s)
        })
    });
    classes
        .map(|(group, range, s)| Class {
            group,
            range,
            visible: part(s.visible, visible),
            missing: part(s.missing, visible),
            outliers: part(s.wrong, points),
            rms_mm: (s.squares_mm2 / s.good.max(1) as f64).sqrt(),
            normal_rms_mm: (s.normal_mm2 / s.good.max(1) as f64).sqrt(),
            share: s.squares_mm2 / squares_mm2.max(f64::MIN_POSITIVE),
        })
        .collect()
}

/// Distance of every pixel from the next true depth step, where it is at most [`NEAR_PX`].
pub(super) fn step_distances(frame: &DepthFrame, truth: &CanvasTruth) -> Image<u8> {
    distances(&steps(&true_disparity_px(frame, truth)))
}

/// The true disparity of every pixel; NaN where there is nothing.
pub(super) fn true_disparity_px(frame: &DepthFrame, truth: &CanvasTruth) -> Image<f32> {
    let geometry = &frame.geometry;
    let (width, height) = (truth.distance_m.width(), truth.distance_m.height());
    let mut disparity = Image::new(width, height, f32::NAN);
    for y in 0..height {
        for (x, distance_m) in truth.distance_m.row(y).iter().enumerate() {
            let u = (x as f64 - geometry.cx_left_px) / geometry.focal_px;
            let v = (y as f64 - geometry.cy_px) / geometry.focal_px;
            let z_m = f64::from(*distance_m) / (u * u + v * v + 1.0).sqrt();
            let parallax_px = geometry.focal_px * geometry.baseline_m / z_m;
            disparity.set(x, y, (parallax_px + geometry.disparity_at_infinity_px()) as f32);
        }
    }
    disparity
}

/// Whether neighbours `a` and `b`, with `before` and `after` beyond them, are on two surfaces. NaN is on
/// none.
fn is_step([before, a, b, after]: [f32; 4]) -> bool {
    let bend = |beyond: f32| (b - a - beyond).abs() <= BEND_PX;
    let joined = (b - a).abs() <= STEP_PX || bend(a - before) || bend(after - b);
    !joined
}

/// Pixels with a step to one of their four neighbours.
fn steps(disparity: &Image<f32>) -> Image<bool> {
    let (width, height) = (disparity.width(), disparity.height());
    let mut out = Image::new(width, height, false);
    let mut mark = |from: (usize, usize), (dx, dy): (usize, usize)| {
        let at = |k: isize| {
            let go = |p: usize, d: usize| p.checked_add_signed(k * d as isize);
            go(from.0, dx).zip(go(from.1, dy)).and_then(|(x, y)| disparity.get(x, y))
        };
        let four = [-1, 0, 1, 2].map(|k| at(k).unwrap_or(f32::NAN));
        let nothing = four[1].is_nan() && four[2].is_nan();
        if !nothing && is_step(four) {
            out.set(from.0, from.1, true);
            out.set(from.0 + dx, from.1 + dy, true);
        }
    };
    for y in 0..height {
        for x in 0..width {
            if x + 1 < width {
                mark((x, y), (1, 0));
            }
            if y + 1 < height {
                mark((x, y), (0, 1));
            }
        }
    }
    out
}

/// Distance from the next mark, by the larger of columns and rows; a pixel beside a step has 1.
fn distances(marks: &Image<bool>) -> Image<u8> {
    let (width, height) = (marks.width(), marks.height());
    let mut rows = Image::new(width, height, u8::MAX);
    for y in 0..height {
        let row = marks.row(y);
        let columns: Vec<usize> = (0..width).filter(|&x| row[x]).collect();
        for x in columns {
            let reach = usize::from(NEAR_PX);
            for at in x.saturating_sub(reach)..(x + reach).min(width) {
                let d = 1 + at.abs_diff(x) as u8;
                let known = &mut rows.row_mut(y)[at];
                *known = (*known).min(d);
            }
        }
    }
    let mut out = rows.clone();
    for y in 0..height {
        for other in y.saturating_sub(usize::from(NEAR_PX))..(y + usize::from(NEAR_PX)).min(height)
        {
            let down = 1 + y.abs_diff(other) as u8;
            for (to, d) in out.row_mut(y).iter_mut().zip(rows.row(other)) {
                *to = (*to).min((*d).max(down));
            }
        }
    }
    out
}

/// Steepest change from pixel to pixel; infinite at the image's border.
fn slope(disparity: &Image<f32>, x: usize, y: usize) -> f32 {
    let at = |dx: isize, dy: isize| {
        let (x, y) = (x.checked_add_signed(dx)?, y.checked_add_signed(dy)?);
        disparity.get(x, y)
    };
    let half = |a: Option<f32>, b: Option<f32>| a.zip(b).map(|(a, b)| 0.5 * (b - a));
    let across = half(at(-1, 0), at(1, 0)).zip(half(at(0, -1), at(0, 1)));
    across.map_or(f32::INFINITY, |(sx, sy)| sx.hypot(sy))
}

/// How far the centre is from the second-order surface of least squares through the window of 9 x 9 true
/// disparities; infinite where some are missing.
fn bend(disparity: &Image<f32>, x: usize, y: usize) -> f32 {
    // At the centre, that surface is the window's mean less its second moments' parts: on a whole grid
    // of side s the weights are (1 - a (u^2 - m) - a (v^2 - m)) / n, with m the mean and v the variance
    // of the squares, and a = m / v.
    let r = RADIUS as isize;
    let squares = (-r..=r).map(|u| (u * u) as f32);
    let count = squares.clone().count() as f32;
    let mean = squares.clone().sum::<f32>() / count;
    let variance = squares.map(|s| (s - mean).powi(2)).sum::<f32>() / count;
    let mut sum = 0.0;
    for v in -r..=r {
        for u in -r..=r {
            let at = x.checked_add_signed(u).zip(y.checked_add_signed(v));
            let value = at.and_then(|(x, y)| disparity.get(x, y)).unwrap_or(f32::NAN);
            let bent = (u * u) as f32 + (v * v) as f32 - 2.0 * mean;
            sum += (value - disparity.row(y)[x]) * (1.0 - mean / variance * bent);
        }
    }
    let off = (sum / (count * count)).abs();
    if off.is_nan() { f32::INFINITY } else { off }
}

/// Classes as text columns.
pub fn to_text(classes: &[Class]) -> String {
    let mut text = format!(
        "{:<18} {:<12} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}\n",
        "class", "", "visible %", "missing %", "outlier %", "ray mm", "normal mm", "share %"
    );
    for c in classes {
        let _ = writeln!(
            text,
            "{:<18} {:<12} {:>9.2} {:>9.3} {:>9.4} {:>9.4} {:>9.4} {:>9.1}",
            c.group,
            c.range,
            100.0 * c.visible,
            100.0 * c.missing,
            100.0 * c.outliers,
            c.rms_mm,
            c.normal_rms_mm,
            100.0 * c.share
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(of: impl Fn(f32, f32) -> f32) -> Image<f32> {
        let mut map = Image::new(40, 30, 0.0);
        for y in 0..30 {
            (0..40).for_each(|x| map.set(x, y, of(x as f32, y as f32)));
        }
        map
    }

    #[test]
    fn a_step_is_found_and_a_steep_surface_is_none() {
        let step = distances(&steps(&map(|x, _| if x < 20.0 { 5.0 } else { 9.0 })));
        assert_eq!(
            [step.row(9)[18], step.row(9)[19], step.row(9)[20], step.row(9)[22]],
            [2, 1, 1, 3]
        );
        assert!(step.row(9)[35] > NEAR_PX && step.row(9)[28] > NEAR_PX);
        assert_eq!(step.row(9)[27], NEAR_PX);
        let steep = steps(&map(|_, y| 4.0 * y));
        assert!(steep.as_slice().iter().all(|s| !s));
    }

    #[test]
    fn a_quadratic_surface_does_not_bend_and_a_ridge_does() {
        let bowl = map(|x, y| 0.02 * x * x - 0.01 * x * y + 0.03 * y * y + 0.4 * x);
        assert!(bend(&bowl, 17, 13) < 1e-3, "{}", bend(&bowl, 17, 13));
        assert!((slope(&map(|x, y| 0.3 * x + 0.4 * y), 17, 13) - 0.5).abs() < 1e-3);
        let ridges = map(|x, _| 0.5 * (x * std::f32::consts::TAU / 8.0).cos());
        assert!(bend(&ridges, 16, 13) > 0.1, "{}", bend(&ridges, 16, 13));
        assert!(bend(&ridges, 2, 13).is_infinite());
    }
}
