//! Rectification of toed-in, distorted cameras onto canvases with corresponding rows.

mod canvas;
mod kernel;
mod resample;
mod warp;

use std::sync::Arc;

use stspp_matcher::{DisparityRange, Image, Level, Sample};

use crate::{RawImage, RectifiedGeometry, StereoCalibration};
pub(crate) use canvas::rect_from_left;
pub use kernel::Kernel;
use kernel::TapTables;
pub use warp::RectifyScratch;
use warp::{Virtual, Warp};

/// Margins of the candidate disparities beyond the depth range: a plane at the far end that is
/// tilted by 35 degrees, or one that bulges at the near end, is not clipped.
const NEAR_MARGIN: f64 = 0.97;
const FAR_MARGIN: f64 = 1.25;

/// Depths that are measured, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthRange {
    /// Nearest depth.
    pub min_m: f64,
    /// Farthest depth.
    pub max_m: f64,
}

impl Default for DepthRange {
    fn default() -> Self {
        Self { min_m: 0.8, max_m: 2.0 }
    }
}

/// Size of the rectified images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Canvas {
    /// All that both cameras see within the depth range: some pixels more than the cameras have.
    #[default]
    Whole,
    /// The middle of that, in the cameras' own size: a margin of some pixels is lost, and a frame takes
    /// that much less time.
    Sensor,
}

/// Why images cannot be rectified.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RectifyError {
    /// The depth range is empty or not positive.
    #[error("depth range: expected 0 < min < max <= 1000 m, got {min_m} to {max_m} m")]
    DepthRange {
        /// Nearest depth given.
        min_m: f64,
        /// Farthest depth given.
        max_m: f64,
    },
    /// The calibration is not possible.
    #[error("calibration: {0}")]
    Calibration(#[from] crate::calibration::FieldError),
    /// One camera is in front of the other.
    #[error("calibration: the cameras look along their baseline and cannot be rectified")]
    AxisAlongBaseline,
    /// The cameras share no point in the depth range.
    #[error("calibration: the cameras see no common point in the depth range")]
    NoOverlap,
    /// The cameras are too wide or too askew.
    #[error("calibration: the rectified images would be {width} x {height} px")]
    CanvasTooLarge {
        /// Width needed.
        width: f64,
        /// Height needed.
        height: f64,
    },
    /// An image has another size than the calibration.
    #[error(
        "{side} image: expected {} x {} px as in the calibration, got {} x {}",
        expected[0], expected[1], got[0], got[1]
    )]
    ImageSize {
        /// "left" or "right".
        side: &'static str,
        /// The calibration's resolution.
        expected: [usize; 2],
        /// The image's size.
        got: [usize; 2],
    },
}

/// Rectifies the images of one calibrated sensor.
pub struct Rectifier {
    geometry: Arc<RectifiedGeometry>,
    disparity: DisparityRange,
    resolution_px: [usize; 2],
    left: Warp,
    right: Warp,
}

impl Rectifier {
    /// Prepares the maps for a calibration and a depth range.
    ///
    /// # Errors
    /// For an impossible calibration or depth range, or cameras that share no view.
    pub fn new(calibration: &StereoCalibration, depth: DepthRange) -> Result<Self, RectifyError> {
        Self::with_kernel(calibration, depth, Kernel::default())
    }

