//! Ground truth and images of the scenes against geometry written out independently.

use nalgebra::Vector3;
use stspp_hil_sim::world::{
    BoardTexture, Camera, CameraModel, LightInterval, LightSource, PrimitiveShape, RawImage,
    SceneSpec, SensorModel, World, list_scenes,
};

const EXPOSURE_NS: u64 = 32_000_000;

fn world(scene: &str, options: &[(&str, &str)], model: SensorModel) -> World {
    World::new(&SceneSpec::parse(scene, options).expect("valid scene"), model).expect("valid model")
}

fn on(source: LightSource, on_ns: u64, off_ns: u64) -> LightInterval {
    LightInterval { source, on_ns, off_ns }
}

fn without_noise(mut model: SensorModel) -> SensorModel {
    for camera in [&mut model.left, &mut model.right] {
        camera.read_noise_e = 0.0;
        camera.prnu = 0.0;
    }
    model
}

/// Projection written out from the definition of the radtan model, apart from the code under test.
fn project(camera: &CameraModel, p: &Vector3<f64>) -> [f64; 2] {
    let (x, y) = (p[0] / p[2], p[1] / p[2]);
    let r = x * x + y * y;
    let [k1, k2, p1, p2] = camera.radtan;
    let radial = 1.0 + k1 * r + k2 * r * r;
    let xd = x * radial + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x);
    let yd = y * radial + p1 * (r + 2.0 * y * y) + 2.0 * p2 * x * y;
    [
        camera.focal_px[0] * xd + camera.principal_px[0],
        camera.focal_px[1] * yd + camera.principal_px[1],
    ]
}

/// Distance of `centre` from the segment between `a` and `b`.
fn distance_to_segment(centre: &Vector3<f64>, a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    let t = ((centre - a).dot(&(b - a)) / (b - a).norm_squared()).clamp(0.0, 1.0);
    (a + (b - a) * t - centre).norm()
}

fn sphere(world: &World) -> (Vector3<f64>, f64) {
    world
        .truth()
        .primitives(0)
        .iter()
        .find_map(|p| match p.shape {
            PrimitiveShape::Sphere { centre_left_m, radius_m } => Some((centre_left_m, radius_m)),
            _ => None,
        })
        .expect("a sphere")
}

#[test]
fn the_depth_map_is_the_planes_depth_where_its_points_appear() {
    let model = SensorModel::default().scaled_down(2);
    let rig = model.left_from_rig();
    let camera = model.left.clone();
    let world =
        world("plane", &[("distance_m", "1.3"), ("tilt_deg", "20"), ("turn_deg", "-15")], model);
    let depth = world.truth().depth_m(0);
    // The plane's points in the sensor's frame: tilted about x (upper edge away), then turned
    // about y.
    let (tilt, turn) = (20.0_f64.to_radians(), -15.0_f64.to_radians());
    let mut compared = 0;
    for i in -40..=40 {
        for j in -40..=40 {
            let (a, b) = (0.011 * f64::from(i), 0.011 * f64::from(j));
            let (y, z) = (b * tilt.cos(), -b * tilt.sin());
            let in_rig = Vector3::new(
                a * turn.cos() + z * turn.sin(),
                y,
                1.3 - a * turn.sin() + z * turn.cos(),
            );
            let p = rig.rotation * in_rig + rig.translation.vector;
            let [u, v] = project(&camera, &p);
            if u < 1.0 || v < 1.0 || u > camera.width as f64 - 2.0 || v > camera.height as f64 - 2.0
            {
                continue;
            }
            let at = |x: f64, y: f64| f64::from(depth[y as usize * camera.width + x as usize]);
            let (fu, fv) = (u - u.floor(), v - v.floor());
            let (x, y) = (u.floor(), v.floor());
            let interpolated = (at(x, y) * (1.0 - fu) + at(x + 1.0, y) * fu) * (1.0 - fv)
                + (at(x, y + 1.0) * (1.0 - fu) + at(x + 1.0, y + 1.0) * fu) * fv;
            assert!((interpolated - p.z).abs() < 2e-6, "{u} {v}: {interpolated} {}", p.z);
            compared += 1;
        }
    }
    assert!(compared > 2000, "{compared}");
}

