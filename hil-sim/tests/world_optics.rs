//! The virtual sensor against physics and against its own stated defaults.

use nalgebra::Vector3;
use stspp_hil_sim::world::{
    Camera, CameraModel, LightInterval, LightSource, RawImage, SceneSpec, SensorModel, World,
};

/// The exposure at which the default sensor is stated.
const EXPOSURE_NS: u64 = 32_000_000;

/// The default sensor with both images cut to their middle, for speed.
fn cropped(width: usize, height: usize) -> SensorModel {
    let mut model = SensorModel::default();
    for camera in [&mut model.left, &mut model.right] {
        camera.principal_px[0] -= (camera.width - width) as f64 / 2.0;
        camera.principal_px[1] -= (camera.height - height) as f64 / 2.0;
        (camera.width, camera.height) = (width, height);
    }
    model
}

fn without_noise(mut model: SensorModel) -> SensorModel {
    for camera in [&mut model.left, &mut model.right] {
        camera.read_noise_e = 0.0;
        camera.prnu = 0.0;
    }
    model
}

fn world(scene: &str, options: &[(&str, &str)], model: SensorModel) -> World {
    World::new(&SceneSpec::parse(scene, options).expect("valid scene"), model).expect("valid model")
}

fn projector(slot: u8, on_ns: u64, off_ns: u64) -> LightInterval {
    LightInterval { source: LightSource::Projector(slot), on_ns, off_ns }
}

