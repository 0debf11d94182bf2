//! What a check found, for people and for programs.

use std::fmt::Write as _;

use nalgebra::{Isometry3, Vector3};
use serde::Serialize;

use super::drift::{self, Drift};
use super::{Checked, Match, Matches};
use crate::StereoCalibration;
use crate::calibration::essential;
use crate::rectify::rect_from_left;

/// Epipolar RMS up to which a calibration is good: below it, nothing measurable is lost.
pub const GOOD_PX: f64 = 0.1;
/// Epipolar RMS up to which it can be used; beyond, points are lost and depths are off.
pub const USABLE_PX: f64 = 0.3;

/// Depth error, at 1 m and growing with the square of the depth, that counts as much as these: what 0.1
/// and 0.3 px along the rows are for the default sensor. A yaw hardly shows across the rows.
pub const GOOD_MM_AT_1_M: f64 = 0.13;
/// See [`GOOD_MM_AT_1_M`].
pub const USABLE_MM_AT_1_M: f64 = 0.4;

/// A calibration's state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Nothing to do.
    Good,
    /// It can be used; correcting it brings accuracy.
    Drifted,
    /// It should not be used as it is.
    Bad,
}

/// Vertical disparities of the windows, with one calibration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Vertical {
    /// Root mean square without the windows beyond four robust standard deviations, in px.
    pub rms_px: f64,
    /// Mean.
    pub mean_px: f64,
    /// Largest of nine tenths of the windows.
    pub p90_px: f64,
    /// Means over the field's parts, `[row][column]` from the upper left; NaN becomes null.
    pub parts_px: [[f64; 3]; 3],
}

/// Difference of the depths by the calibration as it is and as corrected.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DepthEffect {
    /// Mean.
    pub mean_mm: f64,
    /// Root mean square.
    pub rms_mm: f64,
    /// Largest.
    pub worst_mm: f64,
    /// Median depth of the windows.
    pub depth_m: f64,
}

/// The report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The verdict.
    pub verdict: Verdict,
    /// Windows looked for, found with the calibration as it is, found with the corrected one.
    pub windows: [usize; 3],
    /// Vertical disparities with the calibration as it is, of all windows that the corrected one
    /// finds.
    pub before: Vertical,
    /// The same with the corrected calibration.
    pub after: Vertical,
    /// Median similarity on the same row and with vertical displacement, as it is.
    pub zncc_on_row: f64,
    /// See `zncc_on_row`.
    pub zncc: f64,
    /// The turn of the right camera.
    pub drift: Drift,
    /// Whether the turn is larger than its uncertainty.
    pub is_significant: bool,
    /// What it does to depths.
    pub depth: DepthEffect,
}

impl Report {
    /// Makes the report.
    pub fn new(calibration: &StereoCalibration, checked: &Checked) -> Self {
        let before = vertical(calibration, &checked.after);
        let after = vertical(&checked.corrected, &checked.after);
        let median = |value: &dyn Fn(&Match) -> f64| {
            let mut values: Vec<f64> = checked.before.matches.iter().map(value).collect();
            values.retain(|v| v.is_finite());
            values.sort_unstable_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
        };
        let drift = &checked.drift;
        let is_significant = drift.is_significant();
        let depth = depth_effect(calibration, &checked.corrected, &checked.after);
        let costs_mm = if is_significant { depth.rms_mm / depth.depth_m.powi(2) } else { 0.0 };
        let within = |px: f64, mm: f64| before.rms_px <= px && costs_mm <= mm;
        let verdict = if within(GOOD_PX, GOOD_MM_AT_1_M) {
            Verdict::Good
        } else if within(USABLE_PX, USABLE_MM_AT_1_M) {
            Verdict::Drifted
        } else {
            Verdict::Bad
        };
        Self {
            verdict,
            windows: [
                checked.before.windows,
                checked.before.matches.len(),
                checked.after.matches.len(),
            ],
            before,
            after,
            zncc_on_row: median(&|m| m.zncc_on_row),
            zncc: median(&|m| m.zncc),
            drift: drift.clone(),
            is_significant,
            depth,
        }
    }

    /// The verdict in words.
    pub fn verdict_text(&self) -> String {
        match (self.verdict, self.is_significant) {
            (Verdict::Good, _) => "good: nothing to do".into(),
            (_, true) if self.after.rms_px <= GOOD_PX => format!(
                "{}: a turned camera explains it; correct it with --correct OUT.yaml",
                if self.verdict == Verdict::Bad { "bad" } else { "drifted" }
            ),
            _ => format!(
                "{}: a turned camera does not explain it; calibrate anew (stspp calibrate)",
                if self.verdict == Verdict::Bad { "bad" } else { "drifted" }
            ),
        }
    }

