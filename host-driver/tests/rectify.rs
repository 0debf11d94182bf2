//! Rectification against the optics written out in f64.

mod common;

use common::{Random, inside, raw_pixel, rig, undistorted};
use nalgebra::{Point3, Vector3};
use stspp::rectify::{Canvas, DepthRange, Kernel, Rectifier, RectifyScratch};
use stspp::{RawImage, RectifiedGeometry, StereoCalibration};
use stspp_matcher::Image;

/// Points of the left camera's frame that both cameras see, with z in `depth`.
fn shared_points(
    calibration: &StereoCalibration,
    depth: DepthRange,
    count: usize,
) -> Vec<Point3<f64>> {
    let mut random = Random(7);
    let mut points = Vec::new();
    while points.len() < count {
        let z = random.range(depth.min_m, depth.max_m);
        let p = Point3::new(random.range(-0.4, 0.4) * z, random.range(-0.35, 0.35) * z, z);
        let q = calibration.right_from_left * p;
        if inside(&calibration.left, raw_pixel(&calibration.left, p))
            && inside(&calibration.right, raw_pixel(&calibration.right, q))
        {
            points.push(p);
        }
    }
    points
}

/// Position on a rectified canvas of what a camera sees at `pixel`: undistort, rotate, project.
fn canvas_position(
    geometry: &RectifiedGeometry,
    calibration: &StereoCalibration,
    right: bool,
    pixel: [f64; 2],
) -> [f64; 2] {
    let camera = if right { &calibration.right } else { &calibration.left };
    let [x, y] = undistorted(camera, pixel);
    let mut ray = Vector3::new(x, y, 1.0);
    if right {
        ray = calibration.right_from_left.rotation.inverse() * ray;
    }
    let ray = geometry.rect_from_left * ray;
    let cx = if right { geometry.cx_right_px } else { geometry.cx_left_px };
    [geometry.focal_px * ray.x / ray.z + cx, geometry.focal_px * ray.y / ray.z + geometry.cy_px]
}

#[test]
fn rows_correspond_and_disparity_gives_the_point() {
    let calibration = rig();
    let depth = DepthRange::default();
    let rectifier = Rectifier::new(&calibration, depth).unwrap();
    let geometry = rectifier.geometry();
    let range = rectifier.disparity_range();
    for p in shared_points(&calibration, depth, 2000) {
        let q = calibration.right_from_left * p;
        let left_px = raw_pixel(&calibration.left, p);
        let right_px = raw_pixel(&calibration.right, q);
        let [xl, yl] = canvas_position(geometry, &calibration, false, left_px);
        let [xr, yr] = canvas_position(geometry, &calibration, true, right_px);
        assert!((yl - yr).abs() < 1e-6, "rows {yl} and {yr}");
        let disparity = xl - xr;
        let back = geometry.point_left_m(xl, yl, disparity).unwrap();
        assert!((back - p).norm() < 1e-9, "{p} came back as {back}");
        assert!((geometry.depth_left_m(xl, yl, disparity).unwrap() - p.z).abs() < 1e-9);
        let (x, y, d) = geometry.project_left_m(&p).unwrap();
        assert!((x - xl).abs() + (y - yl).abs() + (d - disparity).abs() < 1e-6);
        assert!(f64::from(range.min_px) < disparity && disparity < f64::from(range.max_px));
    }
}

#[test]
fn no_pixel_that_both_cameras_see_is_lost() {
    let calibration = rig();
    let depth = DepthRange::default();
    let rectifier = Rectifier::new(&calibration, depth).unwrap();
    let geometry = rectifier.geometry();
    let mut at_border = 0;
    for p in shared_points(&calibration, depth, 20_000) {
        let (x, y, d) = geometry.project_left_m(&p).unwrap();
        let (w, h) = ((geometry.width - 1) as f64, (geometry.height - 1) as f64);
        assert!((0.0..=w).contains(&x) && (0.0..=w).contains(&(x - d)), "column {x}, {}", x - d);
        assert!((0.0..=h).contains(&y), "row {y}");
        // All four neighbours of a point inside both images are valid, but for those beyond the
        // image's border.
        let left_px = raw_pixel(&calibration.left, p);
        let deep = |px: [f64; 2]| px[0].min(px[1]).min(1279.0 - px[0]).min(1023.0 - px[1]) > 1.5;
        let seen = |mask: &Image<u8>, x: f64, y: f64| {
            mask.get(x as usize, y as usize) != Some(0)
                && mask.get(x as usize + 1, y as usize + 1) != Some(0)
        };
        if deep(left_px) {
            assert!(seen(rectifier.left_mask(), x, y));
        } else {
            at_border += 1;
        }
        if deep(raw_pixel(&calibration.right, calibration.right_from_left * p)) {
            assert!(seen(rectifier.right_mask(), x - d, y));
        }
    }
    assert!(at_border > 20, "the sample must reach the border");
    // And the canvases are not much larger than the images.
    assert!(geometry.width < 1400 && geometry.height < 1150, "{geometry:?}");
}

