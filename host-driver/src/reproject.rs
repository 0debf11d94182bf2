//! From disparities to depth and points.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod front;
#[cfg(target_arch = "aarch64")]
mod neon;
mod plain;

use std::sync::{Arc, OnceLock};

use nalgebra::{Matrix3, Point3};
use rayon::prelude::*;
use stspp_matcher::parallel::Share;
use stspp_matcher::{Image, Level, Matched, SAMPLES_PER_DN8, Sample};

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
    /// Component `k` of the points of pixels from column `from` on; NaN without a disparity or behind the
    /// cameras.
    fn component(&self, k: usize, from: usize, disparity_px: &[f32], out: &mut [f32]) {
        let (first, step) = (self.first[k], self.step[k]);
        for (i, (out, &d)) in out.iter_mut().zip(disparity_px).enumerate() {
            let parallax_px = d - self.disparity_at_infinity_px;
            let value = (first + step * (from + i) as i32 as f32) * (1.0 / parallax_px);
            *out = if parallax_px > 0.0 { value } else { f32::NAN };
        }
    }
}

/// Depth of each pixel: z in the left camera's (unrectified) frame in metres, NaN where invalid.
pub fn depth_of_disparity(geometry: &RectifiedGeometry, disparity_px: &Image<f32>) -> Image<f32> {
    let (width, reprojection) = (disparity_px.width(), Reprojection::new(geometry));
    let mut depth_m = disparity_px.sibling(0.0);
    let bands = depth_m.as_mut_slice().par_chunks_mut(width.max(1) * BAND).enumerate();
    bands.share(|(band, rows)| {
        for (k, out) in rows.chunks_mut(width).enumerate() {
            let y = band * BAND + k;
            reprojection.row(y).component(2, 0, disparity_px.row(y), out);
        }
    });
    depth_m
}

/// What points are made of besides a row's disparities, as many of each.
struct Sources<'a> {
    disparity_px: &'a [f32],
    zncc: &'a [f32],
    intensity: &'a [u8],
    rate: Option<&'a [f32]>,
}

/// The part of a cloud that a task fills; no rates without a map of them.
struct Part<'a> {
    points: &'a mut [Point3<f32>],
    zncc: &'a mut [f32],
    intensity: &'a mut [u8],
    rate: &'a mut [f32],
}

/// The level of the kernels; what the environment asks for in vain is the matcher's to report.
fn level() -> Level {
    static LEVEL: OnceLock<Level> = OnceLock::new();
    *LEVEL.get_or_init(|| Level::choose(None).unwrap_or_else(|_| Level::best()))
}

/// Writes the valid points of a row to `part` from place `at` on; returns the place after them.
///
/// # Panics
/// When they are more than there is place for.
fn pack_row(level: Level, row: &Row, from: &Sources<'_>, part: &mut Part<'_>, at: usize) -> usize {
    let n = from.disparity_px.len();
    assert!(from.zncc.len() == n && from.intensity.len() == n);
    assert!(from.rate.is_none_or(|rate| rate.len() == n && part.rate.len() == part.points.len()));
    assert!(part.zncc.len() == part.points.len() && part.intensity.len() == part.points.len());
    match level {
        // SAFETY: the level is this processor's; lengths are as checked.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { avx512::pack_row(row, from, part, at) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { avx2::pack_row(row, from, part, at) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => unsafe { neon::pack_row(row, from, part, at) },
        _ => plain::pack_row(row, from, part, 0, at),
    }
}

/// All valid pixels of a frame as points of the left camera's frame, row by row, in place of what
/// `cloud` holds.
pub(crate) fn point_cloud(frame: &DepthFrame, cloud: &mut PointCloud) {
    point_cloud_at(level(), frame, cloud);
}