    /// As [`Self::new`] with canvases of another size.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_canvas(
        calibration: &StereoCalibration,
        depth: DepthRange,
        canvas: Canvas,
    ) -> Result<Self, RectifyError> {
        Self::build(calibration, depth, Kernel::default(), canvas)
    }

    /// As [`Self::new`] with another interpolation kernel.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_kernel(
        calibration: &StereoCalibration,
        depth: DepthRange,
        kernel: Kernel,
    ) -> Result<Self, RectifyError> {
        Self::build(calibration, depth, kernel, Canvas::default())
    }

    fn build(
        calibration: &StereoCalibration,
        depth: DepthRange,
        kernel: Kernel,
        canvas: Canvas,
    ) -> Result<Self, RectifyError> {
        let DepthRange { min_m, max_m } = depth;
        if !(0.0 < min_m && min_m < max_m && max_m <= 1000.0) {
            return Err(RectifyError::DepthRange { min_m, max_m });
        }
        calibration.validate()?;
        let wide = DepthRange { min_m: min_m * NEAR_MARGIN, max_m: max_m * FAR_MARGIN };
        let geometry = canvas::choose(calibration, &wide, canvas)?;
        let disparity = geometry
            .disparity_range(wide.min_m, wide.max_m)
            .ok_or(RectifyError::DepthRange { min_m, max_m })?;
        let view = |camera: &crate::CameraIntrinsics, rect_camera_taps, cx_px| Virtual {
            radius_max: camera
                .border_px()
                .filter_map(|pixel| camera.normalised_of_pixel(pixel))
                .fold(0.0, |radius, p| p.norm().max(radius)),
            camera: camera.clone(),
            rect_camera_taps,
            focal_px: geometry.focal_px,
            cx_px,
            cy_px: geometry.cy_px,
            canvas_px: [geometry.width, geometry.height],
        };
        let left_from_right = calibration.right_from_left.rotation.inverse().to_rotation_matrix();
        let left = view(&calibration.left, geometry.rect_from_left, geometry.cx_left_px);
        let right = view(
            &calibration.right,
            geometry.rect_from_left * left_from_right,
            geometry.cx_right_px,
        );
        let taps = Arc::new(TapTables::new(kernel));
        // What the environment asks for in vain is the matcher's to report.
        let level = Level::choose(None).unwrap_or_else(|_| Level::best());
        let (left, right) = (Warp::new(level, &left, &taps), Warp::new(level, &right, &taps));
        let resolution_px = calibration.left.resolution_px;
        Ok(Self { geometry: Arc::new(geometry), disparity, resolution_px, left, right })
    }

    /// Geometry of the canvases.
    pub fn geometry(&self) -> &Arc<RectifiedGeometry> {
        &self.geometry
    }

    /// Candidate disparities: the depth range with a margin, at every pixel of the canvas.
    pub fn disparity_range(&self) -> DisparityRange {
        self.disparity
    }

    /// Canvas pixels that the left camera saw (non-zero).
    pub fn left_mask(&self) -> &Image<u8> {
        &self.left.mask
    }

    /// Canvas pixels that the right camera saw (non-zero).
    pub fn right_mask(&self) -> &Image<u8> {
        &self.right.mask
    }

    /// Number of canvas pixels that the left camera saw.
    pub fn seen_pixels(&self) -> usize {
        self.left.mask.as_slice().iter().filter(|seen| **seen != 0).count()
    }

    /// An image of the canvas's size, to rectify into.
    pub fn canvas(&self) -> Image<Sample> {
        Image::new(self.geometry.width, self.geometry.height, 0)
    }

    /// Rectifies a left image into `out`, which takes the canvas's size if it has another.
    ///
    /// # Errors
    /// [`RectifyError::ImageSize`].
    pub fn rectify_left(
        &self,
        raw: &RawImage,
        out: &mut Image<Sample>,
        scratch: &mut RectifyScratch,
    ) -> Result<(), RectifyError> {
        self.rectify("left", &self.left, raw, out, scratch)
    }

    /// Rectifies a right image into `out`, which takes the canvas's size if it has another.
    ///
    /// # Errors
    /// [`RectifyError::ImageSize`].
    pub fn rectify_right(
        &self,
        raw: &RawImage,
        out: &mut Image<Sample>,
        scratch: &mut RectifyScratch,
    ) -> Result<(), RectifyError> {
        self.rectify("right", &self.right, raw, out, scratch)
    }

    fn rectify(
        &self,
        side: &'static str,
        warp: &Warp,
        raw: &RawImage,
        out: &mut Image<Sample>,
        scratch: &mut RectifyScratch,
    ) -> Result<(), RectifyError> {
        let (expected, got) = (self.resolution_px, [raw.width(), raw.height()]);
        if expected != got {
            return Err(RectifyError::ImageSize { side, expected, got });
        }
        if (out.width(), out.height()) != (self.geometry.width, self.geometry.height) {
            *out = self.canvas();
        }
        warp.apply(raw, out, scratch);
        Ok(())
    }
}
