//! Recordings written by a plain independent program, right and wrong ones.

mod common;

use std::f64::consts::TAU;
use std::path::Path;

use common::{Folder, Random, undistorted};
use nalgebra::{Point3, Vector3};
use proptest::prelude::*;
use stspp::reconstruct::{Options, ReconstructError, reconstruct};
use stspp::recording::labels;
use stspp::{CameraIntrinsics, Recording, SlotLabel};
use stspp_matcher::Method;

const WIDTH: usize = 320;
const HEIGHT: usize = 256;

/// What the independent program writes beside its images.
const CAMCHAIN: &str = "\
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.05, 0.02, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [465.0, 464.0, 160.5, 127.0]
  resolution: [320, 256]
cam1:
  T_cn_cnm1:
  - [0.9961946981, 0.0, 0.0871557427, -0.0996194698]
  - [0.0, 1.0, 0.0, 0.0]
  - [-0.0871557427, 0.0, 0.9961946981, 0.0087155743]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.06, 0.03, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [463.0, 464.5, 158.0, 129.5]
  resolution: [320, 256]
";

/// Distance of the recorded plane z = DISTANCE + SLOPE x.
const DISTANCE: f64 = 1.0;
const SLOPE: f64 = 0.15;

/// A band-limited random texture: waves of many directions and 7-16 mm, some 4-8 px.
struct Texture(Vec<[f64; 4]>);

impl Texture {
    fn new(seed: u64) -> Self {
        let mut random = Random(seed);
        let waves = (0..40).map(|_| {
            let (angle, length) = (random.range(0.0, TAU), random.range(0.008, 0.016));
            let k = TAU / length;
            [k * angle.cos(), k * angle.sin(), random.range(0.0, TAU), random.range(0.5, 1.0)]
        });
        Self(waves.collect())
    }

    fn at(&self, x: f64, y: f64) -> f64 {
        let sum: f64 = self.0.iter().map(|[kx, ky, p, a]| a * (kx * x + ky * y + p).sin()).sum();
        (110.0 + 22.0 * sum).clamp(0.0, 255.0)
    }
}

/// One camera's picture of the textured plane.
fn picture(
    camera: &CameraIntrinsics,
    right: Option<&stspp::StereoCalibration>,
    t: &Texture,
) -> Vec<u8> {
    let left_from_camera = right.map(|c| c.right_from_left.inverse());
    let mut pixels = Vec::with_capacity(WIDTH * HEIGHT);
    for v in 0..HEIGHT {
        for u in 0..WIDTH {
            let [x, y] = undistorted(camera, [u as f64, v as f64]);
            let (mut origin, mut ray) = (Point3::origin(), Vector3::new(x, y, 1.0));
            if let Some(pose) = &left_from_camera {
                (origin, ray) = (pose * origin, pose * ray);
            }
            // origin.z + s ray.z = DISTANCE + SLOPE (origin.x + s ray.x)
            let s = (DISTANCE + SLOPE * origin.x - origin.z) / (ray.z - SLOPE * ray.x);
            let p = origin + ray * s;
            pixels.push(t.at(p.x, p.y).round() as u8);
        }
    }
    pixels
}

fn write_png(path: &Path, color: png::ColorType, depth: png::BitDepth, data: &[u8]) {
    write_png_sized(path, (WIDTH, HEIGHT), color, depth, data);
}

fn write_png_sized(
    path: &Path,
    size: (usize, usize),
    color: png::ColorType,
    depth: png::BitDepth,
    data: &[u8],
) {
    let file = std::fs::File::create(path).unwrap();
    let mut encoder = png::Encoder::new(file, size.0 as u32, size.1 as u32);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.write_header().unwrap().write_image_data(data).unwrap();
}

/// Writes a recording of `frames` pairs; 16-bit images hold 10 bits.
fn record(folder: &Folder, frames: usize, sixteen: bool) {
    for side in ["left", "right"] {
        std::fs::create_dir_all(folder.path(side)).unwrap();
    }
    std::fs::write(folder.path("camchain.yaml"), CAMCHAIN).unwrap();
    let calibration = stspp::StereoCalibration::read(folder.path("camchain.yaml")).unwrap();
    for k in 0..frames {
        let texture = Texture::new(k as u64);
        for (side, pixels) in [
            ("left", picture(&calibration.left, None, &texture)),
            ("right", picture(&calibration.right, Some(&calibration), &texture)),
        ] {
            let path = folder.path(&format!("{side}/{k:02}.png"));
            if sixteen {
                let wide: Vec<u8> =
                    pixels.iter().flat_map(|v| (u16::from(*v) * 4).to_be_bytes()).collect();
                write_png(&path, png::ColorType::Grayscale, png::BitDepth::Sixteen, &wide);
            } else {
                write_png(&path, png::ColorType::Grayscale, png::BitDepth::Eight, &pixels);
            }
        }
    }
}

