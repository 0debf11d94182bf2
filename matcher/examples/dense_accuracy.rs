//! Accuracy and time of the dense fit alone on synthetic scenes, started from the rounded truth.
use std::time::Instant;

use stspp_matcher::{
    Image, Level, ShapeFunction,
    dense::{DenseFit, DenseMaps, mark_steps},
    synthetic::{Layer, Scene},
};

fn rms(map: &Image<f32>, truth: &Image<f32>, margin: usize) -> (f64, f64, usize, usize) {
    let (mut sum, mut sq, mut n, mut bad) = (0.0, 0.0, 0usize, 0usize);
    for y in margin..map.height() - margin {
        for x in margin..map.width() - margin {
            let e = f64::from(map.row(y)[x] - truth.row(y)[x]);
            if e.is_nan() {
                bad += 1;
            } else if e.abs() > 0.5 {
                bad += 1;
            } else {
                sum += e;
                sq += e * e;
                n += 1;
            }
        }
    }
    let mean = sum / n as f64;
    (mean, (sq / n as f64 - mean * mean).sqrt(), n, bad)
}

fn main() {
    let (w, h) = (640, 400);
    let scenes: Vec<(&str, Scene)> = vec![
        ("plane", Scene::new(w, h, 10, vec![Layer::everywhere(|x, y| 20.0 + 0.05 * x - 0.03 * y)])),
        ("steep", Scene::new(w, h, 10, vec![Layer::everywhere(|x, y| 20.0 + 0.3 * x - 0.2 * y)])),
        ("sphere", Scene::new(w, h, 10, vec![Layer::everywhere(|x, y| {
            let r2 = ((x - 320.0f64).powi(2) + (y - 200.0).powi(2)) / 260f64.powi(2);
            20.0 + 70.0 * (1.0 - r2.min(0.9)).sqrt()
        })])),
        ("step", Scene::new(w, h, 10, vec![
            Layer::everywhere(|x, _| 20.0 + 0.05 * x),
            Layer::patch(|x, _| 32.0 + 0.05 * x, |x, y| (x - 300.0).powi(2) + (y - 200.0).powi(2) < 90f64.powi(2)),
        ])),
    ];
    for (name, scene) in &scenes {
        let r = scene.render();
        let mut start = r.truth_px.map(|v| v.round());
        for (s, v) in start.as_mut_slice().iter_mut().zip(r.visible.as_slice()) {
            if *v == 0 { *s = f32::NAN; }
        }
        for level in Level::available() {
            for shape in [ShapeFunction::First, ShapeFunction::Auto] {
                let mut fit = DenseFit::new(level, 4, shape, 1.5);
                let mut step = Image::new(0, 0, 0);
                mark_steps(&start, 4, 1.5, &mut step);
                let flagged = step.as_slice().iter().filter(|v| **v != 0).count();
                let mut maps = DenseMaps::new(w, h);
                let mut best = f64::INFINITY;
                for _ in 0..3 {
                    let t = Instant::now();
                    r.with_stack(|s| fit.fit(s, &start, &step, &mut maps));
                    best = best.min(t.elapsed().as_secs_f64());
                }
                println!("{name} {level} {shape:?}: flagged {flagged} first {:?} second {:?} {:.2} ms wall", rms(&maps.first_px, &r.truth_px, 20), rms(&maps.second_px, &r.truth_px, 20), best * 1e3);
                if shape != ShapeFunction::First {
                    let z: Vec<f32> = maps.zncc.as_slice().iter().copied().filter(|v| v.is_finite()).collect();
                    println!("   zncc mean {}", z.iter().sum::<f32>() / z.len() as f32);
                }
            }
        }
    }
}
