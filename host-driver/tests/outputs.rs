//! Output files: content, and that they appear whole or not at all.

mod common;

use std::io::{self, BufReader, Cursor, Write};
use std::path::Path;
use std::sync::Arc;

use common::{Folder, rig};
use nalgebra::Point3;
use proptest::prelude::*;
use stspp::export::folder::{OutputError, OutputFolder};
use stspp::export::{images, ply};
use stspp::{DepthFrame, DepthRange, PointCloud, Rectifier, image_io};
use stspp_matcher::Image;

fn cloud() -> PointCloud {
    PointCloud {
        points_left_m: vec![Point3::new(0.125, -0.25, 1.5), Point3::new(1.0, 2.0, 3.0)],
        zncc: vec![0.75, 1.0],
        intensity: vec![7, 255],
        depth_rate_m_per_s: Vec::new(),
    }
}

#[test]
fn a_cloud_with_speeds_has_them_as_a_property_more() {
    let with = PointCloud { depth_rate_m_per_s: vec![-0.009, 0.0], ..cloud() };
    let (with_bytes, without_bytes) = (ply_bytes(&with), ply_bytes(&cloud()));
    let header = String::from_utf8_lossy(&with_bytes);
    assert!(header.contains("property uchar intensity\nproperty float depth_rate\nend_header"));
    assert!(header.contains("comment depth_rate is the speed along +z in metre per second\n"));
    assert_eq!(with_bytes[with_bytes.len() - 4..], 0.0_f32.to_le_bytes());
    let point = with_bytes.len() - 2 * 21;
    assert_eq!(with_bytes[point + 17..point + 21], (-0.009_f32).to_le_bytes());
    // Readers that do not know the property skip it.
    let read = |bytes: &[u8]| ply::read(&mut Cursor::new(bytes)).unwrap();
    assert_eq!(read(&with_bytes), read(&without_bytes));
}

fn ply_bytes(cloud: &PointCloud) -> Vec<u8> {
    let mut bytes = Vec::new();
    ply::write(&mut bytes, cloud).unwrap();
    bytes
}

#[test]
fn ply_bytes_are_as_documented() {
    let bytes = ply_bytes(&cloud());
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let header = std::str::from_utf8(&bytes[..at]).unwrap();
    for line in [
        "ply",
        "format binary_little_endian 1.0",
        "comment unit metre",
        "element vertex 2",
        "property float x",
        "property float zncc",
        "property uchar intensity",
    ] {
        assert!(header.lines().any(|l| l == line), "{line}");
    }
    assert!(header.contains("cam0"));
    let mut expected = Vec::new();
    for value in [0.125_f32, -0.25, 1.5, 0.75] {
        expected.extend(value.to_le_bytes());
    }
    expected.push(7);
    assert_eq!(bytes[at..at + 17], expected);
    assert_eq!(bytes.len() - at, 34);
    assert_eq!(ply::read(&mut Cursor::new(bytes)).unwrap(), cloud());
}

#[test]
fn other_programs_ply_files_are_read() {
    let ascii = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\n\
                 property double z\nproperty int label\nelement face 1\n\
                 property list uchar int vertex_indices\nend_header\n1 2 3 9\n4 5 6 9\n3 0 1 2\n";
    let cloud = ply::read(&mut Cursor::new(ascii)).unwrap();
    assert_eq!(cloud.points_left_m, [Point3::new(1.0, 2.0, 3.0), Point3::new(4.0, 5.0, 6.0)]);
    assert_eq!((&cloud.zncc[..], &cloud.intensity[..]), (&[1.0, 1.0][..], &[255, 255][..]));
    let mut big = b"ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty short x\n\
        property float y\nproperty double z\nend_header\n"
        .to_vec();
    big.extend((-3_i16).to_be_bytes());
    big.extend(0.5_f32.to_be_bytes());
    big.extend(8.25_f64.to_be_bytes());
    let cloud = ply::read(&mut Cursor::new(big)).unwrap();
    assert_eq!(cloud.points_left_m, [Point3::new(-3.0, 0.5, 8.25)]);
}

