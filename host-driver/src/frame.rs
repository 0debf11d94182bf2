//! What the sensor delivers: depth frames and point clouds.

use std::io;
use std::path::Path;
use std::sync::Arc;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};
use stspp_matcher::{Image, StageTime};

use crate::RectifiedGeometry;
use crate::export::{atomic, ply};

/// What lit one camera frame and when, as reported by the controller.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlotLabel {
    /// Number of the camera trigger since the stream started.
    pub sequence: u32,
    /// Index of the slot in the projection timing.
    pub slot: u16,
    /// Projectors that were on: bit k is projector k.
    pub projector_mask: u16,
    /// Whether the floodlight was on.
    pub floodlight: bool,
    /// Start of the exposure in microseconds of the device's clock.
    pub trigger_time_us: u64,
    /// Exposure in microseconds.
    pub exposure_us: u32,
}

impl SlotLabel {
    /// Centre of the exposure in seconds of the device's clock.
    pub fn exposure_centre_s(&self) -> f64 {
        (self.trigger_time_us as f64 + 0.5 * f64::from(self.exposure_us)) * 1e-6
    }
}

/// Depth of one window of stereo pairs, on the left rectified canvas.
#[derive(Debug, Clone)]
pub struct DepthFrame {
    /// Number of this frame since the stream started.
    pub sequence: u64,
    /// Depth in metres: z in the left camera's own (unrectified) frame of the point seen at this
    /// pixel of the left rectified canvas. NaN is invalid.
    pub depth_m: Image<f32>,
    /// Disparity x_left - x_right in pixels, NaN where the depth is.
    pub disparity_px: Image<f32>,
    /// ZNCC of the refined subset, NaN where the depth is.
    pub zncc: Image<f32>,
    /// Brightness of the left camera: mean of the window's frames, 255 is the camera's full scale.
    pub intensity: Image<u8>,
    /// Speed along depth in metres per second, positive away from the sensor: zero where nothing moves
    /// significantly, NaN where the depth is. `None` where motion is not estimated, or without times.
    pub depth_rate_m_per_s: Option<Image<f32>>,
    /// What lit the frames of the window, oldest first; empty when the source knows none.
    pub labels: Vec<SlotLabel>,
    /// Time that the depth refers to, in seconds of the device's clock: the newest frame's exposure
    /// centre where motion is estimated, the window's mean otherwise. `None` without labels.
    pub time_device_s: Option<f64>,
    /// Host time of the newest frame's arrival; `None` for a frame that was never live.
    pub arrived: Option<std::time::SystemTime>,
    /// Geometry of the canvas.
    pub geometry: Arc<RectifiedGeometry>,
    /// Time of each stage.
    pub stages: Vec<StageTime>,
}

impl DepthFrame {
    /// Number of valid pixels.
    pub fn valid_points(&self) -> usize {
        self.depth_m.as_slice().iter().filter(|z| z.is_finite()).count()
    }

    /// All valid pixels as points of the left camera's frame, row by row.
    pub fn point_cloud(&self) -> PointCloud {
        let mut cloud = PointCloud::default();
        self.point_cloud_into(&mut cloud);
        cloud
    }

    /// The frame at the middle of its window's time instead of the newest frame's.
    ///
    /// Where motion is estimated, depth refers to the newest frame: what a robot wants, but an error of
    /// the estimated speed is multiplied by half of the window's time. At the window's middle it hardly
    /// counts, so that this is what is measured, or fused, of a scene in motion. Without motion
    /// estimated, or without times, the frame is as it was.
    pub fn at_window_middle(mut self) -> Self {
        let Some((newest_s, rate)) = self.time_device_s.zip(self.depth_rate_m_per_s.as_ref())
        else {
            return self;
        };
        let times = self.labels.iter().map(SlotLabel::exposure_centre_s);
        let middle_s = times.sum::<f64>() / self.labels.len().max(1) as f64;
        let back_s = (newest_s - middle_s) as f32;
        let infinity_px = self.geometry.disparity_at_infinity_px() as f32;
        let pixels = self.depth_m.as_mut_slice().iter_mut().zip(self.disparity_px.as_mut_slice());
        for ((z, d), rate) in pixels.zip(rate.as_slice()) {
            // The matcher's rate is one of the disparity; z is in proportion to 1 / parallax.
            let share = 1.0 + rate * back_s / *z;
            *d = infinity_px + (*d - infinity_px) * share;
            *z /= share;
        }
        self.time_device_s = Some(middle_s);
        self
    }

