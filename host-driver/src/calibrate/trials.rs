//! Calibrations whose truth is known: seeded trials on drawn sightings, a fully rendered one, and sets
//! of images that are poor on purpose.

use nalgebra::{Point2, Point3};
use serde::Serialize;
use stspp_hil_sim::world::{SensorModel, WorldError};

use super::Board;
use super::bundle::{Loss, SHARED};
use super::findings::{Finding, Kind, findings};
use super::images::Found;
use super::observations::Observations;
use super::rendered::{self, EXPOSURE_US};
use super::report::Report;
use super::solve::{Solution, SolveError, rms, solve};
use super::tour::{self, Draw, Tour};
use crate::StereoCalibration;
use crate::sim::calibration_of;

/// Noise of drawn sightings: refined corners of rendered boards are 0.0095 px off along each axis.
pub const SIGMA_PX: f64 = 0.012;

/// Depth error over the field, at one distance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DepthError {
    /// The distance.
    pub depth_m: f64,
    /// Mean error.
    pub bias_mm: f64,
    /// Root mean square error.
    pub rms_mm: f64,
    /// Largest error.
    pub worst_mm: f64,
}

/// Error of the depths that a calibration gives for what a rig really sees: points of a plane across
/// the sensor's axis, all over the field that both cameras share, imaged without noise.
pub fn depth_error(
    truth: &StereoCalibration,
    found: &StereoCalibration,
    depth_m: f64,
) -> DepthError {
    let [width, height] = truth.left.resolution_px.map(|size| size as f64);
    let mut errors_mm = Vec::new();
    for k in 0..21 * 17 {
        let (column, row) = (f64::from(k % 21), f64::from(k / 21));
        let left_px =
            nalgebra::Vector2::new(column / 20.0 * (width - 1.0), row / 16.0 * (height - 1.0));
        let Some(ray) = truth.left.normalised_of_pixel(left_px) else { continue };
        let point = Point3::new(ray.x, ray.y, 1.0) * depth_m;
        let Some(right_px) = truth.right.project(&(truth.right_from_left * point)) else {
            continue;
        };
        let is_seen =
            (0.0..=width - 1.0).contains(&right_px.x) && (0.0..=height - 1.0).contains(&right_px.y);
        if let Some(measured) = found.triangulate(left_px, right_px).filter(|_| is_seen) {
            errors_mm.push(1e3 * (measured.z - point.z));
        }
    }
    DepthError {
        depth_m,
        bias_mm: errors_mm.iter().sum::<f64>() / errors_mm.len().max(1) as f64,
        rms_mm: rms(errors_mm.iter().copied()),
        worst_mm: errors_mm.iter().fold(0.0, |worst, e| e.abs().max(worst)),
    }
}

/// What many trials showed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trials {
    /// Trials made.
    pub trials: usize,
    /// Share of all parameters of all trials whose error is within their stated standard deviation.
    pub covered: f64,
    /// The least such share among the parameters.
    pub covered_least: f64,
    /// Share of trials in which the depth error on the axis is within its stated standard deviation:
    /// (depth in metres, share).
    pub depth_covered: Vec<(f64, f64)>,
    /// Root mean square over the trials of the mean depth error over the field, by depth.
    pub depth_bias_mm: Vec<(f64, f64)>,
    /// Largest mean depth error of a trial, by depth.
    pub depth_bias_worst_mm: Vec<(f64, f64)>,
    /// Largest reprojection RMS of a trial.
    pub rms_worst_px: f64,
}

