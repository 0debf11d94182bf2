//! From disparities to depth and points.

use std::sync::Arc;

use nalgebra::{Matrix3, Point3};
use rayon::prelude::*;
use stspp_matcher::{Image, Matched, SAMPLES_PER_DN8, Sample};

use crate::{DepthFrame, PointCloud, RectifiedGeometry, SlotLabel};

/// Rows that a task handles.
const BAND: usize = 32;

/// The reprojection of a canvas pixel: point = baseline / parallax * matrix * (x, y, 1).
///
/// In `f32`: its rounding moves a point at 2 m by less than a micrometre.
struct Reprojection {
    /// baseline * left_from_pixel, prepared in `f64`.
    columns: [[f64; 3]; 3],
    disparity_at_infinity_px: f32,
}

/// The reprojection along a row: component k of a pixel's ray is `first[k]` + `step[k]` x.
struct Row {
    first: [f32; 3],
    step: [f32; 3],
    disparity_at_infinity_px: f32,
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
        let left_from_rect = geometry.rect_from_left.inverse();
        let scaled = left_from_rect.matrix() * rect_from_pixel * geometry.baseline_m;
        Self {
            columns: std::array::from_fn(|c| std::array::from_fn(|r| scaled[(r, c)])),
            disparity_at_infinity_px: geometry.disparity_at_infinity_px() as f32,
        }
    }

    fn row(&self, y: usize) -> Row {
        let [x, dy, one] = self.columns;
        Row {
            first: std::array::from_fn(|k| (one[k] + dy[k] * y as f64) as f32),
            step: x.map(|v| v as f32),
            disparity_at_infinity_px: self.disparity_at_infinity_px,
        }
    }
}

impl Row {
    /// Component `k` of the points of a row; NaN without a disparity or behind the cameras.
    fn component(&self, k: usize, disparity_px: &[f32], out: &mut [f32]) {
        let (first, step) = (self.first[k], self.step[k]);
        for (x, (out, &d)) in out.iter_mut().zip(disparity_px).enumerate() {
            let parallax_px = d - self.disparity_at_infinity_px;
            let value = (first + step * x as i32 as f32) / parallax_px;
            *out = if parallax_px > 0.0 { value } else { f32::NAN };
        }
    }
}

/// Depth of each pixel: z in the left camera's (unrectified) frame in metres, NaN where invalid.
pub fn depth_of_disparity(geometry: &RectifiedGeometry, disparity_px: &Image<f32>) -> Image<f32> {
    let (width, reprojection) = (disparity_px.width(), Reprojection::new(geometry));
    let mut depth_m = Image::new(width, disparity_px.height(), 0.0);
    let bands = depth_m.as_mut_slice().par_chunks_mut(width.max(1) * BAND).enumerate();
    bands.for_each(|(band, rows)| {
        for (k, out) in rows.chunks_mut(width).enumerate() {
            let y = band * BAND + k;
            reprojection.row(y).component(2, disparity_px.row(y), out);
        }
    });
    depth_m
}

/// Pixels that are compacted at a time.
const RUN: usize = 256;

/// All valid pixels of a frame as points of the left camera's frame, row by row, in place of what
/// `cloud` holds.
pub(crate) fn point_cloud(frame: &DepthFrame, cloud: &mut PointCloud) {
    let disparity_px = &frame.disparity_px;
    let (width, height) = (disparity_px.width(), disparity_px.height());
    let reprojection = Reprojection::new(&frame.geometry);
    let infinity = reprojection.disparity_at_infinity_px;
    let mut counts = vec![0_usize; height.div_ceil(BAND)];
    let pixels = disparity_px.as_slice().par_chunks(width.max(1) * BAND);
    counts.par_iter_mut().zip(pixels).for_each(|(count, band)| {
        *count = band.iter().map(|&d| i32::from(d - infinity > 0.0)).sum::<i32>() as usize;
    });
    let total = counts.iter().sum();
    cloud.points_left_m.resize(total, Point3::origin());
    cloud.zncc.resize(total, 0.0);
    cloud.intensity.resize(total, 0);
    let rate_map = frame.depth_rate_m_per_s.as_ref();
    cloud.depth_rate_m_per_s.resize(rate_map.map_or(0, |_| total), 0.0);
    // Each band writes its own part.
    let (mut points, mut znccs, mut greys) =
        (&mut cloud.points_left_m[..], &mut cloud.zncc[..], &mut cloud.intensity[..]);
    let mut rates = &mut cloud.depth_rate_m_per_s[..];
    let mut parts = Vec::with_capacity(counts.len());
    for count in counts {
        parts.push((
            points.split_off_mut(..count).unwrap_or_default(),
            znccs.split_off_mut(..count).unwrap_or_default(),
            greys.split_off_mut(..count).unwrap_or_default(),
            // Empty without rates.
            rates.split_off_mut(..count).unwrap_or_default(),
        ));
    }
    parts.into_par_iter().enumerate().for_each(|(band, (points, znccs, greys, rates))| {
        let mut at = 0;
        let mut xyz = [[0.0_f32; RUN]; 3];
        for y in band * BAND..((band + 1) * BAND).min(height) {
            let mut row = reprojection.row(y);
            let runs = disparity_px.row(y).chunks(RUN);
            let others = frame.zncc.row(y).chunks(RUN).zip(frame.intensity.row(y).chunks(RUN));
            for (run, (disparities, (zncc, intensity))) in runs.zip(others).enumerate() {
                let rate = rate_map.map(|map| &map.row(y)[run * RUN..]);
                for (k, out) in xyz.iter_mut().enumerate() {
                    row.component(k, disparities, out);
                    row.first[k] += row.step[k] * RUN as f32;
                }
                for (i, (&zncc, &grey)) in zncc.iter().zip(intensity).enumerate() {
                    let [x, y, z] = [xyz[0][i], xyz[1][i], xyz[2][i]];
                    if !z.is_nan() {
                        points[at] = Point3::new(x, y, z);
                        znccs[at] = zncc;
                        greys[at] = grey;
                        if let Some(rate) = rate {
                            rates[at] = rate[i];
                        }
                        at += 1;
                    }
                }
            }
        }
    });
}

/// Brightness of the left camera over a window: the match's own where it has one, which is taken out of it,
/// else that of the window's rectified frames.
pub fn brightness(matched: &mut Matched, left: &[&Image<Sample>]) -> Image<u8> {
    matched.brightness.take().unwrap_or_else(|| mean_intensity(left))
}

/// Brightness of the left camera over a window: the mean of its rectified frames.
pub fn mean_intensity(left: &[&Image<Sample>]) -> Image<u8> {
    let Some(first) = left.first() else { return Image::new(0, 0, 0) };
    let width = first.width();
    let mut mean = Image::new(width, first.height(), 0_u8);
    // In eighths of a grey level the sum of 16 frames fits 16 bits.
    const { assert!(SAMPLES_PER_DN8 == 64) };
    let scale = 1.0 / (8.0 * left.len() as f32);
    let bands = mean.as_mut_slice().par_chunks_mut(RUN).enumerate();
    bands.with_min_len(64).for_each(|(run, out)| {
        let mut sums = [0_i16; RUN];
        for image in left {
            let samples = &image.as_slice()[run * RUN..][..out.len()];
            for (sum, &sample) in sums.iter_mut().zip(samples) {
                *sum = sum.saturating_add(sample.saturating_add(4) >> 3);
            }
        }
        for (out, sum) in out.iter_mut().zip(sums) {
            *out = (f32::from(sum) * scale + 0.5) as u8;
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