fn options(method: Method) -> Options {
    Options { method, depth: stspp::DepthRange { min_m: 0.85, max_m: 1.2 }, ..Options::default() }
}

#[test]
fn a_foreign_recording_reconstructs() {
    let folder = Folder::new("foreign");
    for sixteen in [false, true] {
        record(&folder, 4, sixteen);
        let recording = Recording::open(folder.path("")).unwrap();
        assert_eq!((recording.len(), recording.bits()), (4, if sixteen { 10 } else { 8 }));
        let result = reconstruct(&recording, &options(Method::IcGn), &mut |_| {}).unwrap();
        let cloud = result.frame.point_cloud();
        assert!(cloud.len() > WIDTH * HEIGHT / 2, "{} points", cloud.len());
        let mut errors: Vec<f64> = cloud
            .points_left_m
            .iter()
            .map(|p| f64::from(p.z) - DISTANCE - SLOPE * f64::from(p.x))
            .collect();
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        errors.sort_by(f64::total_cmp);
        let median = errors[errors.len() / 2];
        // A pixel of disparity is 21 mm of depth here.
        assert!(median.abs() < 0.2e-3, "median {median}");
        assert!(rms < 1.0e-3, "rms {rms}");
        assert!(cloud.zncc.iter().all(|v| (0.8..=1.0).contains(v)));
    }
}

/// The two knobs of quality: the subset's size against noise, the least ZNCC against the number of points.
#[test]
fn larger_subsets_have_less_noise_and_a_higher_zncc_fewer_points() {
    let folder = Folder::new("knobs");
    record(&folder, 3, false);
    let recording = Recording::open(folder.path("")).unwrap();
    let cloud = |subset_radius: usize, zncc_min: f32| {
        let options = Options { subset_radius, zncc_min, ..options(Method::Dense) };
        reconstruct(&recording, &options, &mut |_| {}).unwrap().frame.point_cloud()
    };
    let rms = |radius: usize| {
        let points = cloud(radius, 0.8).points_left_m;
        let error = |z: f32, x: f32| f64::from(z) - DISTANCE - SLOPE * f64::from(x);
        let squares: f64 = points.iter().map(|p| error(p.z, p.x).powi(2)).sum();
        (squares / points.len() as f64).sqrt()
    };
    let [small, usual, large] = [2, 4, 8].map(rms);
    assert!(small > 1.2 * usual && usual > 1.2 * large, "{small} {usual} {large}");
    let (all, good) = (cloud(4, 0.8), cloud(4, 0.995));
    assert!(
        good.len() < all.len() && good.len() > all.len() / 10,
        "{} of {}",
        good.len(),
        all.len()
    );
    assert!(good.zncc.iter().all(|z| *z >= 0.995));
    let wrong = Options { subset_radius: 9, ..options(Method::Dense) };
    let error = reconstruct(&recording, &wrong, &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("subset_radius") && error.contains("2 to 8"), "{error}");
}