/// Numbers above black, in electrons.
fn electrons(image: &RawImage, camera: &CameraModel) -> Vec<f64> {
    image
        .data
        .iter()
        .map(|&v| (f64::from(v) - camera.black_level_dn) / camera.gain_dn_per_e)
        .collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Full width at half maximum of isolated dots, from the second moments of their cores: the width
/// of the Gaussian through a dot's peak pixel and its four neighbours.
fn dots(image: &RawImage, black: f64) -> (Vec<f64>, Vec<f64>) {
    let w = image.width;
    let at = |u: usize, v: usize| f64::from(image.data[v * w + u]) - black;
    let (mut widths, mut peaks) = (Vec::new(), Vec::new());
    for v in 4..image.height - 4 {
        for u in 4..w - 4 {
            let p = at(u, v);
            let is_peak =
                (v - 1..=v + 1).all(|y| (u - 1..=u + 1).all(|x| (x, y) == (u, v) || at(x, y) < p));
            if p < 60.0 || !is_peak {
                continue;
            }
            // Curvature of the logarithm at the peak: -1/sigma^2 for a Gaussian, averaged over axes.
            let ln = |x: usize, y: usize| at(x, y).max(1.0).ln();
            let cx = ln(u - 1, v) + ln(u + 1, v) - 2.0 * ln(u, v);
            let cy = ln(u, v - 1) + ln(u, v + 1) - 2.0 * ln(u, v);
            let sigma2 = -2.0 / (cx + cy);
            // The sub-pixel peak of a separable Gaussian.
            let shift = |m: f64, p: f64, c: f64| (m - p) / (2.0 * c);
            let sx = shift(ln(u - 1, v), ln(u + 1, v), cx);
            let sy = shift(ln(u, v - 1), ln(u, v + 1), cy);
            peaks.push(p * (0.5 * (sx * sx * -cx + sy * sy * -cy)).exp());
            widths.push(2.354_82 * sigma2.sqrt());
        }
    }
    (widths, peaks)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn dots_at_one_metre_are_no_kinder_than_stated() {
    let model = cropped(320, 256);
    let black = model.left.black_level_dn;
    let world = world("plane", &[("distance_m", "1.0")], model);
    for slot in [0, 4, 9] {
        let light = projector(slot, 0, EXPOSURE_NS);
        let image = world.expose(Camera::Left, 0, EXPOSURE_NS, &[light], u64::from(slot));
        let (widths, peaks) = dots(&image, black);
        let (count, width, peak) = (widths.len(), median(widths), median(peaks));
        let lit = image.data.iter().filter(|&&v| f64::from(v) - black > 0.5 * peak).count() as f64
            / image.data.len() as f64;
        let clipped =
            image.data.iter().filter(|&&v| v == 255).count() as f64 / image.data.len() as f64;
        println!(
            "slot {slot}: {count} dots, {width:.2} px, peak {peak:.0}, lit {lit:.3}, clipped {clipped:.4}"
        );
        assert!((2.5..=3.5).contains(&width), "slot {slot}: dots of {width:.2} px");
        assert!((170.0..=205.0).contains(&peak), "slot {slot}: peaks of {peak:.0} DN");
        assert!((0.23..=0.31).contains(&lit), "slot {slot}: {lit:.3} of the area is lit");
        assert!(clipped < 0.02, "slot {slot}: {clipped:.4} of the pixels are full");
    }
}

#[test]
fn the_signal_is_linear_in_gate_time_and_counts_only_the_overlap() {
    let model = without_noise(cropped(96, 64)).with_bits(12);
    let camera = model.left.clone();
    let mut dark = model.clone();
    dark.ambient_e_per_s = 0.0;
    let world = world("plane", &[], dark);
    let ms = 1_000_000;
    let signal = |lights: &[LightInterval]| {
        mean(&electrons(&world.expose(Camera::Left, 20 * ms, 40 * ms, lights, 3), &camera))
    };
    let whole = signal(&[projector(2, 0, 100 * ms)]);
    assert!(whole > 300.0, "{whole}");
    let close = |a: f64, b: f64| assert!((a - b).abs() < 0.01 * whole, "{a} {b} of {whole}");
    close(signal(&[projector(2, 20 * ms, 30 * ms)]), 0.5 * whole);
    // A gate that opens before and closes after the exposure's start.
    close(signal(&[projector(2, 10 * ms, 25 * ms)]), 0.25 * whole);
    close(signal(&[projector(2, 35 * ms, 90 * ms)]), 0.25 * whole);
    // Outside, backwards, and a projector that is not there: dark.
    close(signal(&[projector(2, 40 * ms, 60 * ms)]), 0.0);
    close(signal(&[projector(2, 0, 20 * ms)]), 0.0);
    close(signal(&[projector(2, 38 * ms, 22 * ms)]), 0.0);
    close(signal(&[projector(200, 20 * ms, 40 * ms)]), 0.0);
    // Two lights at once add up.
    let one = signal(&[projector(1, 20 * ms, 30 * ms)]);
    let other = signal(&[projector(7, 25 * ms, 40 * ms)]);
    close(signal(&[projector(1, 20 * ms, 30 * ms), projector(7, 25 * ms, 40 * ms)]), one + other);
}

#[test]
fn noise_is_photon_noise_with_the_stated_gain_and_read_noise() {
    let mut model = cropped(200, 150).with_bits(12);
    for camera in [&mut model.left, &mut model.right] {
        camera.prnu = 0.0;
    }
    let cameras = [(Camera::Left, model.left.clone()), (Camera::Right, model.right.clone())];
    let world = world("plane", &[], model);
    let flood = LightInterval { source: LightSource::Floodlight, on_ns: 0, off_ns: EXPOSURE_NS };
    for (camera, m) in cameras {
        // Mean and variance of differences of two frames, over exposures: slope is the gain, the
        // intercept the read noise and the rounding.
        let points: Vec<(f64, f64)> = [0, 1, 2, 4, 8, 16, 32]
            .iter()
            .map(|ms| {
                let close = ms * 1_000_000;
                let frame = |seed| world.expose(camera, 0, close, &[flood], seed);
                let (a, b) = (frame(2 * ms), frame(2 * ms + 1));
                let n = a.data.len() as f64;
                let sum: f64 = a.data.iter().zip(&b.data).map(|(x, y)| f64::from(x + y)).sum();
                let var: f64 = a
                    .data
                    .iter()
                    .zip(&b.data)
                    .map(|(&x, &y)| (f64::from(x) - f64::from(y)).powi(2))
                    .sum();
                (sum / (2.0 * n) - m.black_level_dn, var / (2.0 * n))
            })
            .collect();
        let brightest = points[points.len() - 1];
        assert!(brightest.0 / m.gain_dn_per_e > 2000.0, "{points:?}");
        let slope = (brightest.1 - points[0].1) / (brightest.0 - points[0].0);
        assert!((slope / m.gain_dn_per_e - 1.0).abs() < 0.03, "{camera:?}: gain {slope}");
        let read_e = (points[0].1 - 1.0 / 12.0).sqrt() / m.gain_dn_per_e;
        assert!((read_e - m.read_noise_e).abs() < 0.1, "{camera:?}: read noise {read_e}");
        for (mean_dn, variance) in &points {
            let expected = m.gain_dn_per_e * mean_dn + points[0].1;
            assert!((variance / expected - 1.0).abs() < 0.05, "{camera:?} {mean_dn}: {variance}");
        }
    }
}

#[test]
fn a_full_pixel_reads_the_full_well_and_bit_depths_agree() {
    let model = cropped(64, 48);
    let flood = LightInterval { source: LightSource::Floodlight, on_ns: 0, off_ns: 1_000_000_000 };
    for (bits, top) in [(8, 255.0_f64), (10, 1023.0), (12, 4095.0)] {
        let model = model.clone().with_bits(bits);
        let camera = model.right.clone();
        let world = world("plane", &[], model);
        let image = world.expose(Camera::Right, 0, 1_000_000_000, &[flood], 1);
        let expected = (camera.full_well_e * camera.gain_dn_per_e + camera.black_level_dn).min(top);
        assert!(image.data.iter().all(|&v| (f64::from(v) - expected).abs() <= 0.5 + 1e-6));
        let image = world.expose(Camera::Right, 0, 10_000_000, &[flood], 1);
        let level = image.data.iter().map(|&v| f64::from(v)).sum::<f64>() / image.data.len() as f64;
        assert!((level / top - 0.19).abs() < 0.08, "{bits} bits: {}", level / top);
    }
}

#[test]
fn images_depend_on_the_seeds_and_on_nothing_else() {
    let render = |threads: usize, frame_seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let world = world("sphere", &[], SensorModel::default().scaled_down(8));
            world.expose_pair(0, EXPOSURE_NS, &[projector(5, 0, EXPOSURE_NS)], frame_seed)
        })
    };
    let one = render(1, 7);
    assert_eq!(one, render(3, 7));
    let other = render(2, 8);
    assert_ne!(one.0, other.0);
    assert_ne!(one.0.data, one.1.data);
}

