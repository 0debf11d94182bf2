//! What is wrong with a set of board images, and what to do about it.

use serde::Serialize;

use super::coverage::{Coverage, GapKind};
use super::detect::{BLUR_MAX_PX, Problem, Quality};
use super::observations::Observations;
use super::solve::{Solution, ViewFit, rms};

/// Views that both cameras see below which more are asked for.
const VIEWS_WISHED: usize = 10;
/// Spread of the boards' tilt about each axis, in degrees, below which they are all alike.
const TILT_SPREAD_MIN_DEG: f64 = 6.0;
/// Share of the points of an image whose white may be cut off.
const SATURATED_MAX: f64 = 0.05;
/// Contrast of white and black, in grey values of 8 bits, below which images are too dark.
pub(super) const CONTRAST_MIN: f64 = 12.0;
/// Deviation of the baseline from what the sensor was built with.
const BASELINE_TOLERANCE: f64 = 0.02;
/// Deviation of a view's triangulated board from the stated size.
const SCALE_TOLERANCE: f64 = 0.01;
/// Deviation of a lens' two focal lengths from each other: pixels are square.
const ASPECT_TOLERANCE: f64 = 0.004;
/// Residuals above which lens model and board do not fit.
const RMS_MAX_PX: f64 = 0.3;

/// A kind of finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Kind {
    /// Few views.
    FewViews,
    /// All boards are tilted alike.
    OneTilt,
    /// Part of an image never had a board.
    ImageCoverage,
    /// A range of depths never had a board.
    DepthCoverage,
    /// The baseline is not the sensor's: the board has another size than stated.
    SquareSize,
    /// The print is longer in one direction than in the other.
    StretchedPrint,
    /// Blurred images.
    Blurred,
    /// A mirrored board.
    Mirrored,
    /// Images of two boards.
    MixedBoards,
    /// Left and right images do not belong to one moment.
    PairMoved,
    /// Overexposed images.
    Overexposed,
    /// Underexposed images.
    Dark,
    /// Views that do not fit, for none of the reasons above.
    OutlierViews,
    /// Residuals of all views are large.
    LargeResiduals,
    /// Images in which no board was found.
    NoBoard,
}

/// A finding.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Its kind.
    pub kind: Kind,
    /// What was found and what to do.
    pub text: String,
}

/// What a finder knows of a view's images: the quality or the problem of the left and the right one.
pub type Images = [Result<Quality, Problem>; 2];

/// All findings. `images` are the views' images, in the views' order, where there were images;
/// `baseline_m` is the sensor's by construction, where known.
pub fn findings(
    observations: &Observations,
    images: &[Images],
    solution: Option<&Solution>,
    baseline_m: Option<f64>,
) -> Vec<Finding> {
    let mut found = Vec::new();
    of_images(observations, images, &mut found);
    if let Some(solution) = solution {
        of_views(observations, solution, &mut found);
        of_result(solution, baseline_m, &mut found);
        for gap in Coverage::of(observations, solution).gaps() {
            let kind = match gap.kind {
                GapKind::Depth => Kind::DepthCoverage,
                GapKind::Image => Kind::ImageCoverage,
                // Mentioned in the report only.
                GapKind::ImageAtDepth => continue,
            };
            let text = format!("{}: add images with the board there", gap.text);
            found.push(Finding { kind, text });
        }
    }
    found
}

