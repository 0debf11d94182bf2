//! Cameras that send their pixels otherwise: by the kernel's formats, or both pictures side by side.

use serde_json::Value;

use super::bench::{Bench, SCENE_SCALE, SIDE_BY_SIDE};
use super::{depth, scenario};

/// Pairs that are streamed in each format: a slot cycle, so that the mean brightness is of the same light.
const PAIRS: usize = 10;

/// The simulated sensor's formats, and how many times 255 their full scale is.
const FORMATS: [(&str, f64); 5] =
    [("grey", 1.0), ("yuyv", 1.0), ("y10", 4.0), ("y12", 16.0), ("y16", 16.0)];

/// Same scene, same light: mean grey values may differ by rounding and noise.
const BRIGHTNESS_TOLERANCE: f64 = 0.02;

/// Each format is found by `stspp` and its pictures are as bright as the scene is.
pub fn formats(bench: &mut Bench) -> Result<String, String> {
    let mut reference: Option<[f64; 2]> = None;
    for (format, scale) in FORMATS {
        let told = |what: String| format!("{format}: {what}");
        bench.exchange(SCENE_SCALE, &["--format", format]).map_err(told)?;
        scenario::set_timing(bench).map_err(told)?;
        let grey = mean_grey(bench).map_err(told)?;
        let expected = *reference.get_or_insert(grey);
        for (got, expected) in grey.iter().zip(expected) {
            if (got / (expected * scale) - 1.0).abs() > BRIGHTNESS_TOLERANCE {
                return Err(told(format!(
                    "mean grey {grey:.1?}, expected {scale} x {expected:.1}"
                )));
            }
        }
    }
    let names: Vec<&str> = FORMATS.iter().map(|(name, _)| *name).collect();
    Ok(format!("{}: as bright as each other", names.join(", ")))
}

/// Mean grey values of both sides' pictures, of a slot cycle.
fn mean_grey(bench: &mut Bench) -> Result<[f64; 2], String> {
    let (lines, _) = scenario::stream_lines(bench, &PAIRS.to_string())?;
    bench.dark()?;
    let side = |line: &Value, side: usize| line["mean_grey"][side].as_f64();
    let means = [0, 1].map(|of| {
        let values: Option<Vec<f64>> = lines.iter().map(|line| side(line, of)).collect();
        values.filter(|v| v.len() == PAIRS).map(|v| v.iter().sum::<f64>() / PAIRS as f64)
    });
    match means {
        [Some(left), Some(right)] if left > 1.0 && right > 1.0 => Ok([left, right]),
        _ => Err(format!("no brightness: {lines:?}")),
    }
}

/// Depth from one camera that sends both pictures.
pub fn side_by_side(bench: &mut Bench) -> Result<String, String> {
    bench.exchange(SCENE_SCALE, &[SIDE_BY_SIDE])?;
    scenario::set_timing(bench)?;
    depth::again(bench)
}