fn point_cloud_at(level: Level, frame: &DepthFrame, cloud: &mut PointCloud) {
    let disparity_px = &frame.disparity_px;
    let (width, height) = (disparity_px.width(), disparity_px.height());
    let reprojection = Reprojection::new(&frame.geometry);
    let infinity = reprojection.disparity_at_infinity_px;
    let mut counts = vec![0_usize; height.div_ceil(BAND)];
    let pixels = disparity_px.as_slice().par_chunks(width.max(1) * BAND);
    counts.par_iter_mut().zip(pixels).share(|(count, band)| {
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
        parts.push(Part {
            points: points.split_off_mut(..count).unwrap_or_default(),
            zncc: znccs.split_off_mut(..count).unwrap_or_default(),
            intensity: greys.split_off_mut(..count).unwrap_or_default(),
            // Empty without rates.
            rate: rates.split_off_mut(..count).unwrap_or_default(),
        });
    }
    parts.into_par_iter().enumerate().share(|(band, mut part)| {
        let mut at = 0;
        for y in band * BAND..((band + 1) * BAND).min(height) {
            let from = Sources {
                disparity_px: disparity_px.row(y),
                zncc: frame.zncc.row(y),
                intensity: frame.intensity.row(y),
                rate: rate_map.map(|map| map.row(y)),
            };
            at = pack_row(level, &reprojection.row(y), &from, &mut part, at);
        }
    });
}

/// Brightness of the left camera over a window: the match's own where it has one, which is taken out of it,
/// else that of the window's rectified frames.
pub fn brightness(matched: &mut Matched, left: &[&Image<Sample>]) -> Image<u8> {
    matched.brightness.take().unwrap_or_else(|| mean_intensity(left))
}

/// Pixels whose mean is taken at a time.
const RUN: usize = 256;

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
        let mut out = rate.sibling(0.0);
        let run = out.width().max(1) * BAND;
        let sources = (depth_m.as_slice().par_chunks(run))
            .zip(matched.disparity_px.as_slice().par_chunks(run))
            .zip(rate.as_slice().par_chunks(run));
        out.as_mut_slice().par_chunks_mut(run).zip(sources).share(|(out, ((z, d), rate))| {
            for (((out, z), d), rate) in out.iter_mut().zip(z).zip(d).zip(rate) {
                *out = rate * (-z / (d - infinity));
            }
        });
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_level_packs_the_same_points_as_one_by_one() {
        for (width, height) in [(1_usize, 1_usize), (15, 3), (16, 40), (37, 70), (300, 65)] {
            let mut state = 7_u64;
            let mut random = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(9);
                (state >> 40) as f32 / (1 << 24) as f32
            };
            let row = Row {
                first: [-0.4, 0.3, 1.1],
                step: [0.001, -0.000_02, 0.000_1],
                disparity_at_infinity_px: -20.0,
            };
            // Some behind the cameras, some without a disparity, and runs of both.
            let mut disparity_px = Image::new(width, height, f32::NAN);
            let mut mean = 0.9;
            for d in disparity_px.as_mut_slice() {
                mean = if random() < 0.05 { random() } else { mean };
                *d = if random() < mean { 150.0 * random() - 30.0 } else { f32::NAN };
            }
            let zncc = disparity_px.map(|_| random());
            let intensity = disparity_px.map(|_| (256.0 * random()) as u8);
            let rate = disparity_px.map(|_| random());
            for rates in [None, Some(&rate)] {
                for y in 0..height {
                    let from = Sources {
                        disparity_px: disparity_px.row(y),
                        zncc: zncc.row(y),
                        intensity: intensity.row(y),
                        rate: rates.map(|map| map.row(y)),
                    };
                    let valid = |x: &usize| from.disparity_px[*x] > -20.0;
                    let count = (0..width).filter(valid).count();
                    for level in Level::available() {
                        let mut points = vec![Point3::origin(); count];
                        let (mut z, mut g) = (vec![0.0; count], vec![0; count]);
                        let mut r = vec![0.0; if rates.is_some() { count } else { 0 }];
                        let part = &mut Part {
                            points: &mut points,
                            zncc: &mut z,
                            intensity: &mut g,
                            rate: &mut r,
                        };
                        assert_eq!(pack_row(level, &row, &from, part, 0), count, "{level} {width}");
                        for (i, x) in (0..width).filter(valid).enumerate() {
                            let ray = |k: usize| row.first[k] + row.step[k] * x as f32;
                            let scale = 1.0 / (from.disparity_px[x] + 20.0);
                            let want = Point3::new(ray(0), ray(1), ray(2)) * scale;
                            assert_eq!(points[i], want, "{level} {width} {x}");
                            assert_eq!((z[i], g[i]), (from.zncc[x], from.intensity[x]));
                            assert!(from.rate.is_none_or(|rate| r[i] == rate[x]));
                        }
                    }
                }
            }
        }
    }
}