/// Each way to spoil a recording, and what the error must say.
#[test]
fn wrong_recordings_are_named() {
    let (good, folder) = (Folder::new("good"), Folder::new("wrong"));
    record(&good, 3, false);
    let gray = |path: &Path, size| {
        let data = vec![9; size * size * 3 / 4];
        write_png_sized(
            path,
            (size, size * 3 / 4),
            png::ColorType::Grayscale,
            png::BitDepth::Eight,
            &data,
        );
    };
    type Spoil<'a> = &'a dyn Fn(&Folder);
    let cases: &[(&str, Spoil<'_>, &[&str])] = &[
        (
            "no folder",
            &|f| std::fs::remove_dir_all(f.path("right")).unwrap(),
            &["right", "folder of images"],
        ),
        (
            "unequal",
            &|f| std::fs::remove_file(f.path("right/02.png")).unwrap(),
            &["right", "as many images", "(3)", "2"],
        ),
        (
            "gap",
            &|f| {
                std::fs::rename(f.path("left/02.png"), f.path("left/03.png")).unwrap();
                std::fs::rename(f.path("right/02.png"), f.path("right/03.png")).unwrap();
            },
            &["left", "02.png", "03.png next"],
        ),
        (
            "empty",
            &|f| {
                for s in ["left", "right"] {
                    for k in 0..3 {
                        std::fs::remove_file(f.path(&format!("{s}/0{k}.png"))).unwrap();
                    }
                }
            },
            &["left", "none"],
        ),
        (
            "twice",
            &|f| {
                std::fs::copy(f.path("left/01.png"), f.path("left/1.png")).unwrap();
            },
            &["one image with number 1"],
        ),
        (
            "size",
            &|f| gray(&f.path("left/01.png"), 64),
            &["left/01.png", "size", "320 x 256", "64 x 48"],
        ),
        (
            "bits",
            &|f| {
                write_png(
                    &f.path("right/02.png"),
                    png::ColorType::Grayscale,
                    png::BitDepth::Sixteen,
                    &vec![1; WIDTH * HEIGHT * 2],
                )
            },
            &["right/02.png", "bit depth", "8", "16"],
        ),
        (
            "colour",
            &|f| {
                write_png(
                    &f.path("left/00.png"),
                    png::ColorType::Rgb,
                    png::BitDepth::Eight,
                    &vec![1; WIDTH * HEIGHT * 3],
                )
            },
            &["left/00.png", "colour type", "gray", "Rgb"],
        ),
        (
            "one bit",
            &|f| {
                write_png(
                    &f.path("left/00.png"),
                    png::ColorType::Grayscale,
                    png::BitDepth::One,
                    &vec![1; WIDTH / 8 * HEIGHT],
                )
            },
            &["left/00.png", "bit depth", "8 or 16"],
        ),
        (
            "truncated",
            &|f| {
                let bytes = std::fs::read(f.path("right/01.png")).unwrap();
                std::fs::write(f.path("right/01.png"), &bytes[..bytes.len() / 2]).unwrap();
            },
            &["right/01.png", "truncated PNG"],
        ),
        (
            "text",
            &|f| std::fs::write(f.path("left/01.png"), "hello").unwrap(),
            &["left/01.png", "PNG"],
        ),
        (
            "copied",
            &|f| {
                std::fs::copy(f.path("left/00.png"), f.path("left/02.png")).unwrap();
            },
            &["left/02.png", "a copy of", "left/00.png"],
        ),
        (
            "no calibration",
            &|f| std::fs::remove_file(f.path("camchain.yaml")).unwrap(),
            &["camchain.yaml", "cannot be read"],
        ),
        (
            "labels",
            &|f| std::fs::write(f.path("frames.json"), "{\"frames\": []}").unwrap(),
            &["frames.json", "one entry per pair", "(3)", "0"],
        ),
        (
            "lost frame",
            &|f| {
                std::fs::write(
                    f.path("frames.json"),
                    "{\"frames\": [{\"sequence\":5},{\"sequence\":6},{\"sequence\":6}]}",
                )
                .unwrap()
            },
            &["frames.json", "frames[2].sequence", "more than 6"],
        ),
        (
            "wrong slot",
            &|f| {
                std::fs::write(f.path("frames.json"), "{\"frames\": [{},{\"slot\":-1},{}]}")
                    .unwrap()
            },
            &["frames[1].slot", "0 to 65535", "-1"],
        ),
        (
            "not JSON",
            &|f| std::fs::write(f.path("frames.json"), "{").unwrap(),
            &["frames.json", "JSON"],
        ),
    ];
    for (name, spoil, expected) in cases {
        for entry in folder.names() {
            let path = folder.path(&entry);
            let removed = if path.is_dir() {
                std::fs::remove_dir_all(path)
            } else {
                std::fs::remove_file(path)
            };
            removed.unwrap();
        }
        std::fs::copy(good.path("camchain.yaml"), folder.path("camchain.yaml")).unwrap();
        for side in ["left", "right"] {
            std::fs::create_dir(folder.path(side)).unwrap();
            for k in 0..3 {
                let name = format!("{side}/0{k}.png");
                std::fs::copy(good.path(&name), folder.path(&name)).unwrap();
            }
        }
        spoil(&folder);
        let run = || -> Result<(), ReconstructError> {
            let recording = Recording::open(folder.path(""))?;
            reconstruct(&recording, &options(Method::Parabola), &mut |_| {})?;
            Ok(())
        };
        let error = run().expect_err(name).to_string();
        for part in *expected {
            assert!(error.contains(part), "{name}: `{error}` does not say `{part}`");
        }
    }
    let error = Recording::open(folder.path("nowhere")).unwrap_err().to_string();
    assert!(error.contains("nowhere") && error.contains("recording folder"), "{error}");
}

#[test]
fn windows_follow_the_labels() {
    let folder = Folder::new("windows");
    record(&folder, 4, false);
    let label = |sequence: u32, slot: u16, floodlight: bool| SlotLabel {
        sequence,
        slot,
        projector_mask: if floodlight { 0 } else { 1 << slot },
        floodlight,
        trigger_time_us: 1_000_000 + 33_333 * u64::from(sequence),
        exposure_us: 32_000,
    };
    let write = |slots: [(u16, bool); 4]| {
        let labels =
            (0..4).zip(slots).map(|(k, (slot, flood))| label(10 + k, slot, flood)).collect();
        let info = labels::FramesInfo { bits: Some(8), labels };
        let text = labels::to_text(&info);
        std::fs::write(folder.path("frames.json"), &text).unwrap();
        assert_eq!(labels::parse(Path::new("x"), text.as_bytes(), 4).unwrap(), info);
    };
    let run = |frames, first| {
        let recording = Recording::open(folder.path("")).unwrap();
        let options = Options { frames, first, ..options(Method::Parabola) };
        reconstruct(&recording, &options, &mut |_| {}).map(|r| (r.pairs.clone(), r.frame))
    };
    // A floodlit frame gives the picture, not the match.
    write([(0, false), (1, true), (2, false), (3, false)]);
    let (pairs, frame) = run(None, 0).unwrap();
    assert_eq!(pairs, [0, 2, 3]);
    assert_eq!(frame.labels.iter().map(|l| l.sequence).collect::<Vec<_>>(), [10, 12, 13]);
    // Without motion the depth is that of the window's middle.
    let centre = 1.0 + 0.033_333 * (10.0 + 12.0 + 13.0) / 3.0 + 0.016;
    assert!((frame.time_device_s.unwrap() - centre).abs() < 1e-9);
    // A slot that comes again begins the next window.
    write([(0, false), (1, false), (0, false), (1, false)]);
    assert_eq!(run(None, 0).unwrap().0, [0, 1]);
    assert_eq!(run(None, 1).unwrap().0, [1, 2]);
    assert_eq!(run(Some(1), 3).unwrap().0, [3]);
    // Pair 11 was lost: the cycle that is whole comes later; three slots are whole nowhere.
    let write_at = |at: [(u32, u16); 4]| {
        let labels = at.map(|(sequence, slot)| label(sequence, slot, false)).to_vec();
        let text = labels::to_text(&labels::FramesInfo { bits: Some(8), labels });
        std::fs::write(folder.path("frames.json"), text).unwrap();
    };
    write_at([(10, 0), (12, 0), (13, 1), (14, 0)]);
    assert_eq!(run(None, 0).unwrap().0, [1, 2]);
    write_at([(10, 0), (12, 2), (14, 0), (15, 1)]);
    assert_eq!(run(None, 0).unwrap().0, [0, 1]);
    write([(0, false), (1, false), (0, false), (1, false)]);
    let error = run(Some(3), 0).unwrap_err().to_string();
    assert!(error.contains("different slots") && error.contains("slot 0 again"), "{error}");
    for (frames, first, part) in [
        (Some(5), 0, "5 pairs"),
        (Some(17), 0, "1 to 16"),
        (Some(0), 0, "1 to 16"),
        (None, 4, "none"),
    ] {
        let error = run(frames, first).unwrap_err().to_string();
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn a_written_recording_reads_back() {
    let folder = Folder::new("written");
    record(&folder, 3, true);
    let recording = Recording::open(folder.path("")).unwrap();
    let pairs = recording.read_window(0..3).unwrap();
    let copy = folder.path("copy");
    stspp::recording::write(&copy, &recording.calibration, &pairs, &[], false).unwrap();
    let back = Recording::open(&copy).unwrap();
    assert_eq!(back.read_window(0..3).unwrap(), pairs);
    assert_eq!(back.bits(), 10);
    assert_eq!(back.calibration.left, recording.calibration.left);
    let error = stspp::recording::write(&copy, &back.calibration, &pairs, &[], false).unwrap_err();
    assert!(error.to_string().contains("camchain.yaml"), "{error}");
    stspp::recording::write(&copy, &back.calibration, &pairs, &[], true).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn mutated_labels_never_panic(edits in prop::collection::vec((0_usize..2000, any::<u8>()), 1..5)) {
        let labels = vec![SlotLabel {
            sequence: 1, slot: 2, projector_mask: 4, floodlight: false,
            trigger_time_us: 5, exposure_us: 6,
        }];
        let mut bytes = labels::to_text(&labels::FramesInfo { bits: None, labels }).into_bytes();
        for (at, value) in edits {
            let at = at % bytes.len();
            bytes[at] = value;
        }
        let _ = labels::parse(Path::new("frames.json"), &bytes, 1);
    }
}
