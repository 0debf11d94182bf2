//! One camera: pinhole projection with Brown's radial-tangential distortion.

use nalgebra::{Matrix2, Matrix2x3, Point3, SMatrix, Vector2};

use super::error::FieldError;

/// Newton steps of an undistortion: quadratic convergence needs 4-6, more means no solution.
const NEWTON_STEPS_MAX: usize = 30;
/// Newton ends at a residual of this many normalised units (1e-11 px at a focal length of 1000 px).
const NEWTON_RESIDUAL: f64 = 1e-14;

/// A pinhole camera with radial-tangential distortion.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraIntrinsics {
    /// Focal lengths [x, y] in pixels.
    pub focal_px: [f64; 2],
    /// Principal point [x, y] in pixels; the centre of the first pixel is (0, 0).
    pub principal_px: [f64; 2],
    /// Distortion coefficients [k1, k2, p1, p2] of the Brown model.
    pub radtan: [f64; 4],
    /// Image size [width, height] in pixels.
    pub resolution_px: [usize; 2],
}

/// A pixel and how it moves, see [`CameraIntrinsics::project_with_derivatives`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// The pixel.
    pub pixel: Vector2<f64>,
    /// Its derivative by the point, in px per metre.
    pub by_point: Matrix2x3<f64>,
    /// Its derivative by [fu, fv, pu, pv, k1, k2, p1, p2].
    pub by_intrinsics: SMatrix<f64, 2, 8>,
}

impl CameraIntrinsics {
    /// The intrinsics as [fu, fv, pu, pv, k1, k2, p1, p2].
    pub fn to_vector(&self) -> [f64; 8] {
        let ([fu, fv], [pu, pv], [k1, k2, p1, p2]) =
            (self.focal_px, self.principal_px, self.radtan);
        [fu, fv, pu, pv, k1, k2, p1, p2]
    }

    /// Intrinsics from [fu, fv, pu, pv, k1, k2, p1, p2].
    pub fn from_vector(values: [f64; 8], resolution_px: [usize; 2]) -> Self {
        let [fu, fv, pu, pv, k1, k2, p1, p2] = values;
        Self { focal_px: [fu, fv], principal_px: [pu, pv], radtan: [k1, k2, p1, p2], resolution_px }
    }

    /// [`Self::project`] with the derivatives by the point and by the intrinsics.
    pub fn project_with_derivatives(&self, point_camera: &Point3<f64>) -> Option<Projection> {
        let z = point_camera.z;
        if z.is_nan() || z <= 0.0 {
            return None;
        }
        let n = point_camera.coords.xy() / z;
        let (d, d_by_n) = self.distort_with_jacobian(n);
        let focal = Matrix2::new(self.focal_px[0], 0.0, 0.0, self.focal_px[1]);
        let n_by_point = Matrix2x3::new(1.0 / z, 0.0, -n.x / z, 0.0, 1.0 / z, -n.y / z);
        let r2 = n.norm_squared();
        let mut by_intrinsics = SMatrix::<f64, 2, 8>::zeros();
        let coefficients = [
            n * r2,
            n * r2 * r2,
            Vector2::new(2.0 * n.x * n.y, r2 + 2.0 * n.y * n.y),
            Vector2::new(r2 + 2.0 * n.x * n.x, 2.0 * n.x * n.y),
        ];
        for row in 0..2 {
            by_intrinsics[(row, row)] = d[row];
            by_intrinsics[(row, 2 + row)] = 1.0;
            for (k, by_coefficient) in coefficients.iter().enumerate() {
                by_intrinsics[(row, 4 + k)] = self.focal_px[row] * by_coefficient[row];
            }
        }
        Some(Projection {
            pixel: self.pixel_of_distorted(d),
            by_point: focal * d_by_n * n_by_point,
            by_intrinsics,
        })
    }

    /// Distorts normalised coordinates (x / z, y / z): where the lens images them.
    pub fn distort(&self, undistorted: Vector2<f64>) -> Vector2<f64> {
        self.distort_with_jacobian(undistorted).0
    }

    /// The distorted normalised coordinates and their derivative by the undistorted ones.
    fn distort_with_jacobian(&self, p: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let [k1, k2, p1, p2] = self.radtan;
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * k2);
        let radial_by_r2 = k1 + 2.0 * k2 * r2;
        let distorted = Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let cross = 2.0 * x * y * radial_by_r2 + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = Matrix2::new(
            radial + 2.0 * x * x * radial_by_r2 + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + 2.0 * y * y * radial_by_r2 + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        (distorted, jacobian)
    }