/// Calibrates `trials` rigs, each other within tolerances, from 25 views of noisy sightings.
///
/// # Errors
/// When a calibration fails.
pub fn trials(
    board: &Board,
    trials: usize,
    sigma_px: f64,
    progress: &mut dyn FnMut(),
) -> Result<Trials, SolveError> {
    let depths_m = [1.0, 2.0];
    let mut covered = [0_usize; SHARED];
    let mut depth_covered = [0_usize; 2];
    let mut biases = [const { Vec::new() }; 2];
    let mut rms_worst_px = 0.0_f64;
    for seed in 1..=trials as u64 {
        let truth = calibration_of(&SensorModel::perturbed(seed));
        let poses = Tour { seed, ..Tour::default() }.left_from_board(&truth);
        let mut draw = Draw::new(seed ^ 0xb0a2d);
        let observations = tour::sightings(&truth, board, &poses, sigma_px, &mut draw);
        let solution = solve(&observations, Loss::Huber)?;
        let found = solution.calibration();
        for (k, (error, sigma)) in errors(&truth, &solution).into_iter().enumerate() {
            covered[k] += usize::from(error.abs() <= sigma);
        }
        for (k, &depth_m) in depths_m.iter().enumerate() {
            biases[k].push(depth_error(&truth, &found, depth_m).bias_mm);
            let on_axis_m = solution.depth_error_on_axis_m(&truth, depth_m);
            let sigma_m = solution.depth_sigma_m(depth_m);
            let is_covered = on_axis_m.zip(sigma_m).is_some_and(|(e, s)| e.abs() <= s);
            depth_covered[k] += usize::from(is_covered);
        }
        rms_worst_px = solution.rms_px().into_iter().fold(rms_worst_px, f64::max);
        progress();
    }
    let share = |count: usize| count as f64 / trials.max(1) as f64;
    let by_depth = |value: &dyn Fn(usize) -> f64| {
        depths_m.iter().enumerate().map(|(k, depth_m)| (*depth_m, value(k))).collect::<Vec<_>>()
    };
    Ok(Trials {
        trials,
        covered: covered.iter().map(|&count| share(count)).sum::<f64>() / SHARED as f64,
        covered_least: covered.iter().map(|&count| share(count)).fold(1.0, f64::min),
        depth_covered: by_depth(&|k| share(depth_covered[k])),
        depth_bias_mm: by_depth(&|k| rms(biases[k].iter().copied())),
        depth_bias_worst_mm: by_depth(&|k| {
            biases[k].iter().fold(0.0, |worst: f64, bias| bias.abs().max(worst))
        }),
        rms_worst_px,
    })
}

/// Error and stated standard deviation of each shared unknown.
fn errors(truth: &StereoCalibration, solution: &Solution) -> Vec<(f64, f64)> {
    let found = solution.calibration();
    // The rotation's unknowns turn the found rotation further.
    let turn =
        (found.right_from_left.rotation * truth.right_from_left.rotation.inverse()).scaled_axis();
    let moved = found.right_from_left.translation.vector - truth.right_from_left.translation.vector;
    let cameras = [(&found.left, &truth.left), (&found.right, &truth.right)];
    let intrinsics = cameras.into_iter().flat_map(|(found, truth)| {
        found.to_vector().into_iter().zip(truth.to_vector()).map(|(f, t)| f - t)
    });
    let covariance = &solution.adjusted.covariance;
    intrinsics
        .chain(turn.iter().copied())
        .chain(moved.iter().copied())
        .enumerate()
        .map(|(k, error)| (error, covariance[(k, k)].sqrt()))
        .collect()
}

/// A calibration from rendered images, against the truth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rendered {
    /// The calibration's own report.
    pub report: Report,
    /// Depth errors at 1, 1.5 and 2 m.
    pub depth: Vec<DepthError>,
    /// Root mean square distance of the points found from where the true cameras image them: left,
    /// right.
    pub detection_rms_px: [f64; 2],
    /// Points found, and points in view.
    pub points: [usize; 2],
}

