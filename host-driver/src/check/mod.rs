//! Health of a calibration, from an ordinary speckle recording.
//!
//! After rectification a point has the same row in both images. What is left of a difference in rows,
//! the vertical disparity, is the calibration's error as far as it can be seen. It is measured by
//! digital image correlation with two displacements, u along the rows and v across them, in windows
//! all over the field ([`search`] finds the windows, [`icgn`] refines them). [`drift`] fits the turn
//! of the right camera that explains it; [`report`] says what it costs in millimetres.

pub mod drift;
pub mod icgn;
pub mod report;
pub mod search;
mod spline;
#[cfg(feature = "sim")]
pub mod trials;

use rayon::prelude::*;

use crate::reconstruct::RectifiedStack;
use crate::recording::StereoPair;
use crate::rectify::{DepthRange, Rectifier, RectifyError};
use crate::{RectifiedGeometry, StereoCalibration};
use icgn::Affine;
use nalgebra::{Vector2, Vector3};

/// How the vertical disparity is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Depths at which surfaces may be.
    pub depth: DepthRange,
    /// Distance of the windows' middles, in px of the canvas.
    pub spacing_px: usize,
    /// Radius of the windows.
    pub radius_px: usize,
    /// Largest vertical disparity that is looked for.
    pub search_px: usize,
    /// Least similarity (ZNCC) of a window that counts.
    pub zncc_min: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            depth: DepthRange::default(),
            spacing_px: 40,
            radius_px: 10,
            search_px: 8,
            zncc_min: 0.8,
        }
    }
}

/// Fewest windows from which anything is concluded.
pub const WINDOWS_MIN: usize = 30;

/// Why a calibration cannot be checked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckError {
    /// The images cannot be rectified.
    #[error(transparent)]
    Rectify(#[from] RectifyError),
    /// Too few windows were found in both images.
    #[error(
        "{found} of {windows} windows were found in both images, expected at least {WINDOWS_MIN}: is a \
         surface with speckles in the depth range, and is the calibration this sensor's?"
    )]
    TooFew {
        /// Windows found.
        found: usize,
        /// Windows looked for.
        windows: usize,
    },
    /// The turn cannot be told from the windows.
    #[error("the windows do not determine a turn of the camera: {0}")]
    Drift(&'static str),
}

/// A window found in both images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Its middle on the left canvas.
    pub left_px: Vector2<f64>,
    /// Where its middle is on the right canvas.
    pub right_px: Vector2<f64>,
    /// Ray of the left middle in the left camera's frame: with the next, all that does not depend on
    /// how the cameras are thought to stand to each other.
    pub left_ray: Vector3<f64>,
    /// Ray of the right middle in the right camera's frame.
    pub right_ray: Vector3<f64>,
    /// Similarity with both displacements.
    pub zncc: f64,
    /// Similarity on the same row, which is what a matcher sees; NaN where there is none.
    pub zncc_on_row: f64,
}

impl Match {
    /// Vertical disparity y_right - y_left.
    pub fn vertical_px(&self) -> f64 {
        self.right_px.y - self.left_px.y
    }
}

/// Windows found in both images, on the canvases of one calibration.
#[derive(Debug, Clone)]
pub struct Matches {
    /// Focal length of the canvases.
    pub focal_px: f64,
    /// The windows.
    pub matches: Vec<Match>,
    /// Windows looked for.
    pub windows: usize,
}