/// Projection written out from the definition of the radtan model, apart from the code under test.
fn project(camera: &CameraModel, p: &Vector3<f64>) -> [f64; 2] {
    let (x, y) = (p[0] / p[2], p[1] / p[2]);
    let r = x * x + y * y;
    let [k1, k2, p1, p2] = camera.radtan;
    let xd = x * (1.0 + k1 * r + k2 * r * r) + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x);
    let yd = y * (1.0 + k1 * r + k2 * r * r) + p1 * (r + 2.0 * y * y) + 2.0 * p2 * x * y;
    [
        camera.focal_px[0] * xd + camera.principal_px[0],
        camera.focal_px[1] * yd + camera.principal_px[1],
    ]
}

#[test]
fn every_dot_appears_where_geometry_says() {
    // One projector with few, well separated dots, a tilted plane, both full-size cameras.
    let mut model = without_noise(SensorModel::default()).with_bits(12);
    for p in &mut model.projectors {
        p.emitters = 9;
        p.dot_divergence_rad = 9e-4;
    }
    let directions = model.projectors[3].dot_directions();
    let pose = model.projectors[3].left_from_projector;
    let right_from_left = model.right_from_left;
    let cameras = [model.left.clone(), model.right.clone()];
    let world = world("plane", &[("tilt_deg", "12"), ("turn_deg", "-9")], model);
    let (left, right) = world.expose_pair(0, EXPOSURE_NS, &[projector(3, 0, EXPOSURE_NS)], 1);
    let mut errors = Vec::new();
    for [x, y] in directions {
        let direction = pose.rotation * Vector3::new(x, y, (1.0 - x * x - y * y).sqrt());
        let origin = pose.translation.vector;
        let hit = world.truth().surface_along_ray(&origin, &direction, 0).expect("the plane");
        let in_left = hit.point_left_m;
        let in_right = right_from_left.rotation * in_left + right_from_left.translation.vector;
        for (image, camera, point) in
            [(&left, &cameras[0], in_left), (&right, &cameras[1], in_right)]
        {
            let [u, v] = project(camera, &point);
            let (cu, cv) = (u.round(), v.round());
            let border = 8.0;
            if cu < border || cv < border || cu + border >= 1280.0 || cv + border >= 1024.0 {
                continue;
            }
            // Centroid over a window that holds this dot alone; its centre is the image's.
            let (mut sum, mut su, mut sv) = (0.0, 0.0, 0.0);
            for dv in -7..=7 {
                for du in -7..=7 {
                    let (x, y) = (cu + f64::from(du), cv + f64::from(dv));
                    let pixel = image.data[y as usize * 1280 + x as usize];
                    let value = f64::from(pixel) - camera.black_level_dn;
                    let distance2 = (x - u).powi(2) + (y - v).powi(2);
                    // A weight about the predicted place halves a centroid's offset, no more.
                    let weight = value * (-distance2 / 18.0).exp();
                    sum += weight;
                    su += weight * (x - u);
                    sv += weight * (y - v);
                }
            }
            if sum > 500.0 {
                errors.push([su / sum, sv / sum]);
            }
        }
    }
    assert!(errors.len() > 500, "{} dots", errors.len());
    let [mu, mv] = [0, 1].map(|k| mean(&errors.iter().map(|e| e[k]).collect::<Vec<_>>()));
    // Neighbouring dots pull single centroids; on average and for the median nothing may be off.
    let typical = median(errors.iter().map(|e| e[0].hypot(e[1])).collect());
    println!("{} dots: mean {mu:.4} {mv:.4} px, median {typical:.4} px", errors.len());
    assert!(mu.abs() < 0.01 && mv.abs() < 0.01, "mean offset {mu:.4} {mv:.4} px");
    assert!(typical < 0.05, "median offset {typical:.4} px");
}