#[test]
fn the_sensors_own_size_is_the_middle_of_the_whole() {
    let (calibration, depth) = (rig(), DepthRange::default());
    let whole = Rectifier::new(&calibration, depth).unwrap();
    let part = Rectifier::with_canvas(&calibration, depth, Canvas::Sensor).unwrap();
    let (a, b) = (whole.geometry(), part.geometry());
    assert_eq!([b.width, b.height], calibration.left.resolution_px);
    let [dx, dy] = [a.cx_left_px - b.cx_left_px, a.cy_px - b.cy_px];
    // Margins are equal but for the columns that make rows of whole vectors.
    assert!((dx - 0.5 * (a.width - b.width) as f64).abs() <= 17.0, "{dx}");
    assert!((dy - 0.5 * (a.height - b.height) as f64).abs() <= 2.0, "{dy}");
    let dots = raw_dots(&Dots::new(1.0));
    let mut scratch = RectifyScratch::default();
    let (mut all, mut some) = (whole.canvas(), part.canvas());
    whole.rectify_left(&dots, &mut all, &mut scratch).unwrap();
    part.rectify_left(&dots, &mut some, &mut scratch).unwrap();
    let at = |y: usize| &all.row(y + dy as usize)[dx as usize..][..b.width];
    assert!((0..b.height).all(|y| some.row(y) == at(y)));
    let p = Point3::new(0.02, -0.03, 0.9);
    let ((x, y, d), (u, v, e)) = (a.project_left_m(&p).unwrap(), b.project_left_m(&p).unwrap());
    assert!((x - dx - u).abs() + (y - dy - v).abs() + (d - e).abs() < 1e-9);
}

#[test]
fn the_disparity_range_holds_a_tilted_plane_at_the_far_end() {
    let calibration = rig();
    let rectifier = Rectifier::new(&calibration, DepthRange::default()).unwrap();
    let (geometry, range) = (rectifier.geometry(), rectifier.disparity_range());
    for (y, x) in [(0, 0), (0, 1279), (1023, 0), (1023, 1279), (512, 640)] {
        let [rx, ry] = undistorted(&calibration.left, [f64::from(x), f64::from(y)]);
        // The plane z = 2 + tan(20 deg) x through the middle of the far end.
        for tilt in [-20_f64, 20.0] {
            let z = 2.0 / (1.0 - tilt.to_radians().tan() * (rx + 0.176));
            let p = Point3::new(rx * z, ry * z, z);
            let q = calibration.right_from_left * p;
            if inside(&calibration.right, raw_pixel(&calibration.right, q)) {
                let (_, _, d) = geometry.project_left_m(&p).unwrap();
                assert!(
                    f64::from(range.min_px) < d && d < f64::from(range.max_px),
                    "{d} {range:?}"
                );
            }
        }
    }
}

/// Random Gaussian dots, evaluated anywhere.
struct Dots {
    cells: Vec<Vec<(f64, f64, f64)>>,
    sigma: f64,
}

const CELL: f64 = 16.0;
const CELLS: usize = 84;

impl Dots {
    fn new(sigma: f64) -> Self {
        let mut random = Random(3);
        let mut cells = vec![Vec::new(); CELLS * CELLS];
        for _ in 0..28_000 {
            let (x, y) = (random.range(-16.0, 1312.0), random.range(-16.0, 1056.0));
            let cell = ((y + CELL) / CELL) as usize * CELLS + ((x + CELL) / CELL) as usize;
            cells[cell].push((x, y, random.range(60.0, 140.0)));
        }
        Self { cells, sigma }
    }

    fn at(&self, x: f64, y: f64) -> f64 {
        let (cx, cy) = (((x + CELL) / CELL) as usize, ((y + CELL) / CELL) as usize);
        let mut sum = 10.0;
        for row in cy.saturating_sub(1)..=(cy + 1).min(CELLS - 1) {
            for column in cx.saturating_sub(1)..=(cx + 1).min(CELLS - 1) {
                for &(dx, dy, peak) in &self.cells[row * CELLS + column] {
                    let r2 = (x - dx).powi(2) + (y - dy).powi(2);
                    sum += peak * (-0.5 * r2 / (self.sigma * self.sigma)).exp();
                }
            }
        }
        sum
    }
}