    /// As [`Self::point_cloud`], in place of what `cloud` holds: a loop over frames that keeps its
    /// cloud takes no new memory.
    pub fn point_cloud_into(&self, cloud: &mut PointCloud) {
        crate::reproject::point_cloud(self, cloud);
    }
}

/// Points in the left camera's (unrectified) optical frame, metres.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions: +x right, +y down, +z forward, metres.
    pub points_left_m: Vec<Point3<f32>>,
    /// ZNCC per point, as many as points.
    pub zncc: Vec<f32>,
    /// Brightness per point, as many as points.
    pub intensity: Vec<u8>,
    /// Speed along +z per point in metres per second, as many as points; empty where motion is not
    /// estimated.
    pub depth_rate_m_per_s: Vec<f32>,
}

impl PointCloud {
    /// An empty cloud with room for `points`.
    pub fn with_capacity(points: usize) -> Self {
        Self {
            points_left_m: Vec::with_capacity(points),
            zncc: Vec::with_capacity(points),
            intensity: Vec::with_capacity(points),
            depth_rate_m_per_s: Vec::new(),
        }
    }

    /// Writes a binary PLY file (see [`ply`]); it appears whole or not at all.
    ///
    /// # Errors
    /// From the file system.
    pub fn write_ply(&self, path: impl AsRef<Path>) -> io::Result<()> {
        atomic::write_file(path.as_ref(), |out| ply::write(out, self))
    }

    /// Reads a PLY file, ours or another program's.
    ///
    /// # Errors
    /// Names the header line or the point.
    pub fn read_ply(path: impl AsRef<Path>) -> Result<Self, ply::PlyError> {
        ply::read(&mut io::BufReader::new(std::fs::File::open(path)?))
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points_left_m.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points_left_m.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    #[test]
    fn a_moving_surface_goes_back_to_the_middle_of_its_window() {
        let geometry = Arc::new(RectifiedGeometry {
            rect_from_left: Rotation3::identity(),
            focal_px: 1800.0,
            cx_left_px: 100.0,
            cx_right_px: 400.0,
            cy_px: 50.0,
            baseline_m: 0.4,
            width: 2,
            height: 1,
        });
        let disparity = |z: f64| (geometry.disparity_at_infinity_px() + 720.0 / z) as f32;
        let image = |a: f32, b: f32| Image::from_vec(2, 1, vec![a, b]).unwrap();
        let labels: Vec<SlotLabel> = (0..5)
            .map(|k| SlotLabel {
                sequence: k,
                slot: k as u16,
                projector_mask: 1,
                floodlight: false,
                trigger_time_us: 33_333 * u64::from(k),
                exposure_us: 32_000,
            })
            .collect();
        let newest_s = labels[4].exposure_centre_s();
        let frame = DepthFrame {
            sequence: 0,
            depth_m: image(1.0, f32::NAN),
            disparity_px: image(disparity(1.0), f32::NAN),
            zncc: image(1.0, f32::NAN),
            intensity: Image::new(2, 1, 100),
            depth_rate_m_per_s: Some(image(0.03, f32::NAN)),
            labels,
            time_device_s: Some(newest_s),
            arrived: None,
            geometry: Arc::clone(&geometry),
            stages: Vec::new(),
        };
        let still = DepthFrame { depth_rate_m_per_s: None, ..frame.clone() }.at_window_middle();
        assert_eq!(still.depth_m.as_slice()[0], 1.0);
        let middle = frame.at_window_middle();
        // Two intervals earlier it was nearer by 2 mm, but for what speed in disparity and speed in
        // depth differ by over that way.
        let z = middle.depth_m.as_slice()[0];
        assert!((z - 0.998).abs() < 1e-5, "{z}");
        assert!((middle.disparity_px.as_slice()[0] - disparity(f64::from(z))).abs() < 1e-3);
        assert!((middle.time_device_s.unwrap() - (newest_s - 2.0 * 0.033_333)).abs() < 1e-9);
        assert!(middle.depth_m.as_slice()[1].is_nan());
    }
}
