//! Renders a scene as the simulated sensor sees it, with its ground truth.
//!
//! ```text
//! cargo run --release -p stspp-hil-sim --example render -- OUT_DIR SCENE [option=value ...]
//! ```
//!
//! Writes `speckle_left.png`, `speckle_right.png` (projector 0), `flood_left.png`, `flood_right.png`
//! and `depth.png` (left camera, near is bright), and prints how long each step took.

use std::error::Error;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::Instant;

use stspp_hil_sim::world::{
    LightInterval, LightSource, PrimitiveShape, RawImage, SceneSpec, SensorModel, World,
};

/// The exposure at which the default sensor is stated.
const EXPOSURE_NS: u64 = 32_000_000;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [out, scene, options @ ..] = args.as_slice() else {
        return Err("usage: render OUT_DIR SCENE [option=value ...]".into());
    };
    let options: Vec<(&str, &str)> = options
        .iter()
        .map(|o| o.split_once('=').ok_or(format!("{o}: not option=value")))
        .collect::<Result<_, _>>()?;
    let out = Path::new(out);
    std::fs::create_dir_all(out)?;

    let start = Instant::now();
    let world = World::new(&SceneSpec::parse(scene, &options)?, SensorModel::default())?;
    println!("scene {:.2} s", start.elapsed().as_secs_f64());

    let expose = |source, seed| {
        let light = LightInterval { source, on_ns: 0, off_ns: EXPOSURE_NS };
        world.expose_pair(0, EXPOSURE_NS, &[light], seed)
    };
    let all = Instant::now();
    for slot in 0..world.model().projectors.len() {
        let start = Instant::now();
        let (left, right) = expose(LightSource::Projector(slot as u8), slot as u64);
        println!("projector {slot}: {:.2} s", start.elapsed().as_secs_f64());
        if slot == 0 {
            write_image(&out.join("speckle_left.png"), &left)?;
            write_image(&out.join("speckle_right.png"), &right)?;
        }
    }
    println!("all projectors, both cameras: {:.2} s", all.elapsed().as_secs_f64());
    let start = Instant::now();
    let _ = expose(LightSource::Projector(0), 99);
    println!("a pair again: {:.3} s", start.elapsed().as_secs_f64());
    let (left, right) = expose(LightSource::Floodlight, 100);
    write_image(&out.join("flood_left.png"), &left)?;
    write_image(&out.join("flood_right.png"), &right)?;

    let truth = world.truth();
    let depth = truth.depth_m(0);
    let both = truth.visible_to_both(0);
    let (near, far) = depth
        .iter()
        .filter(|z| z.is_finite())
        .fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &z| (l.min(z), h.max(z)));
    let gray: Vec<u16> = depth
        .iter()
        .zip(&both)
        .map(|(z, both)| match (z.is_finite(), both) {
            (true, true) => (255.0 - 200.0 * (z - near) / (far - near).max(1e-6)) as u16,
            (true, false) => 25,
            _ => 0,
        })
        .collect();
    write_image(&out.join("depth.png"), &RawImage { data: gray, ..left })?;
    let share = both.iter().filter(|b| **b).count() as f64 / both.len() as f64;
    println!("depth {near:.4} to {far:.4} m, visible to both {:.1} %", 100.0 * share);
    for p in truth.primitives(0) {
        let name = world.object_name(p.object);
        match p.shape {
            PrimitiveShape::Circle { centre_left_m, radius_m, .. } => println!(
                "{name}: circle r {:.1} mm at {:.4?}",
                radius_m * 1e3,
                centre_left_m.as_slice()
            ),
            other => println!("{name}: {other:.4?}"),
        }
    }
    Ok(())
}

fn write_image(path: &Path, image: &RawImage) -> Result<(), Box<dyn Error>> {
    let bytes = image.to_gray8().ok_or("the default sensor has 8 bits")?;
    let file = BufWriter::new(File::create(path)?);
    let mut encoder = png::Encoder::new(file, image.width as u32, image.height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header()?.write_image_data(&bytes)?;
    Ok(())
}
