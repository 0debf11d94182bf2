//! Found fraction and time of the coarse search on synthetic scenes.
use stspp_matcher::{
    DisparityRange, Image, Level,
    coarse::{Coarse, CoarseMap, INVALID},
    synthetic::{Layer, Scene},
};

fn cpu() -> f64 {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut t) };
    t.tv_sec as f64 * 1e3 + t.tv_nsec as f64 / 1e6
}

fn score(map: &CoarseMap, truth: &Image<f32>, visible: &Image<u8>) -> (f64, f64) {
    let (mut good, mut wrong, mut n) = (0, 0, 0);
    for ((d, t), v) in map.disparity.as_slice().iter().zip(truth.as_slice()).zip(visible.as_slice()) {
        if *v == 0 { continue; }
        n += 1;
        if *d == INVALID { continue; }
        if (f32::from(*d) - t).abs() <= 1.0 { good += 1 } else if (f32::from(*d) - t).abs() > 2.0 { wrong += 1 }
    }
    (good as f64 / n as f64, wrong as f64 / n as f64)
}

fn main() {
    let (w, h) = (640, 400);
    for n in [1usize, 2, 3, 5, 10, 16] {
        let thin = |x: f64, y: f64| {
            ((x - 200.0).abs() < 2.5) || ((y - 103.0).abs() < 2.5) || ((x - 400.0).powi(2) + (y - 250.0).powi(2) < 25.0)
                || ((x - y - 150.0).abs() < 2.0)
        };
        let scenes = [
            ("bench", Scene::benchmark(w, h, n, 40.0)),
            ("thin", Scene::new(w, h, n, vec![Layer::everywhere(|x, _| 10.0 + 0.05 * x), Layer::patch(|_, _| 95.3, thin)])),
        ];
        for (name, scene) in scenes {
            let r = scene.render();
            r.with_stack(|s| {
                let mut c = Coarse::new(Level::best(), DisparityRange { min_px: -300, max_px: 219 });
                let mut m = CoarseMap::new(0, 0);
                let mut best = (f64::INFINITY, f64::INFINITY);
                for _ in 0..5 {
                    let t0 = cpu();
                    c.describe(s);
                    let t1 = cpu();
                    c.search(s, true, &mut m);
                    let t2 = cpu();
                    best = (best.0.min(t1 - t0), best.1.min(t2 - t1));
                }
                let clean = score(&m, &r.truth_px, &r.visible);
                c.search(s, false, &mut m);
                let raw = score(&m, &r.truth_px, &r.visible);
                c.search_all(s, &mut m);
                let all = score(&m, &r.truth_px, &r.visible);
                let mut hist = [[0usize; 9]; 2];
                for i in 0..w * h {
                    if r.visible.as_slice()[i] == 0 { continue; }
                    let k = (f32::from(m.disparity.as_slice()[i]) - r.truth_px.as_slice()[i]).abs() > 2.0;
                    hist[k as usize][(m.cost.as_slice()[i] as usize / 3).min(8)] += 1;
                }
                println!("{name} N={n}: clean {clean:.4?} raw {raw:.4?} all {all:.4?} cpu describe {:.2} search {:.2} hist/3 {hist:?}", best.0, best.1);
            });
        }
    }
}
