//! How many points of a scene any method could tell by their grey values: how alike the cameras see each
//! pixel at its true place.
//!
//! A pixel that a lens mixes of two surfaces, or that one camera sees foreshortened to a fraction, is not
//! the same in both views even where its match is known. Where a limit of similarity keeps wrong points out,
//! such pixels are lost, however they were searched for.

use std::fmt::Write as _;

use rayon::prelude::*;
use serde::Serialize;

use super::CanvasTruth;
use super::bound::lanczos;
use super::budget::true_disparity_px;
use crate::DepthFrame;
use crate::reconstruct::RectifiedStack;

/// Similarities that are counted.
pub const SIMILARITIES: [f64; 5] = [0.5, 0.65, 0.75, 0.84, 0.9];
/// Incidence to the camera that sees a surface more grazingly, from and to: what is steep, and what is not.
const INCIDENCES: [(f32, f32, &str); 3] = [
    (0.0, 75.0, "up to 75 degrees"),
    (75.0, f32::INFINITY, "steeper"),
    (0.0, f32::INFINITY, "all"),
];

/// Pixels of some incidence.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Alike {
    /// Angle between the surface's normal and the camera's view.
    pub incidence: &'static str,
    /// Pixels that both cameras see.
    pub visible: usize,
    /// Part of them that the frame has a point for.
    pub found: f64,
    /// Part of them whose grey values over time, at their true places in both views, are at least as similar
    /// as each of [`SIMILARITIES`]: the correlation coefficient of a single pixel.
    pub alike: [f64; SIMILARITIES.len()],
}

/// Counts the visible pixels by the similarity that the stack's first `frames` pairs have at the true
/// disparity. Between right pixels by Lanczos' kernel of eight taps.
pub fn similar(
    stack: &RectifiedStack,
    frames: usize,
    frame: &DepthFrame,
    truth: &CanvasTruth,
) -> Vec<Alike> {
    let true_px = true_disparity_px(frame, truth);
    let rows = (0..true_px.height()).into_par_iter();
    let pixels: Vec<(f32, bool, f64)> = rows
        .flat_map_iter(|y| {
            let true_px = &true_px;
            let seen = (0..true_px.width()).filter(move |&x| truth.visible_to_both.row(y)[x] != 0);
            seen.map(move |x| {
                let similarity = similarity(stack, frames, (x, y), true_px.row(y)[x]);
                let found = !frame.depth_m.row(y)[x].is_nan();
                (truth.incidence_deg.row(y)[x], found, similarity.unwrap_or(0.0))
            })
        })
        .collect();
    let class = |(from, to, incidence): (f32, f32, &'static str)| {
        let of = || pixels.iter().filter(move |p| p.0 >= from && p.0 < to);
        let visible = of().count();
        let part = |n: usize| n as f64 / visible.max(1) as f64;
        let alike = SIMILARITIES.map(|least| part(of().filter(|p| p.2 >= least).count()));
        Alike { incidence, visible, found: part(of().filter(|p| p.1).count()), alike }
    };
    INCIDENCES.map(class).to_vec()
}

/// Correlation over time of a left pixel and its place on the right; none outside the image.
fn similarity(
    stack: &RectifiedStack,
    frames: usize,
    (x, y): (usize, usize),
    disparity_px: f32,
) -> Option<f64> {
    let place = x as f64 - f64::from(disparity_px);
    let taps = lanczos(place - place.floor());
    let first = place.floor() - (taps.len() / 2 - 1) as f64;
    let width = stack.left.first()?.width();
    let inside = first >= 0.0 && first as usize + taps.len() <= width;
    let first = inside.then_some(first as usize)?;
    let pairs = stack.left.iter().zip(&stack.right).take(frames).map(|(left, right)| {
        let rights = right.row(y)[first..].iter().zip(taps);
        (f64::from(left.row(y)[x]), rights.map(|(v, tap)| f64::from(*v) * tap).sum::<f64>())
    });
    let n = pairs.clone().count() as f64;
    let (l, r) = pairs.clone().fold((0.0, 0.0), |(l, r), (a, b)| (l + a / n, r + b / n));
    let [lr, ll, rr] = pairs.fold([0.0; 3], |[lr, ll, rr], (a, b)| {
        let (a, b) = (a - l, b - r);
        [lr + a * b, ll + a * a, rr + b * b]
    });
    let norm = (ll * rr).sqrt();
    (norm > 0.0).then_some(lr / norm)
}

/// As text columns.
pub fn to_text(classes: &[Alike]) -> String {
    let mut text = format!("{:<18} {:>9} {:>9}", "incidence", "visible", "found %");
    for least in SIMILARITIES {
        let _ = write!(text, " {:>9}", format!(">= {least}"));
    }
    text += "\n";
    for Alike { incidence, visible, found, alike } in classes {
        let _ = write!(text, "{incidence:<18} {visible:>9} {:>9.2}", 100.0 * found);
        for part in alike {
            let _ = write!(text, " {:>9.2}", 100.0 * part);
        }
        text += "\n";
    }
    text
}
