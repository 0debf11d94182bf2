//! Accuracy and stage times on synthetic scenes: `cargo run --release -p stspp-matcher --example
//! figures [-- full]`.

#[path = "../tests/synthetic/mod.rs"]
mod synthetic;

use stspp_matcher::{DisparityRange, Matcher, Method, Params, ShapeFunction};
use synthetic::{Layer, Rendered, Scene};

fn main() {
    let full = std::env::args().any(|a| a == "full");
    let frames = std::env::args().find_map(|a| a.parse().ok()).unwrap_or(10);
    let (width, height) = if full { (1280, 1024) } else { (640, 360) };
    let range = if full {
        DisparityRange { min_px: -400, max_px: 119 }
    } else {
        DisparityRange { min_px: -60, max_px: 99 }
    };
    for (name, layers) in scenes(width as f64, height as f64) {
        let scene = Scene::new(width, height, frames, layers);
        let rendered = scene.render();
        println!("{name}");
        for (method, shape) in [
            (Method::Parabola, ShapeFunction::First),
            (Method::IcGn, ShapeFunction::First),
            (Method::IcGn, ShapeFunction::Second),
        ] {
            let mut params = Params::new(range);
            params.method = method;
            params.shape = shape;
            report(&rendered, params);
        }
    }
}

fn scenes(w: f64, h: f64) -> Vec<(&'static str, Vec<Layer>)> {
    let disc = move |x: f64, y: f64| (x - 0.45 * w).hypot(y - 0.5 * h) / (0.3 * h);
    vec![
        (
            "plane, slopes 5 % and 3 %",
            vec![Layer::everywhere(move |x, y| 0.05 * (x - 0.5 * w) + 0.03 * (y - 0.5 * h))],
        ),
        (
            "sphere before a plane",
            vec![
                Layer {
                    disparity: Box::new(move |x, y| {
                        let r = disc(x, y).min(0.999);
                        10.0 + 30.0 * (1.0 - r * r).sqrt()
                    }),
                    support: Box::new(move |x, y| disc(x, y) < 0.97),
                },
                Layer::everywhere(|_, _| -20.0),
            ],
        ),
        (
            "discs, steps of 6 and 25 px",
            vec![
                Layer {
                    disparity: Box::new(move |x, _| 20.0 + 0.02 * x),
                    support: Box::new(move |x, y| disc(x, y) < 0.5),
                },
                Layer {
                    disparity: Box::new(move |x, _| -5.0 + 0.02 * x),
                    support: Box::new(move |x, y| disc(x, y) < 1.0),
                },
                Layer::everywhere(|x, _| -11.0 + 0.02 * x),
            ],
        ),
    ]
}

fn report(rendered: &Rendered, params: Params) {
    let repeats = if std::env::args().any(|a| a == "repeat") { 4 } else { 1 };
    let label = format!("{:?} {:?}", params.method, params.shape);
    let mut matcher = Matcher::new(params).expect("parameters are valid");
    let mut matched = match rendered.with_stack(|s| matcher.match_stack(s)) {
        Ok(m) => m,
        Err(e) => return println!("  {label}: {e}"),
    };
    for _ in 1..repeats {
        let again = rendered.with_stack(|s| matcher.match_stack(s)).expect("it worked once");
        for (best, now) in matched.stages.iter_mut().zip(again.stages) {
            best.wall_ms = best.wall_ms.min(now.wall_ms);
        }
    }
    let score = rendered.compare(&matched.disparity_px, |_, _| true);
    println!(
        "  {label:16} rms {:.4} px, bias {:+.4}, complete {:.3} %, wrong {} ({:.3} %), hidden {} of {}",
        score.rms_px,
        score.bias_px,
        100.0 * score.completeness(),
        score.wrong,
        100.0 * score.wrong as f64 / score.matched.max(1) as f64,
        score.hidden_matched,
        score.hidden,
    );
    let stages: Vec<String> =
        matched.stages.iter().map(|s| format!("{} {:.1} ms", s.stage, s.wall_ms)).collect();
    println!("    {} on {}: {}", matcher.threads(), matcher.level(), stages.join(", "));
}