#[test]
fn shadows_and_occlusion_are_where_the_sphere_blocks_the_way() {
    let model = without_noise(SensorModel::default().scaled_down(2));
    let origins = [
        (LightSource::Floodlight, model.floodlight.left_from_floodlight.translation.vector),
        (LightSource::Projector(0), model.projectors[0].left_from_projector.translation.vector),
    ];
    let camera = model.left.clone();
    let right_centre = model.right_from_left.inverse().translation.vector;
    let right_from_left = model.right_from_left;
    let right_camera = model.right.clone();
    let world = world("sphere", &[], model);
    let (centre, radius) = sphere(&world);
    let truth = world.truth();
    let both = truth.visible_to_both(0);
    let (mut shadowed, mut hidden) = (0, 0);
    let images: Vec<_> = origins
        .iter()
        .map(|&(source, _)| {
            world.expose(Camera::Left, 0, EXPOSURE_NS, &[on(source, 0, EXPOSURE_NS)], 1)
        })
        .collect();
    for v in (6..camera.height - 6).step_by(3) {
        for u in (6..camera.width - 6).step_by(3) {
            let direction = camera.ray_direction([u as f64, v as f64]);
            let on_surface =
                truth.surface_along_ray(&Vector3::zeros(), &direction, 0).expect("plane or sphere");
            if world.object_name(on_surface.object) == "sphere" {
                let off = (on_surface.point_left_m - centre).norm() - radius;
                assert!(off.abs() < 1e-12, "{off}");
                continue;
            }
            let p = on_surface.point_left_m;
            // Clear of the boundary by 3 mm either way; what is in between is anti-aliased.
            let clearance = |light: &Vector3<f64>| distance_to_segment(&centre, light, &p) - radius;
            let own = distance_to_segment(&centre, &Vector3::zeros(), &p) - radius;
            if own < 0.003 {
                continue;
            }
            for (image, (source, origin)) in images.iter().zip(&origins) {
                let around = |range: usize| {
                    let mut values = Vec::new();
                    for y in v - range..=v + range {
                        for x in u - range..=u + range {
                            values.push(f64::from(image.data[y * image.width + x]));
                        }
                    }
                    values
                };
                let brightest = around(5).into_iter().fold(0.0, f64::max);
                if clearance(origin) < -0.008 {
                    shadowed += 1;
                    let here = around(0)[0] - camera.black_level_dn;
                    assert!(here < 6.0, "{source:?} {u} {v}: {here} in the shadow");
                } else if clearance(origin) > 0.008 {
                    assert!(brightest > 20.0, "{source:?} {u} {v}: {brightest} in the light");
                }
            }
            let in_right = right_from_left.rotation * p + right_from_left.translation.vector;
            let [ur, vr] = project(&right_camera, &in_right);
            let is_in_image = right_camera.contains([ur, vr]);
            if clearance(&right_centre).abs() > 1e-6 {
                let expected = is_in_image && clearance(&right_centre) > 0.0;
                assert_eq!(both[v * camera.width + u], expected, "{u} {v}");
                hidden += usize::from(is_in_image && !expected);
            }
        }
    }
    assert!(shadowed > 100 && hidden > 300, "{shadowed} {hidden}");
}

