//! Choice of the rectified cameras: rotation, focal length, and canvases that lose no pixel.

use nalgebra::{Matrix3, Point3, Rotation3, Vector2, Vector3};

use super::{Canvas, DepthRange, RectifyError};
use crate::{CameraIntrinsics, RectifiedGeometry, StereoCalibration};

/// Raw pixels between samples of the image area, for averages and bounds.
const GRID_PX: usize = 8;
/// Canvas rows are whole multiples: 64 bytes of samples.
const ROW_PX: usize = 32;
/// Largest canvas side: a rig whose rectification needs more is not one this method fits.
const CANVAS_MAX_PX: f64 = 16_384.0;

/// Axes of the rectified frame: x along the baseline; z the mean of both optical axes as far as it is
/// perpendicular to x, so that neither camera is stretched more than the other.
pub(crate) fn rect_from_left(
    calibration: &StereoCalibration,
) -> Result<Rotation3<f64>, RectifyError> {
    let left_from_right = calibration.right_from_left.inverse();
    let x = left_from_right.translation.vector.normalize();
    let axes = Vector3::z() + left_from_right.rotation * Vector3::z();
    let z = axes - x * axes.dot(&x);
    if z.norm() < 1e-3 {
        return Err(RectifyError::AxisAlongBaseline);
    }
    let z = z.normalize();
    let y = z.cross(&x);
    Ok(Rotation3::from_matrix_unchecked(Matrix3::from_rows(&[
        x.transpose(),
        y.transpose(),
        z.transpose(),
    ])))
}

/// Raw pixels on a grid that includes all borders.
fn grid_px(camera: &CameraIntrinsics) -> Vec<Vector2<f64>> {
    let [w, h] = camera.resolution_px;
    let steps = |size: usize| {
        let last = size - 1;
        (0..last).step_by(GRID_PX).chain(std::iter::once(last)).collect::<Vec<_>>()
    };
    let (xs, ys) = (steps(w), steps(h));
    ys.iter().flat_map(|&y| xs.iter().map(move |&x| Vector2::new(x as f64, y as f64))).collect()
}

/// One camera of the pair, with its rotation into the rectified frame.
struct View<'a> {
    camera: &'a CameraIntrinsics,
    rect_camera_taps: Rotation3<f64>,
}

impl View<'_> {
    /// Rectified normalised coordinates of a raw pixel.
    fn rectified(&self, pixel: Vector2<f64>) -> Option<Vector2<f64>> {
        let ray = self.camera.normalised_of_pixel(pixel)?;
        let ray = self.rect_camera_taps * Vector3::new(ray.x, ray.y, 1.0);
        (ray.z > 0.05).then(|| ray.xy() / ray.z)
    }

    /// Whether this camera sees a point of the rectified frame whose origin is this camera.
    fn sees(&self, point_rect: Point3<f64>) -> bool {
        let point = self.rect_camera_taps.inverse_transform_point(&point_rect);
        let [w, h] = self.camera.resolution_px.map(|size| size as f64);
        // The distortion folds back far outside the image: only what undistorts to the same ray is
        // really seen there.
        self.camera.project(&point).is_some_and(|pixel| {
            (-0.5..=w - 0.5).contains(&pixel.x)
                && (-0.5..=h - 0.5).contains(&pixel.y)
                && self
                    .camera
                    .normalised_of_pixel(pixel)
                    .is_some_and(|ray| (ray - point.coords.xy() / point.z).norm() < 1e-6)
        })
    }
}

/// Bounding box of rectified normalised coordinates.
#[derive(Clone, Copy)]
struct Bounds {
    min: Vector2<f64>,
    max: Vector2<f64>,
}

impl Bounds {
    fn empty() -> Self {
        Self { min: Vector2::repeat(f64::INFINITY), max: Vector2::repeat(f64::NEG_INFINITY) }
    }

    fn include(&mut self, p: Vector2<f64>) {
        self.min = self.min.inf(&p);
        self.max = self.max.sup(&p);
    }
}