#[test]
fn damaged_ply_files_are_errors() {
    let whole = ply_bytes(&cloud());
    let short = ply::read(&mut Cursor::new(&whole[..whole.len() - 1])).unwrap_err().to_string();
    assert!(short.contains("point 1 of 2"), "{short}");
    for (text, expected) in [
        ("", "line 1: expected `ply`"),
        ("ply\nformat binary_middle_endian 1.0\n", "line 2: expected ascii"),
        ("ply\nformat ascii 1.0\nend_header\n", "element vertex"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n", "x, y and z"),
        ("ply\nformat ascii 1.0\nelement vertex -1\n", "a number of points"),
        ("ply\nformat ascii 1.0\nelement face 1\n", "the points"),
        ("ply\nwhat is this\n", "a PLY header line"),
    ] {
        let error = ply::read(&mut Cursor::new(text)).unwrap_err().to_string();
        assert!(error.contains(expected), "{text:?}: {error}");
    }
}

#[test]
fn depth_png_has_tenths_of_millimetres() {
    let depth = Image::from_vec(4, 1, vec![1.234_56, f32::NAN, 7.0, 0.000_01]).unwrap();
    let mut bytes = Vec::new();
    images::write_depth_png(&mut bytes, &depth).unwrap();
    let mut reader = png::Decoder::new(Cursor::new(&bytes)).read_info().unwrap();
    let texts = &reader.info().uncompressed_latin1_text;
    assert!(texts.iter().any(|t| t.keyword == "Unit" && t.text.starts_with("0.1 mm")));
    let mut pixels = [0; 8];
    reader.next_frame(&mut pixels).unwrap();
    assert_eq!(u16::from_be_bytes([pixels[0], pixels[1]]), 12_346);
    assert_eq!(pixels[2..], [0; 6]);
}

#[test]
fn disparity_tiff_keeps_every_bit() {
    let disparity = Image::from_vec(3, 2, vec![-12.25, f32::NAN, 0.0, 1e-7, 380.5, -0.0]).unwrap();
    let mut bytes = Vec::new();
    images::write_disparity_tiff(&mut bytes, &disparity).unwrap();
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(bytes)).unwrap();
    assert_eq!(decoder.dimensions().unwrap(), (3, 2));
    let tiff::decoder::DecodingResult::F32(back) = decoder.read_image().unwrap() else {
        panic!("not 32-bit float");
    };
    let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&back), bits(disparity.as_slice()));
}

#[test]
fn a_frames_depth_and_cloud_agree_with_its_geometry() {
    let rectifier = Rectifier::new(&rig(), DepthRange::default()).unwrap();
    let geometry = Arc::clone(rectifier.geometry());
    let (w, h) = (geometry.width, geometry.height);
    let mut matched = stspp_matcher::Matched {
        disparity_px: Image::new(w, h, f32::NAN),
        zncc: Image::new(w, h, f32::NAN),
        at_newest: true,
        rate_px_per_s: Some(Image::new(w, h, f32::NAN)),
        brightness: None,
        stages: Vec::new(),
    };
    let infinity = geometry.disparity_at_infinity_px() as f32;
    let pixels = [(0, 0, 700.0), (w - 1, 0, 650.0), (600, 500, 512.25), (0, h - 1, 400.0)];
    for (x, y, parallax) in pixels {
        matched.disparity_px.set(x, y, infinity + parallax);
        matched.zncc.set(x, y, 0.9);
        if let Some(rate) = &mut matched.rate_px_per_s {
            rate.set(x, y, 2.0);
        }
    }
    // Behind infinity there is nothing.
    matched.disparity_px.set(5, 5, infinity - 1.0);
    let intensity = Image::new(w, h, 80);
    let frame: DepthFrame =
        stspp::reproject::depth_frame(&geometry, matched, intensity, Vec::new());
    let cloud = frame.point_cloud();
    assert_eq!((cloud.len(), frame.valid_points()), (4, 4));
    let mut points = cloud.points_left_m.iter();
    for (x, y, _) in [pixels[0], pixels[1], pixels[2], pixels[3]] {
        let d = f64::from(frame.disparity_px.get(x, y).unwrap());
        let expected = geometry.point_left_m(x as f64, y as f64, d).unwrap();
        let point = points.next().unwrap();
        assert!((point.cast::<f64>() - expected).norm() < 1e-6);
        let z = f64::from(frame.depth_m.get(x, y).unwrap());
        assert!((z - expected.z).abs() < 1e-6);
        // The rate is that of the depth between two disparities.
        let later = geometry.depth_left_m(x as f64, y as f64, d + 2e-3).unwrap();
        let rate = f64::from(frame.depth_rate_m_per_s.as_ref().unwrap().get(x, y).unwrap());
        assert!((rate - (later - expected.z) / 1e-3).abs() < 1e-4 * rate.abs());
    }
    assert!(frame.depth_m.get(5, 5).unwrap().is_nan());
}

#[test]
fn folders_appear_whole_or_not_at_all() {
    let root = Folder::new("outputs");
    let target = root.path("a/b/out");
    let mut out = OutputFolder::create(&target, false).unwrap();
    out.file("one.txt", |w| w.write_all(b"1")).unwrap();
    assert!(!target.exists());
    out.commit().unwrap();
    assert_eq!(std::fs::read(target.join("one.txt")).unwrap(), b"1");
    assert_eq!(std::fs::read_dir(target.parent().unwrap()).unwrap().count(), 1);

    // A writer that fails midway, as on a full disk: nothing is left, parents neither.
    let other = root.path("c/d/out");
    let mut out = OutputFolder::create(&other, false).unwrap();
    out.file("one.txt", |w| w.write_all(b"1")).unwrap();
    let error = out
        .file("two.txt", |w| {
            w.write_all(&[0; 1 << 20])?;
            Err(io::ErrorKind::StorageFull.into())
        })
        .unwrap_err();
    assert!(matches!(&error, OutputError::Write { path, .. } if path.ends_with("out/two.txt")));
    drop(out);
    assert_eq!(root.names(), ["a"]);

    // In a folder that is there: what is there stays as it was.
    let mut out = OutputFolder::create(&target, true).unwrap();
    out.file("one.txt", |w| w.write_all(b"2")).unwrap();
    out.file("sub/two.txt", |w| w.write_all(b"2")).unwrap();
    drop(out);
    assert_eq!(std::fs::read(target.join("one.txt")).unwrap(), b"1");
    assert_eq!(std::fs::read_dir(&target).unwrap().count(), 1);
    let mut out = OutputFolder::create(&target, false).unwrap();
    let error = out.file("one.txt", |w| w.write_all(b"2")).unwrap_err();
    assert!(matches!(error, OutputError::Exists { .. }));
    drop(out);
    let mut out = OutputFolder::create(&target, true).unwrap();
    out.file("one.txt", |w| w.write_all(b"3")).unwrap();
    out.commit().unwrap();
    assert_eq!(std::fs::read(target.join("one.txt")).unwrap(), b"3");

    // Where no folder can be: below a file.
    assert!(OutputFolder::create(&target.join("one.txt"), true).is_err());
    assert!(OutputFolder::create(&target.join("one.txt/deeper"), true).is_err());
}

