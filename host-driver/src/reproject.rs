//! From disparities to depth and points.

use std::sync::Arc;

use nalgebra::{Matrix3, Point3, Vector3};
use rayon::prelude::*;
use stspp_matcher::{Image, Matched, SAMPLES_PER_DN8, Sample};

use crate::{DepthFrame, PointCloud, RectifiedGeometry, SlotLabel};

/// Rows that a task handles.
const BAND: usize = 32;

/// The reprojection of a canvas pixel: point = baseline / parallax * matrix * (x, y, 1).
struct Reprojection {
    left_from_pixel: Matrix3<f64>,
    baseline_m: f64,
    disparity_at_infinity_px: f64,
}

impl Reprojection {
    fn new(geometry: &RectifiedGeometry) -> Self {
        let rect_from_pixel = Matrix3::new(
            1.0,
            0.0,
            -geometry.cx_left_px, //
            0.0,
            1.0,
            -geometry.cy_px, //
            0.0,
            0.0,
            geometry.focal_px,
        );
        Self {
            left_from_pixel: geometry.rect_from_left.inverse().matrix() * rect_from_pixel,
            baseline_m: geometry.baseline_m,
            disparity_at_infinity_px: geometry.disparity_at_infinity_px(),
        }
    }

    /// Metres per unit of the pixel's ray; NaN without a disparity or behind the cameras.
    fn scale(&self, disparity_px: f32) -> f64 {
        let parallax_px = f64::from(disparity_px) - self.disparity_at_infinity_px;
        if parallax_px > 0.0 { self.baseline_m / parallax_px } else { f64::NAN }
    }

    fn ray(&self, x: usize, y: usize) -> Vector3<f64> {
        self.left_from_pixel * Vector3::new(x as f64, y as f64, 1.0)
    }
}

/// Depth of each pixel: z in the left camera's (unrectified) frame in metres, NaN where invalid.
pub fn depth_of_disparity(geometry: &RectifiedGeometry, disparity_px: &Image<f32>) -> Image<f32> {
    let (width, reprojection) = (disparity_px.width(), Reprojection::new(geometry));
    let mut depth_m = Image::new(width, disparity_px.height(), f32::NAN);
    let bands = depth_m.as_mut_slice().par_chunks_mut(width.max(1) * BAND).enumerate();
    bands.for_each(|(band, rows)| {
        for (k, row) in rows.chunks_mut(width).enumerate() {
            let y = band * BAND + k;
            let (first, step) = (reprojection.ray(0, y).z, reprojection.left_from_pixel[(2, 0)]);
            for (x, (z, &d)) in row.iter_mut().zip(disparity_px.row(y)).enumerate() {
                *z = (reprojection.scale(d) * (first + step * x as f64)) as f32;
            }
        }
    });
    depth_m
}

/// All valid pixels of a frame as points of the left camera's frame, row by row.
pub(crate) fn point_cloud(frame: &DepthFrame) -> PointCloud {
    let reprojection = Reprojection::new(&frame.geometry);
    let bands: Vec<PointCloud> = (0..frame.disparity_px.height().div_ceil(BAND))
        .into_par_iter()
        .map(|band| {
            let mut cloud = PointCloud::default();
            for y in band * BAND..((band + 1) * BAND).min(frame.disparity_px.height()) {
                let (zncc, intensity) = (frame.zncc.row(y), frame.intensity.row(y));
                let rate = frame.depth_rate_m_per_s.as_ref().map(|rate| rate.row(y));
                for (x, &d) in frame.disparity_px.row(y).iter().enumerate() {
                    let scale = reprojection.scale(d);
                    if scale.is_finite() {
                        let point = Point3::from(reprojection.ray(x, y) * scale);
                        cloud.points_left_m.push(point.cast());
                        cloud.zncc.push(zncc[x]);
                        cloud.intensity.push(intensity[x]);
                        cloud.depth_rate_m_per_s.extend(rate.map(|rate| rate[x]));
                    }
                }
            }
            cloud
        })
        .collect();
    let mut cloud = PointCloud::with_capacity(bands.iter().map(PointCloud::len).sum());
    for band in bands {
        cloud.points_left_m.extend(band.points_left_m);
        cloud.zncc.extend(band.zncc);
        cloud.intensity.extend(band.intensity);
        cloud.depth_rate_m_per_s.extend(band.depth_rate_m_per_s);
    }
    cloud
}

/// Brightness of the left camera over a window: the mean of its rectified frames.
pub fn mean_intensity(left: &[&Image<Sample>]) -> Image<u8> {
    let Some(first) = left.first() else { return Image::new(0, 0, 0) };
    let width = first.width();
    let mut mean = Image::new(width, first.height(), 0_u8);
    let unit = i32::from(SAMPLES_PER_DN8) * left.len() as i32;
    let bands = mean.as_mut_slice().par_chunks_mut(width.max(1) * BAND).enumerate();
    bands.for_each(|(band, out)| {
        let mut sums = vec![0_i32; out.len()];
        for image in left {
            let samples = &image.as_slice()[band * BAND * width..];
            for (sum, &sample) in sums.iter_mut().zip(samples) {
                *sum += i32::from(sample);
            }
        }
        for (out, sum) in out.iter_mut().zip(sums) {
            *out = ((sum + unit / 2) / unit).clamp(0, 255) as u8;
        }
    });
    mean
}

/// Makes a depth frame of a match. `labels` are those of the window's frames, oldest first, or none;
/// sequence and arrival are left to whoever streams.
pub fn depth_frame(
    geometry: &Arc<RectifiedGeometry>,
    matched: Matched,
    intensity: Image<u8>,
    labels: Vec<SlotLabel>,
) -> DepthFrame {
    let depth_m = depth_of_disparity(geometry, &matched.disparity_px);
    let depth_rate_m_per_s = matched.rate_px_per_s.as_ref().map(|rate| {
        // z is proportional to 1 / parallax, so that dz/dt = -z * (dd/dt) / parallax.
        let infinity = geometry.disparity_at_infinity_px() as f32;
        let mut out = rate.clone();
        let sources = depth_m.as_slice().iter().zip(matched.disparity_px.as_slice());
        for (rate, (z, d)) in out.as_mut_slice().iter_mut().zip(sources) {
            *rate *= -z / (d - infinity);
        }
        out
    });
    let time_device_s = match labels.last() {
        None => None,
        Some(newest) if matched.at_newest => Some(newest.exposure_centre_s()),
        Some(_) => {
            let sum: f64 = labels.iter().map(SlotLabel::exposure_centre_s).sum();
            Some(sum / labels.len() as f64)
        }
    };
    DepthFrame {
        sequence: 0,
        depth_m,
        disparity_px: matched.disparity_px,
        zncc: matched.zncc,
        intensity,
        depth_rate_m_per_s,
        labels,
        time_device_s,
        arrived: None,
        geometry: Arc::clone(geometry),
        stages: matched.stages,
    }
}