/// The pixels of `view` that see, somewhere in the depth range, what `other` sees too; `other` is at
/// `other_x_m` on the rectified x axis. Depth is measured along the rectified z axis.
fn shared_bounds(view: &View<'_>, other: &View<'_>, other_x_m: f64, depth: &DepthRange) -> Bounds {
    let mut bounds = Bounds::empty();
    let step = (depth.max_m / depth.min_m).ln() / 8.0;
    for pixel in grid_px(view.camera) {
        let Some(p) = view.rectified(pixel) else { continue };
        let shared = (0..=8).any(|k| {
            let z = depth.min_m * (step * f64::from(k)).exp();
            other.sees(Point3::new(p.x * z - other_x_m, p.y * z, z))
        });
        if shared {
            bounds.include(p);
        }
    }
    bounds
}

/// Focal length at which the rectified images have, on average, as many pixels as the raw ones: no
/// resolution is lost and none is invented.
fn focal_px(views: [&View<'_>; 2]) -> Result<f64, RectifyError> {
    let (mut log_sum, mut count) = (0.0, 0.0);
    for view in views {
        for pixel in grid_px(view.camera) {
            let step = 0.5;
            let at = |dx: f64, dy: f64| view.rectified(pixel + Vector2::new(dx, dy));
            let (Some(x0), Some(x1), Some(y0), Some(y1)) =
                (at(-step, 0.0), at(step, 0.0), at(0.0, -step), at(0.0, step))
            else {
                continue;
            };
            let (dx, dy) = (x1 - x0, y1 - y0);
            let area = dx.x * dy.y - dx.y * dy.x;
            if area > 0.0 {
                log_sum += area.ln();
                count += 1.0;
            }
        }
    }
    if count == 0.0 {
        return Err(RectifyError::NoOverlap);
    }
    Ok((-0.5 * log_sum / count).exp())
}

/// Geometry of the canvases for a calibration and a depth range.
pub(super) fn choose(
    calibration: &StereoCalibration,
    depth: &DepthRange,
    canvas: Canvas,
) -> Result<RectifiedGeometry, RectifyError> {
    let rect_from_left = rect_from_left(calibration)?;
    let left_from_right = calibration.right_from_left.rotation.inverse().to_rotation_matrix();
    let left = View { camera: &calibration.left, rect_camera_taps: rect_from_left };
    let right =
        View { camera: &calibration.right, rect_camera_taps: rect_from_left * left_from_right };
    let baseline_m = calibration.baseline_m();
    let focal_px = focal_px([&left, &right])?;
    let in_left = shared_bounds(&left, &right, baseline_m, depth);
    let in_right = shared_bounds(&right, &left, -baseline_m, depth);
    if in_left.min.x >= in_left.max.x || in_right.min.x >= in_right.max.x {
        return Err(RectifyError::NoOverlap);
    }
    // The grid samples the border rows and columns but every 8th pixel between: a pixel of margin
    // covers the bow between samples.
    let margin = 1.0;
    let y_min = in_left.min.y.min(in_right.min.y) * focal_px - margin;
    let y_max = in_left.max.y.max(in_right.max.y) * focal_px + margin;
    let width_of = |bounds: &Bounds| (bounds.max.x - bounds.min.x) * focal_px + 2.0 * margin;
    let width = width_of(&in_left).max(width_of(&in_right)).ceil() + 1.0;
    let height = (y_max - y_min).ceil() + 1.0;
    if width.max(height) > CANVAS_MAX_PX {
        return Err(RectifyError::CanvasTooLarge { width, height });
    }
    // The narrower of the two is centred; whole-pixel principal points have no other purpose than
    // to be read easily.
    let centred = |bounds: &Bounds| {
        let middle = 0.5 * (bounds.min.x + bounds.max.x) * focal_px;
        (0.5 * (width - 1.0) - middle).round()
    };
    let mut geometry = RectifiedGeometry {
        rect_from_left,
        focal_px,
        cx_left_px: centred(&in_left),
        cx_right_px: centred(&in_right),
        cy_px: (-y_min).round(),
        baseline_m,
        // Rows of whole vectors are read faster; the columns added show nothing.
        width: (width as usize + 1).next_multiple_of(ROW_PX),
        height: height as usize + 1,
    };
    if canvas == Canvas::Sensor {
        let [w, h] = calibration.left.resolution_px;
        let beside = (0.5 * (width - w as f64)).round();
        geometry.cx_left_px -= beside;
        geometry.cx_right_px -= beside;
        geometry.cy_px -= (0.5 * (height - h as f64)).round();
        (geometry.width, geometry.height) = (w, h);
    }
    Ok(geometry)
}
