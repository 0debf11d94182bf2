//! The cameras: projection with lens distortion, and what turns light into numbers.

use nalgebra::Vector3;

/// A camera: pinhole projection with radial-tangential distortion, lens and sensor.
///
/// Pixel coordinates are continuous; integers are pixel centres, (0, 0) is the centre of the upper
/// left pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraModel {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Focal lengths fu, fv in pixels.
    pub focal_px: [f64; 2],
    /// Principal point pu, pv.
    pub principal_px: [f64; 2],
    /// Distortion k1, k2, p1, p2 of the radtan (plumb bob) model, in normalised coordinates.
    pub radtan: [f64; 4],
    /// Exponent n of the vignetting cos^n(field angle): 4 is a simple lens.
    pub vignetting_exponent: f64,
    /// Standard deviation of the lens' Gaussian point spread. The pixel's own square aperture comes
    /// on top.
    pub blur_sigma_px: f64,
    /// Electrons at which a pixel is full.
    pub full_well_e: f64,
    /// Standard deviation of the read noise.
    pub read_noise_e: f64,
    /// Gain at the bit depth `bits`, numbers per electron.
    pub gain_dn_per_e: f64,
    /// Number that no light reads as, at the bit depth `bits`.
    pub black_level_dn: f64,
    /// Relative standard deviation of the pixels' sensitivities (a fixed pattern).
    pub prnu: f64,
    /// Bits per pixel: 8, 10 or 12.
    pub bits: u8,
}

impl CameraModel {
    /// The same camera read out with another bit depth: full scale stays at the same signal.
    #[must_use]
    pub fn with_bits(mut self, bits: u8) -> Self {
        let ratio = full_scale(bits) / full_scale(self.bits);
        self.gain_dn_per_e *= ratio;
        self.black_level_dn *= ratio;
        self.bits = bits;
        self
    }

    /// Normalised undistorted coordinates (x/z, y/z) to normalised distorted ones.
    #[must_use]
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, p1, p2] = self.radtan;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// Projects a point of this camera's frame, in metres, to a pixel. `None` behind the camera, and
    /// where the distortion polynomial has folded back so that the lens would not see the point.
    #[must_use]
    pub fn project(&self, point_m: &Vector3<f64>) -> Option<[f64; 2]> {
        if point_m.z <= 0.0 {
            return None;
        }
        let n = [point_m.x / point_m.z, point_m.y / point_m.z];
        let r2 = n[0] * n[0] + n[1] * n[1];
        let [k1, k2, ..] = self.radtan;
        if 1.0 + r2 * (3.0 * k1 + 5.0 * r2 * k2) <= 0.0 || !r2.is_finite() {
            return None;
        }
        let [x, y] = self.distort(n);
        Some([
            self.focal_px[0] * x + self.principal_px[0],
            self.focal_px[1] * y + self.principal_px[1],
        ])
    }

    /// Normalised undistorted coordinates (x/z, y/z) of the ray through a pixel.
    #[must_use]
    pub fn unproject(&self, pixel: [f64; 2]) -> [f64; 2] {
        let start = self.normalised_distorted(pixel);
        self.unproject_from(pixel, start)
    }

    /// [`Self::unproject`] with a start that is already close, such as the neighbour's result.
    pub(crate) fn unproject_from(&self, pixel: [f64; 2], start: [f64; 2]) -> [f64; 2] {
        let target = self.normalised_distorted(pixel);
        let [k1, k2, p1, p2] = self.radtan;
        let [mut x, mut y] = start;
        for _ in 0..20 {
            let [dx, dy] = self.distort([x, y]);
            let [ex, ey] = [dx - target[0], dy - target[1]];
            let r2 = x * x + y * y;
            let radial = 1.0 + r2 * (k1 + r2 * k2);
            let slope = 2.0 * (k1 + 2.0 * k2 * r2);
            let jxx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x;
            let jxy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
            let jyy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x;
            let det = jxx * jyy - jxy * jxy;
            let step = [(jyy * ex - jxy * ey) / det, (jxx * ey - jxy * ex) / det];
            x -= step[0];
            y -= step[1];
            // Newton's next error is the square of this step.
            if step[0].abs().max(step[1].abs()) < 1e-7 {
                break;
            }
        }
        [x, y]
    }

    /// Unit direction of the ray through a pixel, in this camera's frame.
    #[must_use]
    pub fn ray_direction(&self, pixel: [f64; 2]) -> Vector3<f64> {
        let [x, y] = self.unproject(pixel);
        Vector3::new(x, y, 1.0).normalize()
    }

    /// Whether a pixel position lies on the sensor.
    #[must_use]
    pub fn contains(&self, [u, v]: [f64; 2]) -> bool {
        u >= -0.5 && v >= -0.5 && u < self.width as f64 - 0.5 && v < self.height as f64 - 0.5
    }

    fn normalised_distorted(&self, pixel: [f64; 2]) -> [f64; 2] {
        [
            (pixel[0] - self.principal_px[0]) / self.focal_px[0],
            (pixel[1] - self.principal_px[1]) / self.focal_px[1],
        ]
    }

    /// The camera with `1/factor` of the pixels in each direction over the same field.
    pub(crate) fn scaled_down(&self, factor: usize) -> Self {
        let s = 1.0 / factor as f64;
        Self {
            width: self.width / factor,
            height: self.height / factor,
            focal_px: self.focal_px.map(|f| f * s),
            principal_px: self.principal_px.map(|c| (c + 0.5) * s - 0.5),
            ..self.clone()
        }
    }
}

/// The largest number at a bit depth.
pub(crate) fn full_scale(bits: u8) -> f64 {
    f64::from((1_u32 << bits) - 1)
}