/// The dots as a camera of 14 bits sees them.
fn raw_dots(dots: &Dots) -> RawImage {
    let full = f64::from((1 << 14) - 1);
    let raw = (0..1024)
        .flat_map(|y| (0..1280).map(move |x| (x, y)))
        .map(|(x, y)| (dots.at(f64::from(x), f64::from(y)) / 1200.0 * full).round() as u16)
        .collect();
    RawImage::gray16(Image::from_vec(1280, 1024, raw).unwrap(), 14)
}

/// RMS error, in percent of the picture's standard deviation, of rectified dots against the same dots
/// evaluated where the optics put each canvas pixel.
fn resampling_rms(kernel: Kernel, dots: &Dots, raw: &RawImage) -> f64 {
    let calibration = rig();
    let depth = DepthRange::default();
    let rectifier = Rectifier::with_kernel(&calibration, depth, kernel).unwrap();
    let geometry = rectifier.geometry();
    let mut out = rectifier.canvas();
    rectifier.rectify_right(raw, &mut out, &mut RectifyScratch::default()).unwrap();
    let (mut error, mut sum, mut sum2, mut count) = (0.0, 0.0, 0.0, 0.0);
    let left_from_right = calibration.right_from_left.rotation.inverse();
    for v in (8..geometry.height - 8).step_by(7) {
        for u in (8..geometry.width - 8).step_by(3) {
            let ray = Vector3::new(
                (u as f64 - geometry.cx_right_px) / geometry.focal_px,
                (v as f64 - geometry.cy_px) / geometry.focal_px,
                1.0,
            );
            let ray = left_from_right.inverse() * (geometry.rect_from_left.inverse() * ray);
            let [x, y] = raw_pixel(&calibration.right, Point3::from(ray));
            if !(6.0..1274.0).contains(&x) || !(6.0..1018.0).contains(&y) {
                continue;
            }
            let expected = dots.at(x, y) * 255.0 / 1200.0;
            error += (f64::from(out.get(u, v).unwrap()) / 64.0 - expected).powi(2);
            sum += expected;
            sum2 += expected * expected;
            count += 1.0;
        }
    }
    assert!(count > 40_000.0);
    100.0 * (error / (sum2 - sum * sum / count)).sqrt()
}

/// What is left at the sharpest dots is aliasing, which no kernel of 8 taps avoids; real dots have a
/// sigma of 1.2 px or more. The comparison is printed (`--nocapture`).
#[test]
fn resampling_costs_a_fraction_of_a_percent_of_the_contrast() {
    println!("RMS in percent of the contrast, dots of sigma 0.75, 0.9, 1.1, 1.3 px");
    let pictures = [0.75, 0.9, 1.1, 1.3].map(|sigma| {
        let dots = Dots::new(sigma);
        let raw = raw_dots(&dots);
        (dots, raw)
    });
    let mut default_rms = Vec::new();
    for kernel in [Kernel::Linear, Kernel::Keys, Kernel::Lanczos4, Kernel::KaiserSinc] {
        let rms = pictures.each_ref().map(|(dots, raw)| resampling_rms(kernel, dots, raw));
        println!("{kernel:?}: {rms:.2?}");
        if kernel == Kernel::default() {
            default_rms = rms.to_vec();
        }
    }
    for (rms, limit) in default_rms.into_iter().zip([6.5, 2.5, 0.7, 0.4]) {
        assert!(rms < limit, "{rms} > {limit}");
    }
}

#[test]
fn every_bit_depth_has_the_same_scale() {
    let rectifier = Rectifier::new(&rig(), DepthRange::default()).unwrap();
    let mut scratch = RectifyScratch::default();
    for bits in [8_u8, 10, 12, 14, 16] {
        let value = u16::MAX >> (17 - bits);
        let raw = if bits == 8 {
            RawImage::gray8(Image::new(1280, 1024, value as u8))
        } else {
            RawImage::gray16(Image::new(1280, 1024, value), bits)
        };
        let expected = f64::from(value) / f64::from(raw.full_scale()) * 255.0 * 64.0;
        let mut out = rectifier.canvas();
        rectifier.rectify_left(&raw, &mut out, &mut scratch).unwrap();
        for &sample in out.as_slice() {
            assert!(
                (f64::from(sample) - expected).abs() <= 2.0,
                "{bits} bits: {sample}, {expected}"
            );
        }
    }
}

#[test]
fn another_image_size_is_an_error() {
    let rectifier = Rectifier::new(&rig(), DepthRange::default()).unwrap();
    let raw = RawImage::gray8(Image::new(640, 512, 0));
    let mut out = rectifier.canvas();
    let error = rectifier.rectify_left(&raw, &mut out, &mut RectifyScratch::default()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "left image: expected 1280 x 1024 px as in the calibration, got 640 x 512"
    );
}