    /// The report as text.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        let _ = writeln!(text, "{}", self.verdict_text());
        let _ = writeln!(
            text,
            "epipolar RMS {:.3} px (mean {:+.3}, nine tenths within {:.3}); {:.3} px after correction",
            self.before.rms_px, self.before.mean_px, self.before.p90_px, self.after.rms_px
        );
        let _ = writeln!(
            text,
            "in depth {:+.3} mm mean, {:.3} mm rms, {:.3} mm at worst (median depth {:.2} m)",
            self.depth.mean_mm, self.depth.rms_mm, self.depth.worst_mm, self.depth.depth_m
        );
        let _ = writeln!(
            text,
            "similarity {:.3} on the row, {:.3} with vertical displacement; {} of {} windows found",
            self.zncc_on_row, self.zncc, self.windows[1], self.windows[0]
        );
        let _ = writeln!(text, "right camera turned by");
        let names = ["pitch (about x)", "yaw (about y)", "roll (about z)"];
        for (k, name) in names.into_iter().enumerate() {
            let (angle, sigma) = (self.drift.angles_deg[k], self.drift.sigmas_deg[k]);
            let note = match (sigma > 0.0, k) {
                (false, _) => "  not looked at",
                (true, 1) if self.drift.correction_deg[1] == 0.0 => {
                    "  seen by keystone only, within its uncertainty: left as it is"
                }
                (true, 1) => "  seen by keystone only",
                _ => "",
            };
            let _ = writeln!(text, "  {name:<16} {angle:+.4} +- {sigma:.4} degrees{note}");
        }
        let _ = writeln!(text, "vertical disparity over the field in px:");
        for row in self.before.parts_px {
            let cells: Vec<String> = row.iter().map(|v| format!("{v:+8.3}")).collect();
            let _ = writeln!(text, "  {}", cells.join(" "));
        }
        text
    }
}

fn vertical(calibration: &StereoCalibration, matches: &Matches) -> Vertical {
    let essential = essential(&calibration.right_from_left);
    let values: Vec<f64> = matches
        .matches
        .iter()
        .map(|found| matches.focal_px * drift::vertical(&essential, found))
        .collect();
    let mut sorted = values.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let off: Vec<f64> = values.iter().map(|v| v - median).collect();
    let limit = 4.0 * drift::robust_sigma(&off).max(1e-3);
    let kept: Vec<f64> = values.iter().copied().filter(|v| (v - median).abs() <= limit).collect();
    let n = kept.len().max(1) as f64;
    let mut magnitudes: Vec<f64> = values.iter().map(|v| v.abs()).collect();
    magnitudes.sort_unstable_by(f64::total_cmp);
    let mut parts = [[(0.0, 0.0); 3]; 3];
    let bounds = |value: &dyn Fn(&Match) -> f64| {
        let all = || matches.matches.iter().map(value);
        (all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max))
    };
    let (xs, ys) = (bounds(&|m| m.left_px.x), bounds(&|m| m.left_px.y));
    for (found, value) in matches.matches.iter().zip(&values) {
        let part = |at: f64, (low, high): (f64, f64)| {
            (((at - low) / (high - low).max(1e-9) * 3.0) as usize).min(2)
        };
        let cell = &mut parts[part(found.left_px.y, ys)][part(found.left_px.x, xs)];
        if (value - median).abs() <= limit {
            *cell = (cell.0 + value, cell.1 + 1.0);
        }
    }
    Vertical {
        rms_px: (kept.iter().map(|v| v * v).sum::<f64>() / n).sqrt(),
        mean_px: kept.iter().sum::<f64>() / n,
        p90_px: magnitudes[(magnitudes.len() - 1) * 9 / 10],
        parts_px: parts.map(|row| row.map(|(sum, count)| sum / count)),
    }
}

/// Depth, in the left camera's frame, that a matcher finds for two rays: by their distance along the
/// rows of the calibration's canvases.
fn depth_m(calibration: &StereoCalibration, found: &Match) -> Option<f64> {
    let rect_from_left = rect_from_left(calibration).ok()?;
    let left_from_right: Isometry3<f64> = calibration.right_from_left.inverse();
    let left = rect_from_left * found.left_ray;
    let right = rect_from_left * (left_from_right.rotation * found.right_ray);
    let parallax = left.x / left.z - right.x / right.z;
    if parallax <= 0.0 {
        return None;
    }
    let point: Vector3<f64> = left / left.z * (calibration.baseline_m() / parallax);
    Some((rect_from_left.inverse() * point).z)
}

fn depth_effect(
    calibration: &StereoCalibration,
    corrected: &StereoCalibration,
    matches: &Matches,
) -> DepthEffect {
    let depths: Vec<(f64, f64)> = matches
        .matches
        .iter()
        .filter_map(|found| Some((depth_m(calibration, found)?, depth_m(corrected, found)?)))
        .collect();
    let errors: Vec<f64> = depths.iter().map(|(now, then)| 1e3 * (now - then)).collect();
    let n = errors.len().max(1) as f64;
    let mut sorted: Vec<f64> = depths.iter().map(|(_, then)| *then).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    DepthEffect {
        mean_mm: errors.iter().sum::<f64>() / n,
        rms_mm: (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt(),
        worst_mm: errors.iter().fold(0.0, |worst, e| e.abs().max(worst)),
        depth_m: sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN),
    }
}