/// Why a rendered calibration failed.
#[derive(Debug, thiserror::Error)]
pub enum TrialError {
    /// The scene cannot be simulated.
    #[error(transparent)]
    World(#[from] WorldError),
    /// The calibration failed.
    #[error(transparent)]
    Solve(#[from] SolveError),
}

/// Renders `views` stereo pairs of a board through the whole optical model, finds the board in them,
/// calibrates, and compares with the truth.
///
/// # Errors
/// When rendering or calibrating fails.
pub fn rendered(
    board: &Board,
    views: usize,
    seed: u64,
    progress: &mut dyn FnMut(),
) -> Result<Rendered, TrialError> {
    let model = SensorModel::perturbed(seed);
    let truth = calibration_of(&model);
    let poses = Tour { seed, views, ..Tour::default() }.left_from_board(&truth);
    let texture = rendered::texture(board);
    let mut found = Found::new(board, truth.left.resolution_px);
    for (k, pose) in poses.iter().enumerate() {
        let pair = rendered::pair(&texture, &model, pose, EXPOSURE_US, k as u64)?;
        found.push(format!("{k:02}"), super::images::detect_pair(&pair, board));
        progress();
    }
    let exact = tour::sightings(&truth, board, &poses, 0.0, &mut Draw::new(1));
    let detection_rms_px = [0, 1].map(|side| {
        let views = found.observations.views.iter().zip(&exact.views);
        rms(views.flat_map(|(seen, exact)| {
            seen.side(side).iter().filter_map(move |s| {
                let truth = exact.side(side).iter().find(|t| t.point == s.point)?;
                Some((truth.pixel - s.pixel).norm())
            })
        }))
    });
    let count = |observations: &Observations| {
        observations.views.iter().map(|view| view.left.len() + view.right.len()).sum()
    };
    let points = [count(&found.observations), count(&exact)];
    let solution = solve(&found.observations, Loss::Huber)?;
    let calibration = solution.calibration();
    let baseline_m = Some(truth.baseline_m());
    Ok(Rendered {
        report: Report::new(&found.observations, &found.images, &solution, baseline_m),
        depth: [1.0, 1.5, 2.0].map(|d| depth_error(&truth, &calibration, d)).to_vec(),
        detection_rms_px,
        points,
    })
}

/// A set that is poor on purpose, and what was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoorSet {
    /// What is wrong with it.
    pub name: &'static str,
    /// The warning that has to come.
    pub expected: Kind,
    /// All that was found.
    pub findings: Vec<Finding>,
    /// The error, when there is no calibration.
    pub error: Option<String>,
}

impl PoorSet {
    /// Whether the warning came.
    pub fn is_found(&self) -> bool {
        self.findings.iter().any(|finding| finding.kind == self.expected)
    }
}

/// Baseline that the simulated sensor is built with.
const BUILT_BASELINE_M: f64 = 0.4;

/// Makes the poor sets and what is found in each. Those about images are rendered, with half the
/// pixels in each direction; the others are drawn sightings.
///
/// # Errors
/// When a scene cannot be simulated.
pub fn poor_sets(board: &Board, progress: &mut dyn FnMut()) -> Result<Vec<PoorSet>, TrialError> {
    let mut sets = Vec::new();
    let drawn: [(&'static str, Kind, &dyn Fn() -> Observations); 8] = [
        ("all boards tilted alike", Kind::OneTilt, &|| {
            let tilt =
                Tour { tilt_deg: [24.0, 26.0], tilt_direction_deg: Some(20.0), ..Tour::default() };
            draw(board, &tilt)
        }),
        ("boards in the left half of the field only", Kind::ImageCoverage, &|| {
            draw(board, &Tour { across: [-0.75, -0.62], ..Tour::default() })
        }),
        ("boards at one distance only", Kind::DepthCoverage, &|| {
            draw(board, &Tour { depth_m: [1.15, 1.25], ..Tour::default() })
        }),
        ("six images only", Kind::FewViews, &|| draw(board, &Tour { views: 6, ..Tour::default() })),
        ("squares 5 % larger than stated", Kind::SquareSize, &|| {
            let printed = Board { pitch_m: board.pitch_m * 1.05, ..*board };
            Observations { board: *board, ..draw(&printed, &Tour::default()) }
        }),
        ("two boards of different size", Kind::MixedBoards, &|| {
            let printed = Board { pitch_m: board.pitch_m * 0.8, ..*board };
            let mut observations = draw(board, &Tour::default());
            let others = draw(&printed, &Tour { seed: 2, ..Tour::default() });
            for k in [3, 8, 14, 15, 21] {
                observations.views[k] = others.views[k].clone();
            }
            observations
        }),
        ("board moved between left and right image", Kind::PairMoved, &|| {
            let mut observations = draw(board, &Tour::default());
            for k in [4, 11, 17] {
                for sighting in &mut observations.views[k].right {
                    sighting.pixel.y += 3.0;
                    sighting.pixel.x += 2.0;
                }
            }
            observations
        }),
        ("print stretched by 1 % across", Kind::StretchedPrint, &|| stretched(board, 1.01)),
    ];
    for (name, expected, make) in drawn {
        sets.push(judged(name, expected, &make(), &[]));
        progress();
    }
    type Change<'a> = &'a dyn Fn(&mut SensorModel);
    let nothing: Change<'_> = &|_| {};
    let blurred: Change<'_> = &|model| {
        model.left.blur_sigma_px = 2.4;
        model.right.blur_sigma_px = 2.4;
    };
    let images = [
        ("images out of focus", Kind::Blurred, EXPOSURE_US, false, blurred),
        ("mirrored board", Kind::Mirrored, EXPOSURE_US, true, nothing),
        ("overexposed images", Kind::Overexposed, 8 * EXPOSURE_US, false, nothing),
        ("images too dark", Kind::Dark, EXPOSURE_US / 24, false, nothing),
    ];
    for (name, expected, exposure_us, is_mirrored, change) in images {
        let mut model = SensorModel::default().scaled_down(2);
        change(&mut model);
        let found = rendered_small(board, &model, exposure_us, is_mirrored)?;
        sets.push(judged(name, expected, &found.observations, &found.images));
        progress();
    }
    // The second board has as many squares, but its markers are in other places.
    let other = Board { columns: board.columns - 1, rows: board.rows + 1, ..*board };
    let model = SensorModel::default().scaled_down(2);
    let mut found = rendered_small(board, &model, EXPOSURE_US, false)?;
    let strange = rendered_views(&other, board, &model, EXPOSURE_US, false, 2)?;
    for (k, pair) in strange.into_iter().enumerate() {
        found.push(format!("other{k}"), pair);
    }
    let name = "images of two boards with other markers";
    sets.push(judged(name, Kind::MixedBoards, &found.observations, &found.images));
    progress();
    Ok(sets)
}

fn draw(board: &Board, tour: &Tour) -> Observations {
    let truth = calibration_of(&SensorModel::default());
    let poses = tour.left_from_board(&truth);
    tour::sightings(&truth, board, &poses, SIGMA_PX, &mut Draw::new(tour.seed))
}

/// Sightings of a board that is longer in x than stated.
fn stretched(board: &Board, factor: f64) -> Observations {
    let truth = calibration_of(&SensorModel::default());
    let poses = Tour::default().left_from_board(&truth);
    let print = |p: Point2<f64>| Point2::new(p.x * factor, p.y);
    tour::sightings_of_print(&truth, board, &print, &poses, SIGMA_PX, &mut Draw::new(1))
}

fn judged(
    name: &'static str,
    expected: Kind,
    observations: &Observations,
    images: &[super::findings::Images],
) -> PoorSet {
    let (solution, error) = match solve(observations, Loss::Huber) {
        Ok(solution) => (Some(solution), None),
        Err(error) => (None, Some(error.to_string())),
    };
    let findings = findings(observations, images, solution.as_ref(), Some(BUILT_BASELINE_M));
    PoorSet { name, expected, findings, error }
}

/// Six near views with a small sensor.
fn rendered_small(
    board: &Board,
    model: &SensorModel,
    exposure_us: u64,
    is_mirrored: bool,
) -> Result<Found, TrialError> {
    let mut found = Found::new(board, [model.left.width, model.left.height]);
    let views = rendered_views(board, board, model, exposure_us, is_mirrored, 6)?;
    for (k, pair) in views.into_iter().enumerate() {
        found.push(format!("{k:02}"), pair);
    }
    Ok(found)
}

/// Renders `printed` and looks for `board`.
fn rendered_views(
    printed: &Board,
    board: &Board,
    model: &SensorModel,
    exposure_us: u64,
    is_mirrored: bool,
    views: usize,
) -> Result<Vec<super::images::PairDetections>, TrialError> {
    let tour = Tour { views, depth_m: [0.8, 1.0], ..Tour::default() };
    let mut texture = rendered::texture(printed);
    if is_mirrored {
        texture = texture.mirrored();
    }
    let poses = tour.left_from_board(&calibration_of(model));
    poses
        .iter()
        .enumerate()
        .map(|(k, pose)| {
            let pair = rendered::pair(&texture, model, pose, exposure_us, k as u64)?;
            Ok(super::images::detect_pair(&pair, board))
        })
        .collect()
}
