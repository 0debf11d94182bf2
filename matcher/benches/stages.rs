//! Time per stage of the fast path on a full frame: `cargo bench -p stspp-matcher`.
//!
//! 1280 x 1024, ten frames, 520 candidate disparities, on the process-wide rayon pool
//! (`RAYON_NUM_THREADS=1` for one thread).

use criterion::{Criterion, criterion_group, criterion_main};
use stspp_matcher::{
    DisparityRange, Image, Level, Matcher, Method, Params, ShapeFunction,
    coarse::{Coarse, CoarseMap, INVALID},
    dense::{DenseFit, DenseMaps, mark_steps, order::OrderChoice},
    regions::Regions,
    synthetic::Scene,
};

const RANGE: DisparityRange = DisparityRange { min_px: -400, max_px: 119 };

fn stages(criterion: &mut Criterion) {
    let (width, height) = (1280, 1024);
    let scene = Scene::benchmark(width, height, 10, 40.0).render();
    let level = Level::best();
    let mut group = criterion.benchmark_group("stage");
    group.sample_size(10);
    scene.with_stack(|stack| {
        let mut coarse = Coarse::new(level, RANGE);
        let mut map = CoarseMap::new(width, height);
        group.bench_function("describe", |b| b.iter(|| coarse.describe(stack)));
        group.bench_function("search", |b| b.iter(|| coarse.search(stack, true, &mut map)));
        let start = map.disparity.map(|d| if d == INVALID { f32::NAN } else { f32::from(d) });
        let mut step = Image::new(width, height, 0u8);
        group.bench_function("steps", |b| b.iter(|| mark_steps(level, &start, 4, 1.5, &mut step)));
        let mut maps = DenseMaps::new(width, height);
        for (name, shape) in [("dense first", ShapeFunction::First), ("dense", ShapeFunction::Auto)]
        {
            let mut fit = DenseFit::new(level, 4, shape, 1.5);
            group.bench_function(name, |b| b.iter(|| fit.fit(stack, &start, &step, &mut maps)));
        }
        let mut order = OrderChoice::default();
        let mut disparity = Image::new(width, height, f32::NAN);
        group.bench_function("order", |b| {
            b.iter(|| order.choose(level, 0.8, &mut maps, &mut disparity));
        });
        let mut regions = Regions::default();
        group.bench_function("regions", |b| b.iter(|| regions.remove(&mut disparity, 60)));
    });
    group.finish();
    let mut group = criterion.benchmark_group("frame");
    group.sample_size(10);
    for shape in [ShapeFunction::First, ShapeFunction::Auto] {
        let mut params = Params::new(RANGE);
        (params.method, params.shape) = (Method::Dense, shape);
        let mut matcher = Matcher::new(params).expect("parameters in range");
        scene.with_stack(|stack| {
            group.bench_function(format!("{shape:?}"), |b| {
                b.iter(|| matcher.match_stack(stack).expect("a stack of one size"));
            });
        });
    }
    group.finish();
}

criterion_group!(benches, stages);
criterion_main!(benches);
