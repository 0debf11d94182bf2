//! CPU time per stage of the fast path on a full synthetic frame: the minimum of repeats.
//!
//! `cargo run --release -p stspp-matcher --example stage_times [repeats] [level] [threads]`

use stspp_matcher::{
    DisparityRange, Image, Level, ShapeFunction,
    coarse::{Coarse, CoarseMap, INVALID},
    cpu_time::process_cpu_ms,
    dense::{
        DenseFit, DenseMaps, mark_steps, motion::MotionFit, order::OrderChoice, settle::Settle,
    },
    regions::Regions,
    synthetic::Scene,
};

fn cpu_ms() -> f64 {
    process_cpu_ms().expect("a clock of the process's CPU time")
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let repeats: usize = arguments.next().map_or(10, |a| a.parse().expect("a number"));
    let level = arguments.next().map_or(Level::best(), |a| a.parse().expect("a level"));
    let threads = arguments.next().map_or(1, |a| a.parse().expect("a number"));
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().expect("one pool");
    let (w, h) = (1280, 1024);
    let r = Scene::benchmark(w, h, 10, 40.0).render();
    let mut coarse = Coarse::new(level, DisparityRange { min_px: -400, max_px: 119 });
    let mut map = CoarseMap::new(w, h);
    let mut start = Image::new(w, h, f32::NAN);
    let mut step = Image::new(w, h, 0u8);
    let mut maps = DenseMaps::new(w, h);
    let mut first = DenseFit::new(level, 4, ShapeFunction::First, 1.5);
    let mut auto = DenseFit::new(level, 4, ShapeFunction::Auto, 1.5);
    let mut settle = Settle::new(level);
    let mut order = OrderChoice::default();
    let mut regions = Regions::default();
    let mut disparity = Image::new(w, h, f32::NAN);
    let mut motion = MotionFit::new(level);
    let names = [
        "describe",
        "search",
        "start and steps",
        "dense first",
        "dense",
        "order",
        "regions",
        "motion at rest",
        "settle",
    ];
    let mut best = [f64::INFINITY; 9];
    r.with_stack(|s| {
        for _ in 0..repeats {
            let mut t = cpu_ms();
            let mut lap = |i: usize| {
                let now = cpu_ms();
                best[i] = best[i].min(now - t);
                t = now;
            };
            coarse.describe(s);
            lap(0);
            coarse.search(s, true, &mut map);
            lap(1);
            for (to, d) in start.as_mut_slice().iter_mut().zip(map.disparity.as_slice()) {
                *to = if *d == INVALID { f32::NAN } else { f32::from(*d) };
            }
            mark_steps(level, &start, 4, 1.5, &mut step);
            lap(2);
            first.fit(s, &start, &step, &mut maps);
            lap(3);
            auto.fit(s, &start, &step, &mut maps);
            lap(4);
            settle.run(s, (0.8, true), &step, &mut start, &mut maps);
            lap(8);
            let moved = motion.run(s, &mut auto, &start, &step, &mut maps);
            lap(7);
            assert!(moved.is_none(), "the scene is at rest");
            order.choose(level, 0.8, &mut maps, &mut disparity);
            lap(5);
            regions.remove(&mut disparity, 60);
            lap(6);
        }
    });
    let flagged = step.as_slice().iter().filter(|v| **v != 0).count();
    println!("{level}, {threads} threads, CPU ms, {flagged} pixels at steps:");
    for (name, ms) in names.iter().zip(best) {
        println!("  {name:16} {ms:6.2}");
    }
    let sum = |with: &[usize]| with.iter().map(|&i| best[i]).sum::<f64>();
    println!("  frame, first     {:6.2}", sum(&[0, 1, 2, 3, 6, 7]));
    println!("  frame, settled   {:6.2}", sum(&[0, 1, 2, 4, 8, 5, 6, 7]));
    println!("  frame, auto      {:6.2}", sum(&[0, 1, 2, 4, 5, 6, 7]));
}