/// Measures the vertical disparity of speckle pairs.
///
/// # Errors
/// When too few windows are found.
pub fn measure(
    calibration: &StereoCalibration,
    pairs: &[StereoPair],
    options: &Options,
    progress: &mut dyn FnMut(&'static str),
) -> Result<Matches, CheckError> {
    progress("rectifying");
    let rectifier = Rectifier::new(calibration, options.depth)?;
    let stack = RectifiedStack::new(rectifier, pairs, Vec::new())?;
    progress("searching");
    let searched = search::search(&stack, options);
    progress("refining");
    let rays = Rays { geometry: stack.rectifier.geometry(), calibration };
    let matches: Vec<Match> = searched
        .found
        .par_iter()
        .filter_map(|found| {
            let start = Affine { u: found.u_px as f64, v: found.v_px as f64, ..Affine::default() };
            let place = (found.x, found.y);
            let refined = icgn::refine(&stack, place, options.radius_px, start)?;
            if refined.zncc < options.zncc_min {
                return None;
            }
            let left_px = Vector2::new(found.x as f64, found.y as f64);
            let moved = Vector2::new(refined.affine.u, refined.affine.v);
            // A drift moves windows by pixels, and a window is found to half of one.
            let near = (moved.x - start.u).abs() < 2.0 && (moved.y - start.v).abs() < 2.0;
            let on_row = Affine { v: 0.0, vx: 0.0, vy: 0.0, ..refined.affine };
            let zncc_on_row = icgn::similarity(&stack, place, options.radius_px, on_row);
            near.then_some(Match {
                left_px,
                right_px: left_px + moved,
                left_ray: rays.left(left_px),
                right_ray: rays.right(left_px + moved),
                zncc: refined.zncc,
                zncc_on_row: zncc_on_row.unwrap_or(f64::NAN),
            })
        })
        .collect();
    if matches.len() < WINDOWS_MIN {
        return Err(CheckError::TooFew { found: matches.len(), windows: searched.windows });
    }
    let focal_px = stack.rectifier.geometry().focal_px;
    Ok(Matches { focal_px, matches, windows: searched.windows })
}

/// From pixels of the canvases to rays of the cameras.
struct Rays<'a> {
    geometry: &'a RectifiedGeometry,
    calibration: &'a StereoCalibration,
}

impl Rays<'_> {
    fn in_left_frame(&self, px: Vector2<f64>, cx_px: f64) -> Vector3<f64> {
        let g = self.geometry;
        let ray = Vector3::new((px.x - cx_px) / g.focal_px, (px.y - g.cy_px) / g.focal_px, 1.0);
        g.rect_from_left.inverse() * ray
    }

    fn left(&self, px: Vector2<f64>) -> Vector3<f64> {
        self.in_left_frame(px, self.geometry.cx_left_px)
    }

    fn right(&self, px: Vector2<f64>) -> Vector3<f64> {
        let ray = self.in_left_frame(px, self.geometry.cx_right_px);
        self.calibration.right_from_left.rotation * ray
    }
}

/// A calibration checked, and the turn of the right camera that mends it.
#[derive(Debug, Clone)]
pub struct Checked {
    /// Windows on the canvases of the calibration as it is.
    pub before: Matches,
    /// The turn that explains their vertical disparities.
    pub drift: drift::Drift,
    /// The calibration with that turn.
    pub corrected: StereoCalibration,
    /// Windows found again on canvases that are corrected.
    pub after: Matches,
}

/// Checks a calibration: measures, fits the turn, and measures again with the corrected calibration,
/// which finds windows that the error had hidden and refines the turn.
///
/// # Errors
/// When too few windows are found, or they do not determine the turn.
pub fn check(
    calibration: &StereoCalibration,
    pairs: &[StereoPair],
    options: &Options,
    axes: drift::Axes,
    progress: &mut dyn FnMut(&'static str),
) -> Result<Checked, CheckError> {
    let before = measure(calibration, pairs, options, progress)?;
    let first = drift::fit(calibration, &before, axes)?;
    let once = first.applied(calibration);
    let again = measure(&once, pairs, options, progress)?;
    // The second fit is of the whole turn, against the calibration as it was, with better windows.
    let drift = drift::fit(calibration, &again, axes)?;
    let corrected = drift.applied(calibration);
    Ok(Checked { before, drift, corrected, after: again })
}