    /// Inverts [`Self::distort`] by Newton's method. `None` where the model has no inverse on the
    /// branch of the image centre, that is beyond the radius at which the distortion folds over.
    pub fn undistort(&self, distorted: Vector2<f64>) -> Option<Vector2<f64>> {
        let mut p = distorted;
        for _ in 0..NEWTON_STEPS_MAX {
            let (value, jacobian) = self.distort_with_jacobian(p);
            if jacobian.determinant().is_nan() || jacobian.determinant() <= 0.0 {
                return None;
            }
            let residual = distorted - value;
            if residual.norm() <= NEWTON_RESIDUAL * (1.0 + distorted.norm()) {
                return Some(p);
            }
            p += jacobian.try_inverse()? * residual;
        }
        // The last bit of the residual may never settle: accept what is below any camera's precision.
        let (value, jacobian) = self.distort_with_jacobian(p);
        ((distorted - value).norm() < 1e-10 && jacobian.determinant() > 0.0).then_some(p)
    }

    /// Pixel at which a point of this camera's frame is seen; `None` behind the camera. The pixel may
    /// lie outside the image.
    pub fn project(&self, point_camera: &Point3<f64>) -> Option<Vector2<f64>> {
        if point_camera.z.is_nan() || point_camera.z <= 0.0 {
            return None;
        }
        Some(self.project_normalised(point_camera.coords.xy() / point_camera.z))
    }

    /// Pixel of undistorted normalised coordinates.
    pub fn project_normalised(&self, undistorted: Vector2<f64>) -> Vector2<f64> {
        self.pixel_of_distorted(self.distort(undistorted))
    }

    fn pixel_of_distorted(&self, d: Vector2<f64>) -> Vector2<f64> {
        Vector2::new(
            self.focal_px[0] * d.x + self.principal_px[0],
            self.focal_px[1] * d.y + self.principal_px[1],
        )
    }

    /// Undistorted normalised coordinates of a pixel: its ray is (x, y, 1) in the camera's frame.
    /// `None` where the distortion has no inverse.
    pub fn normalised_of_pixel(&self, pixel: Vector2<f64>) -> Option<Vector2<f64>> {
        self.undistort(Vector2::new(
            (pixel.x - self.principal_px[0]) / self.focal_px[0],
            (pixel.y - self.principal_px[1]) / self.focal_px[1],
        ))
    }

    /// The centres of the image's border pixels, clockwise.
    pub fn border_px(&self) -> impl Iterator<Item = Vector2<f64>> {
        let [w, h] = self.resolution_px.map(|size| size.saturating_sub(1));
        let top = (0..w).map(|x| (x, 0));
        let right = (0..h).map(move |y| (w, y));
        let bottom = (0..w).map(move |x| (w - x, h));
        let left = (0..h).map(move |y| (0, h - y));
        top.chain(right).chain(bottom).chain(left).map(|(x, y)| Vector2::new(x as f64, y as f64))
    }

    /// Checks that a real camera can have these values; `name` is how errors call it ("cam0").
    ///
    /// # Errors
    /// The first field that is wrong.
    pub fn validate(&self, name: &str) -> Result<(), FieldError> {
        let [w, h] = self.resolution_px;
        if !(16..=32_768).contains(&w) || !(16..=32_768).contains(&h) {
            return Err(FieldError::new(
                format!("{name}.resolution"),
                "[width, height] of 16 to 32768 pixels",
                format!("[{w}, {h}]"),
            ));
        }
        let size = w.max(h) as f64;
        for focal in self.focal_px {
            // From a fisheye of 160 degrees to a telescope of half a degree.
            if !(0.08 * size..=100.0 * size).contains(&focal) {
                return Err(FieldError::new(
                    format!("{name}.intrinsics"),
                    format!(
                        "focal lengths of {:.0} to {:.0} px for this size",
                        0.08 * size,
                        100.0 * size
                    ),
                    format!("{:?}", self.focal_px),
                ));
            }
        }
        let ratio = self.focal_px[0] / self.focal_px[1];
        if !(0.5..=2.0).contains(&ratio) {
            return Err(FieldError::new(
                format!("{name}.intrinsics"),
                "focal lengths fu and fv within a factor of 2",
                format!("{:?}", self.focal_px),
            ));
        }
        for (principal, size) in self.principal_px.into_iter().zip([w as f64, h as f64]) {
            if !(-0.5 * size..=1.5 * size).contains(&principal) {
                return Err(FieldError::new(
                    format!("{name}.intrinsics"),
                    "a principal point [pu, pv] within half an image of the image",
                    format!("{:?}", self.principal_px),
                ));
            }
        }
        if self.radtan.iter().any(|k| !k.is_finite()) {
            return Err(FieldError::new(
                format!("{name}.distortion_coeffs"),
                "finite [k1, k2, p1, p2]",
                format!("{:?}", self.radtan),
            ));
        }
        if self.border_px().any(|pixel| self.normalised_of_pixel(pixel).is_none()) {
            return Err(FieldError::new(
                format!("{name}.distortion_coeffs"),
                "a distortion that is invertible over the whole image",
                format!("{:?}, which folds over inside it", self.radtan),
            ));
        }
        Ok(())
    }
}