/// "images of 03, 04, 11", at most six pairs by name.
fn images_named(names: &[&str]) -> String {
    let shown = &names[..names.len().min(6)];
    let rest = match names.len() - shown.len() {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    format!("images of {}{rest}", shown.join(", "))
}

fn of_images(observations: &Observations, images: &[Images], found: &mut Vec<Finding>) {
    let named = |is: &dyn Fn(&Images) -> bool| -> Vec<&str> {
        let views = observations.views.iter().zip(images);
        views.filter(|(_, pair)| is(pair)).map(|(view, _)| view.name.as_str()).collect()
    };
    let any_quality = |pair: &Images, is: &dyn Fn(&Quality) -> bool| {
        pair.iter().any(|image| image.as_ref().is_ok_and(is))
    };
    let any_problem = |pair: &Images, is: &dyn Fn(&Problem) -> bool| {
        pair.iter().any(|image| image.as_ref().is_err_and(is))
    };
    let mut add = |kind, names: Vec<&str>, what: &str| {
        if !names.is_empty() {
            found.push(Finding { kind, text: format!("{} {what}", images_named(&names)) });
        }
    };
    add(
        Kind::Mirrored,
        named(&|pair| any_problem(pair, &|p| *p == Problem::Mirrored)),
        "show the board mirrored: print it anew, and do not calibrate through a mirror or from \
         behind",
    );
    add(
        Kind::MixedBoards,
        named(&|pair| any_problem(pair, &|p| matches!(p, Problem::OtherBoard { .. }))),
        "show another board than --board says: calibrate with one board only",
    );
    add(
        Kind::Blurred,
        named(&|pair| {
            any_quality(pair, &|q| q.blur_px > BLUR_MAX_PX)
                || any_problem(pair, &|p| matches!(p, Problem::Blurred { .. }))
        }),
        "are blurred: hold the board still, shorten the exposure, focus the lenses",
    );
    add(
        Kind::Overexposed,
        named(&|pair| any_quality(pair, &|q| q.saturated > SATURATED_MAX)),
        "are overexposed, their white is cut off and edges move: shorten the exposure",
    );
    add(
        Kind::Dark,
        named(&|pair| {
            any_quality(pair, &|q| q.white - q.black < CONTRAST_MIN)
                || any_problem(pair, &|p| matches!(p, Problem::Dark { .. }))
        }),
        "are too dark: lengthen the exposure or bring the board nearer",
    );
    add(
        Kind::NoBoard,
        named(&|pair| {
            any_problem(pair, &|p| {
                matches!(
                    p,
                    Problem::NoBoard { .. }
                        | Problem::NoMarkers { .. }
                        | Problem::NoOrigin { .. }
                        | Problem::Detector(_)
                )
            })
        }),
        "show no readable board to one camera or both",
    );
}

fn of_views(observations: &Observations, solution: &Solution, found: &mut Vec<Finding>) {
    let fits: Vec<(&str, &ViewFit)> = observations
        .views
        .iter()
        .zip(&solution.views)
        .filter_map(|(view, fit)| Some((view.name.as_str(), fit.as_ref()?)))
        .collect();
    let used = fits.iter().filter(|(_, fit)| fit.is_used).count();
    if used < VIEWS_WISHED {
        let text =
            format!("{used} usable image pairs only: take 25, at several distances and tilts");
        found.push(Finding { kind: Kind::FewViews, text });
    }
    // Uneven sizes of the triangulated boards: the median is what most images say.
    let mut scales: Vec<f64> = fits.iter().map(|(_, fit)| fit.scale).collect();
    scales.retain(|scale| scale.is_finite());
    scales.sort_unstable_by(f64::total_cmp);
    let usual = scales.get(scales.len() / 2).copied().unwrap_or(1.0);
    let mut add = |kind, names: Vec<&str>, what: &str| {
        if !names.is_empty() {
            found.push(Finding { kind, text: format!("{} {what}", images_named(&names)) });
        }
    };
    let is_other_size = |fit: &ViewFit| (fit.scale / usual - 1.0).abs() > SCALE_TOLERANCE;
    let left_out = |is: &dyn Fn(&ViewFit) -> bool| -> Vec<&str> {
        fits.iter().filter(|(_, fit)| !fit.is_used && is(fit)).map(|(name, _)| *name).collect()
    };
    // Each camera alone fits the board at some pose; a board of another size, or one that has moved
    // between the images, does not fit the rig. The first still has rays that meet.
    let typical = rms(fits.iter().filter(|(_, fit)| fit.is_used).map(|(_, f)| f.epipolar_rms_px));
    let misses = |fit: &ViewFit| fit.epipolar_rms_px > 0.3 + 4.0 * typical;
    add(
        Kind::MixedBoards,
        left_out(&|fit| is_other_size(fit) && !misses(fit)),
        "show a board of another size than the others and are left out: calibrate with one board \
         only",
    );
    add(
        Kind::PairMoved,
        left_out(&misses),
        "do not belong together left and right and are left out: the board moved in between, or the \
         cameras are not triggered together",
    );
    add(
        Kind::OutlierViews,
        left_out(&|fit| !is_other_size(fit) && !misses(fit)),
        "do not fit the others and are left out",
    );
    let tilts: Vec<[f64; 2]> =
        fits.iter().filter(|(_, fit)| fit.is_used).map(|(_, fit)| fit.tilt_deg).collect();
    if tilts.len() > 1 {
        let n = tilts.len() as f64;
        let mean = [0, 1].map(|k| tilts.iter().map(|t| t[k]).sum::<f64>() / n);
        let spread = [0, 1].map(|k| rms(tilts.iter().map(|t| t[k] - mean[k])));
        if spread.iter().any(|s| *s < TILT_SPREAD_MIN_DEG) {
            let text = format!(
                "the boards are tilted alike (spread {:.0} and {:.0} degrees about the vertical and \
                 the horizontal axis): tilt them by 20 to 40 degrees to all sides",
                spread[0], spread[1]
            );
            found.push(Finding { kind: Kind::OneTilt, text });
        }
    }
}

fn of_result(solution: &Solution, baseline_m: Option<f64>, found: &mut Vec<Finding>) {
    let calibration = solution.calibration();
    if let Some(expected) = baseline_m {
        let ratio = calibration.baseline_m() / expected;
        if (ratio - 1.0).abs() > BASELINE_TOLERANCE {
            let text = format!(
                "the baseline comes out as {:.4} m instead of {expected:.4} m: the squares are \
                 probably {:.2} times the stated size; measure the print",
                calibration.baseline_m(),
                1.0 / ratio
            );
            found.push(Finding { kind: Kind::SquareSize, text });
        }
    }
    let aspects = [&calibration.left, &calibration.right].map(|c| c.focal_px[0] / c.focal_px[1]);
    if aspects.iter().all(|aspect| (aspect - 1.0).abs() > ASPECT_TOLERANCE) {
        let mean = (aspects[0] + aspects[1]) / 2.0;
        let text = format!(
            "both cameras' focal lengths differ by {:+.1} % across and down, though pixels are square: \
             the print is probably stretched; measure it in both directions",
            100.0 * (mean - 1.0)
        );
        found.push(Finding { kind: Kind::StretchedPrint, text });
    }
    let worst = solution.rms_px().into_iter().fold(0.0, f64::max);
    if worst > RMS_MAX_PX {
        let text = format!(
            "the residuals are {worst:.2} px: is the board flat, and does the lens follow the \
             radial-tangential model?"
        );
        found.push(Finding { kind: Kind::LargeResiduals, text });
    }
}