#[test]
fn a_moving_plane_is_where_its_speed_has_brought_it_and_blurs_on_the_way() {
    let mut model = without_noise(SensorModel::default().scaled_down(4)).with_bits(12);
    model.ambient_e_per_s = 0.0;
    let rig_z = model.left_from_rig().rotation * Vector3::z();
    let world = world("moving-plane", &[("speed_mm_s", "400")], model);
    let at = |time_ns| match world.truth().primitives(time_ns)[0].shape {
        PrimitiveShape::Plane { point_left_m, .. } => point_left_m,
        other => panic!("{other:?}"),
    };
    let moved = at(1_500_000_000) - at(500_000_000);
    assert!((moved - rig_z * 0.4).norm() < 1e-9, "{moved:?}");
    let ray = Vector3::new(0.05, -0.03, 1.0);
    let hit = |t| world.truth().surface_along_ray(&Vector3::zeros(), &ray, t).expect("the plane");
    let normal = hit(0).normal_left;
    let travelled = (hit(500_000_000).point_left_m - hit(0).point_left_m).dot(&normal);
    assert!((travelled.abs() - 0.2).abs() < 1e-9, "{travelled}");

    // One long exposure is the sum of many short ones.
    let slot = LightSource::Projector(4);
    let long = world.expose(Camera::Left, 0, EXPOSURE_NS, &[on(slot, 0, EXPOSURE_NS)], 1);
    let parts = 16;
    let step = EXPOSURE_NS / parts;
    let black = world.model().left.black_level_dn;
    let mut sum = vec![0.0; long.data.len()];
    for i in 0..parts {
        let (from, to) = (i * step, (i + 1) * step);
        let image = world.expose(Camera::Left, from, to, &[on(slot, from, to)], 100 + i);
        sum.iter_mut().zip(&image.data).for_each(|(s, &v)| *s += f64::from(v) - black);
    }
    let sharp = world.expose(Camera::Left, 0, 1, &[], 5);
    assert!(sharp.data.iter().all(|&v| (f64::from(v) - black).abs() <= 1.0));
    let (mut difference, mut signal) = (0.0, 0.0);
    for (s, &v) in sum.iter().zip(&long.data) {
        difference += (s - (f64::from(v) - black)).powi(2);
        signal += s * s;
    }
    // Shot noise alone is about 2 % here; a plane that stood still would differ by 20 % and more.
    let relative = (difference / signal).sqrt();
    assert!(relative < 0.06, "{relative}");
}

/// Means of blocks of 16 x 16 pixels.
fn block_means(image: &RawImage, black: f64) -> Vec<((usize, usize), f64)> {
    let mut means = Vec::new();
    for v in (0..image.height - 15).step_by(16) {
        for u in (0..image.width - 15).step_by(16) {
            let mut sum = 0.0;
            for y in v..v + 16 {
                for x in u..u + 16 {
                    sum += f64::from(image.data[y * image.width + x]) - black;
                }
            }
            means.push(((u, v), sum / 256.0));
        }
    }
    means
}

#[test]
fn every_projector_covers_the_common_field_and_no_two_look_alike() {
    for distance in ["0.8", "1.3", "2.0"] {
        let model = SensorModel::default().scaled_down(4);
        let black = model.left.black_level_dn;
        let world = world("plane", &[("distance_m", distance)], model);
        let both = world.truth().visible_to_both(0);
        let images: Vec<RawImage> = (0..10)
            .map(|slot| {
                let light = on(LightSource::Projector(slot), 0, EXPOSURE_NS);
                world.expose(Camera::Left, 0, EXPOSURE_NS, &[light], u64::from(slot))
            })
            .collect();
        let width = images[0].width;
        for (slot, image) in images.iter().enumerate() {
            let means = block_means(image, black);
            let is_common = |&((u, v), _): &&((usize, usize), f64)| {
                [0, 15].iter().all(|dy| [0, 15].iter().all(|dx| both[(v + dy) * width + u + dx]))
            };
            let mut common: Vec<f64> = means.iter().filter(is_common).map(|m| m.1).collect();
            common.sort_by(f64::total_cmp);
            let typical = common[common.len() / 2];
            assert!(common.len() > 100 && typical > 5.0);
            assert!(
                common[0] > 0.2 * typical,
                "{distance} m, slot {slot}: {} of {typical}",
                common[0]
            );
        }
        // Correlation over the middle of the image.
        let middle = |image: &RawImage| -> Vec<f64> {
            let mut values = Vec::new();
            for v in 80..176 {
                values.extend((100..220).map(|u| f64::from(image.data[v * width + u])));
            }
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            values.iter_mut().for_each(|v| *v -= mean);
            let norm = values.iter().map(|v| v * v).sum::<f64>().sqrt();
            values.iter().map(|v| v / norm).collect()
        };
        let normed: Vec<_> = images.iter().map(middle).collect();
        for (i, a) in normed.iter().enumerate() {
            for (j, b) in normed[..i].iter().enumerate() {
                let correlation: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
                assert!(correlation.abs() < 0.2, "{distance} m: {i} and {j}: {correlation:.3}");
            }
        }
    }
}