/// A device that is always full stands in for the disk.
#[cfg(target_os = "linux")]
#[test]
fn every_writer_reports_a_full_disk() {
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let depth = Image::new(64, 64, 1.0_f32);
    type Writer<'a> = &'a dyn Fn(&mut dyn Write) -> io::Result<()>;
    let writers: [(&str, Writer<'_>); 6] = [
        ("ply", &|w| ply::write(w, &cloud())),
        ("depth", &|w| images::write_depth_png(w, &depth)),
        ("colour", &|w| images::write_depth_colour_png(w, &depth, (0.8, 2.0))),
        ("zncc", &|w| images::write_zncc_png(w, &depth)),
        ("disparity", &|w| images::write_disparity_tiff(w, &depth)),
        ("grey", &|w| image_io::write_gray8(w, &Image::new(64, 64, 1), &[])),
    ];
    for (name, write) in writers {
        let error = write(&mut full()).expect_err(name);
        assert_eq!(error.kind(), io::ErrorKind::StorageFull, "{name}: {error}");
    }
}

#[test]
fn png_files_that_are_none_of_ours_are_errors() {
    let path = Path::new("left/00.png");
    let decode = |bytes: &[u8]| image_io::decode_gray(path, BufReader::new(Cursor::new(bytes)));
    let mut good = Vec::new();
    let ramp = Image::from_vec(64, 32, (0..2048).map(|v| (v % 251) as u8).collect()).unwrap();
    image_io::write_gray8(&mut good, &ramp, &[]).unwrap();
    assert_eq!(decode(&good).unwrap(), stspp::RawImage::gray8(ramp));
    for length in [0, 4, 8, 20, 33, 50, good.len() / 2, good.len() - 5] {
        let error = decode(&good[..length]).unwrap_err().to_string();
        assert!(error.starts_with("left/00.png: ") && error.contains("PNG"), "{length}: {error}");
    }
    let mut colour = Vec::new();
    image_io::write_rgb8(&mut colour, &Image::new(8, 8, [1, 2, 3]), &[]).unwrap();
    let error = decode(&colour).unwrap_err().to_string();
    assert_eq!(error, "left/00.png: colour type: expected gray without alpha, got Rgb");
    assert!(decode(b"GIF89a and so on").unwrap_err().to_string().contains("expected a PNG image"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn mutated_png_files_never_panic(edits in prop::collection::vec((0_usize..2000, any::<u8>()), 1..5)) {
        let mut bytes = Vec::new();
        image_io::write_gray16(&mut bytes, &Image::new(40, 30, 777_u16), &[]).unwrap();
        for (at, value) in edits {
            let at = at % bytes.len();
            bytes[at] = value;
        }
        let _ = image_io::decode_gray(Path::new("x.png"), BufReader::new(Cursor::new(bytes)));
    }

    #[test]
    fn mutated_ply_files_never_panic(
        edits in prop::collection::vec((0_usize..2000, any::<u8>()), 1..6),
        length in 0_usize..600,
    ) {
        let mut bytes = ply_bytes(&cloud());
        for (at, value) in edits {
            let at = at % bytes.len();
            bytes[at] = value;
        }
        bytes.truncate(length.max(1));
        let _ = ply::read(&mut Cursor::new(bytes));
    }

    #[test]
    fn clouds_round_trip(points in prop::collection::vec(
        (any::<[f32; 3]>(), any::<f32>(), any::<u8>()), 0..20)
    ) {
        let cloud = PointCloud {
            points_left_m: points.iter().map(|p| Point3::from(p.0)).collect(),
            zncc: points.iter().map(|p| p.1).collect(),
            intensity: points.iter().map(|p| p.2).collect(),
            depth_rate_m_per_s: Vec::new(),
        };
        let back = ply::read(&mut Cursor::new(ply_bytes(&cloud))).unwrap();
        // NaN compares by its bits.
        prop_assert_eq!(ply_bytes(&back), ply_bytes(&cloud));
    }
}
