//! A calibration's report, for people and for programs.

use std::fmt::Write as _;

use serde::Serialize;

use super::bundle::SHARED_NAMES;
use super::coverage::{BANDS_M, Coverage};
use super::findings::{Finding, Images, findings};
use super::observations::Observations;
use super::solve::{Solution, rms};
use crate::StereoCalibration;

/// A value and its standard deviation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Parameter {
    /// What it is.
    pub name: &'static str,
    /// Its unit; empty for none.
    pub unit: &'static str,
    /// Its value; for the rig's rotation the rotation vector's component.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// One pair of images.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewReport {
    /// Its name.
    pub name: String,
    /// Points found: left, right.
    pub points: [usize; 2],
    /// Why there are none: left, right.
    pub problems: [Option<String>; 2],
    /// Reprojection RMS: left, right.
    pub rms_px: [Option<f64>; 2],
    /// RMS distance from the epipolar lines.
    pub epipolar_rms_px: Option<f64>,
    /// Distance of the board.
    pub distance_m: Option<f64>,
    /// Triangulated size relative to the stated one.
    pub scale: Option<f64>,
    /// Whether the calibration rests on it.
    pub is_used: bool,
}

/// The whole report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The board, as `--board` takes it.
    pub board: String,
    /// Reprojection RMS: left, right.
    pub rms_px: [f64; 2],
    /// RMS distance from the epipolar lines, over all used views.
    pub epipolar_rms_px: f64,
    /// Standard deviation of one coordinate of a seen point.
    pub sigma_px: f64,
    /// Distance of the cameras in metres.
    pub baseline_m: f64,
    /// All parameters.
    pub parameters: Vec<Parameter>,
    /// (depth in metres, standard deviation of a depth there from the calibration alone in mm).
    pub depth_sigma_mm: Vec<(f64, f64)>,
    /// Points by part of the image and depth.
    pub coverage: Coverage,
    /// Limits of the bands of depth in `coverage`.
    pub bands_m: [f64; 2],
    /// What had no board.
    pub missing: Vec<String>,
    /// What is wrong.
    pub findings: Vec<Finding>,
    /// View by view.
    pub views: Vec<ViewReport>,
}

/// Depths at which the uncertainty is stated.
const DEPTHS_M: [f64; 4] = [0.8, 1.0, 1.5, 2.0];

impl Report {
    /// Makes the report.
    pub fn new(
        observations: &Observations,
        images: &[Images],
        solution: &Solution,
        baseline_m: Option<f64>,
    ) -> Self {
        let calibration = solution.calibration();
        let coverage = Coverage::of(observations, solution);
        let finite = |v: f64| v.is_finite().then_some(v);
        let views = observations
            .views
            .iter()
            .enumerate()
            .map(|(k, view)| {
                let fit = solution.views[k].as_ref();
                let problem = |side: usize| match images.get(k).map(|pair| &pair[side]) {
                    Some(Err(problem)) => Some(problem.to_string()),
                    _ => None,
                };
                ViewReport {
                    name: view.name.clone(),
                    points: [view.left.len(), view.right.len()],
                    problems: [problem(0), problem(1)],
                    rms_px: [0, 1].map(|side| fit.and_then(|f| finite(f.rms_px[side]))),
                    epipolar_rms_px: fit.and_then(|f| finite(f.epipolar_rms_px)),
                    distance_m: fit.map(|f| f.distance_m),
                    scale: fit.and_then(|f| finite(f.scale)),
                    is_used: fit.is_some_and(|f| f.is_used),
                }
            })
            .collect();
        let used = observations
            .views
            .iter()
            .zip(&solution.views)
            .filter(|(_, fit)| fit.as_ref().is_some_and(|fit| fit.is_used));
        let distances = used.flat_map(|(view, _)| {
            view.shared().filter_map(|(_, l, r)| calibration.epipolar_px(l, r)).collect::<Vec<_>>()
        });
        Self {
            board: observations.board.to_string(),
            rms_px: solution.rms_px(),
            epipolar_rms_px: rms(distances),
            sigma_px: solution.adjusted.sigma_px,
            baseline_m: calibration.baseline_m(),
            parameters: parameters(solution, &calibration),
            depth_sigma_mm: DEPTHS_M
                .into_iter()
                .filter_map(|depth_m| Some((depth_m, 1e3 * solution.depth_sigma_m(depth_m)?)))
                .collect(),
            coverage,
            bands_m: BANDS_M,
            missing: coverage.gaps().into_iter().map(|gap| gap.text).collect(),
            findings: findings(observations, images, Some(solution), baseline_m),
            views,
        }
    }

    /// The report as text.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        let used = self.views.iter().filter(|view| view.is_used).count();
        let _ = writeln!(
            text,
            "{used} of {} image pairs of {}, baseline {:.3} mm",
            self.views.len(),
            self.board,
            1e3 * self.baseline_m
        );
        let _ = writeln!(
            text,
            "reprojection RMS {:.4} px left, {:.4} px right; epipolar RMS {:.4} px",
            self.rms_px[0], self.rms_px[1], self.epipolar_rms_px
        );
        for (depth_m, sigma_mm) in &self.depth_sigma_mm {
            let _ =
                writeln!(text, "depth at {depth_m:.1} m uncertain by {sigma_mm:.3} mm (1 sigma)");
        }
        let _ = writeln!(text, "\n{:<20} {:>14} {:>12}", "parameter", "value", "1 sigma");
        for p in &self.parameters {
            let _ =
                writeln!(text, "{:<20} {:>14.6} {:>12.2e} {}", p.name, p.value, p.sigma, p.unit);
        }
        let _ = writeln!(
            text,
            "\n{:<12} {:>11} {:>8} {:>8} {:>8} {:>7}",
            "pair", "points", "left px", "right px", "epip px", "m"
        );
        let number = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.3}"));
        for view in &self.views {
            let problems: Vec<_> = view.problems.iter().flatten().map(String::as_str).collect();
            let note = match (view.is_used, problems.is_empty()) {
                (true, true) => String::new(),
                (_, false) => format!("  {}", problems.join("; ")),
                (false, true) => "  left out".to_owned(),
            };
            let _ = writeln!(
                text,
                "{:<12} {:>5} {:>5} {:>8} {:>8} {:>8} {:>7}{note}",
                view.name,
                view.points[0],
                view.points[1],
                number(view.rms_px[0]),
                number(view.rms_px[1]),
                number(view.epipolar_rms_px),
                number(view.distance_m),
            );
        }
        if !self.missing.is_empty() {
            let _ = writeln!(text, "\nnot covered:");
            for sentence in &self.missing {
                let _ = writeln!(text, "  {sentence}");
            }
        }
        if !self.findings.is_empty() {
            let _ = writeln!(text, "\nwarnings:");
            for finding in &self.findings {
                let _ = writeln!(text, "  {}", finding.text);
            }
        }
        text
    }
}

fn parameters(solution: &Solution, calibration: &StereoCalibration) -> Vec<Parameter> {
    let rotation = calibration.right_from_left.rotation.scaled_axis();
    let translation = calibration.right_from_left.translation.vector;
    let values = calibration
        .left
        .to_vector()
        .into_iter()
        .chain(calibration.right.to_vector())
        .chain(rotation.iter().copied())
        .chain(translation.iter().copied());
    let covariance = &solution.adjusted.covariance;
    SHARED_NAMES
        .iter()
        .zip(values)
        .enumerate()
        .map(|(k, ((name, unit), value))| Parameter {
            name,
            unit,
            value,
            sigma: covariance[(k, k)].max(0.0).sqrt(),
        })
        .collect()
}