#[test]
fn printed_edges_appear_where_geometry_says() {
    let mut model = without_noise(SensorModel::default()).with_bits(12);
    for camera in [&mut model.left, &mut model.right] {
        camera.principal_px[0] -= 440.0;
        camera.principal_px[1] -= 412.0;
        (camera.width, camera.height) = (400, 200);
    }
    let rig = model.left_from_rig();
    let camera = model.left.clone();
    let rig_from_board =
        nalgebra::Isometry3::new(Vector3::new(0.003, -0.002, 1.0), Vector3::new(0.25, -0.2, 0.05));
    let spec = SceneSpec::board(BoardTexture::chessboard(8, 6, 0.04), rig_from_board);
    let world = World::new(&spec, model).expect("valid");
    let flood = on(LightSource::Floodlight, 0, EXPOSURE_NS);
    let image = world.expose(Camera::Left, 0, EXPOSURE_NS, &[flood], 1);
    // Along the vertical edge x = 0, at points away from corners: where a row crosses the middle
    // between dark and bright.
    let mut errors = Vec::new();
    for k in -60..=60 {
        let along = 0.0011 * f64::from(k);
        let from_corner = (along / 0.04 - (along / 0.04).round()).abs() * 0.04;
        if from_corner < 0.006 {
            continue;
        }
        let in_rig = rig_from_board.rotation * Vector3::new(0.0, along, 0.0)
            + rig_from_board.translation.vector;
        let p = rig.rotation * in_rig + rig.translation.vector;
        let [u, v] = project(&camera, &p);
        let row = v.round();
        if !(2.0..=197.0).contains(&row) || !(20.0..380.0).contains(&u) {
            continue;
        }
        // The edge's place in this row: along its slope in the image.
        let step = rig_from_board.rotation * Vector3::new(0.0, 1e-4, 0.0);
        let q = p + rig.rotation * step;
        let [u2, v2] = project(&camera, &q);
        let predicted = u + (row - v) * (u2 - u) / (v2 - v);
        let line = &image.data[row as usize * 400..][..400];
        let start = (predicted - 6.0).floor() as usize;
        let (a, b) = (f64::from(line[start]), f64::from(line[start + 12]));
        // First moment of the derivative: exact for any symmetric blur.
        let sum: f64 = (start..start + 12).map(|i| f64::from(line[i])).sum();
        let found = start as f64 - 0.5 + (sum - 12.0 * b) / (a - b);
        errors.push(found - predicted);
    }
    assert!(errors.len() > 30, "{}", errors.len());
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let spread =
        (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / errors.len() as f64).sqrt();
    println!("{} crossings: mean {mean:.4}, spread {spread:.4} px", errors.len());
    assert!(mean.abs() < 0.03 && spread < 0.12, "{mean} {spread}");
}

#[test]
fn every_scene_renders_on_every_sensor() {
    let models = [
        SensorModel::default().scaled_down(8),
        SensorModel::perturbed(3).scaled_down(8),
        SensorModel::alternate(4).scaled_down(8),
    ];
    for info in list_scenes().iter().filter(|s| s.name != "mesh") {
        for model in &models {
            let world = world(info.name, &[], model.clone());
            let light = on(LightSource::Projector(6), 0, EXPOSURE_NS);
            let (left, right) = world.expose_pair(0, EXPOSURE_NS, &[light], 1);
            for image in [&left, &right] {
                let lit = image.data.iter().filter(|&&v| v > 20).count();
                assert!(lit > image.data.len() / 100, "{}: {lit} pixels lit", info.name);
            }
            let depth = world.truth().depth_m(0);
            let both = world.truth().visible_to_both(0);
            let seen = both.iter().filter(|b| **b).count();
            assert!(seen > both.len() / 10, "{}: {seen} pixels in common", info.name);
            assert!(depth.iter().zip(&both).all(|(z, both)| !both || (0.3..6.0).contains(z)));
        }
    }
}

#[test]
fn impossible_sensors_are_refused_with_the_reason() {
    let refused = |change: fn(&mut SensorModel)| {
        let mut model = SensorModel::default();
        change(&mut model);
        let spec = SceneSpec::parse("plane", &[]).expect("valid");
        World::new(&spec, model).expect_err("refused").to_string()
    };
    assert!(refused(|m| m.left.bits = 9).contains("9 bits"));
    assert!(refused(|m| m.right.full_well_e = -1.0).contains("right"));
    assert!(refused(|m| m.left.focal_px[0] = f64::NAN).contains("focal"));
    assert!(refused(|m| m.right_from_left.translation.vector *= 0.0).contains("same place"));
    assert!(refused(|m| m.projectors[3].doe_orders = [-1, 2]).contains("projector 3"));
}
