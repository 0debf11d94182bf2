use super::*;
use std::time::Instant;
fn best(mut f: impl FnMut()) -> f64 {
    let mut b = f64::INFINITY;
    for _ in 0..300 {
        let t = Instant::now();
        for _ in 0..10 {
            f();
        }
        b = b.min(t.elapsed().as_secs_f64() / 10.0);
    }
    b * 1e9
}
#[test]
#[ignore]
fn kernels_ns_per_px() {
    let level = Level::best();
    let len = 640;
    let stride = len + 2 * moments::PAD;
    let rows: Vec<Vec<Sample>> =
        (0..10).map(|t| (0..1280).map(|x| ((x * 37 + t * 91) % 16000) as i16).collect()).collect();
    let refs: Vec<&[Sample]> = rows.iter().map(|r| &r[..]).collect();
    let mut gradient = vec![0i32; 5 * len];
    let mut grey = gradient.clone();
    let mut m: Vec<Vec<f32>> = (0..12).map(|_| vec![1.0; stride]).collect();
    let w: Vec<f32> = (0..len).map(|x| 20.3 + 0.05 * x as f32).collect();
    let n = len as f64;
    {
        let [s, il, i, l, ll, ..] = &mut m[..] else { panic!() };
        let ns = best(|| {
            let mut out = gradient::Static {
                gradient: &mut gradient,
                grey: &mut grey,
                stride: len,
                s,
                il,
                i,
                l,
                ll,
            };
            gradient::static_row(level, &refs, 100, len, &mut out);
        });
        println!("static {:.3} ns/px", ns / n);
    }
    {
        let [at, valid, ig, g, gg, lg, ..] = &mut m[..] else { panic!() };
        let source = warp::Source {
            right: &refs,
            x0: 300,
            w: &w,
            gradient: &gradient,
            grey: &grey,
            stride: len,
        };
        let ns =
            best(|| warp::warp_row(level, &source, &mut warp::Warped { at, valid, ig, g, gg, lg }));
        println!("warp {:.3} ns/px", ns / n);
    }
    let data: Vec<Vec<f32>> = (0..9)
        .map(|j| (0..stride).map(|x| 1000.0 + ((x * 31 + j * 77) % 100) as f32).collect())
        .collect();
    let r: Vec<&[f32]> = data.iter().map(|r| &r[..]).collect();
    let many: Vec<Vec<f32>> = (0..45)
        .map(|j| (0..stride).map(|x| 1000.0 + ((x * 31 + j * 77) % 100) as f32).collect())
        .collect();
    let m: Vec<&[f32]> = many.iter().map(|r| &r[..]).collect();
    let mut a = vec![0.0f32; stride];
    let mut b = a.clone();
    println!("box {:.3} ns/px", best(|| moments::box_sum(level, &r, 4, len, &mut a, &mut b)) / n);
    let p = moments::powers(4);
    let mut o: Vec<Vec<f32>> = vec![vec![0.0; stride]; 9];
    {
        let mut out: Vec<&mut [f32]> = o.iter_mut().map(|r| &mut r[..]).collect();
        println!(
            "horizontal3 {:.3} ns/px",
            best(|| moments::horizontal(level, &data[0], 4, &p, len, &mut out[..3])) / n
        );
        println!(
            "horizontal5 {:.3} ns/px",
            best(|| moments::horizontal(level, &data[0], 4, &p, len, &mut out[..5])) / n
        );
        println!(
            "inverse first {:.3} ns/px",
            best(|| solve::inverse_rows(level, [&r; 5], 4, &p, len, Fits::First, &mut out)) / n
        );
        println!(
            "inverse both {:.3} ns/px",
            best(|| solve::inverse_rows(level, [&r; 5], 4, &p, len, Fits::Both, &mut out)) / n
        );
    }
    let inv: Vec<&[f32]> = o.iter().map(|r| &r[..]).collect();
    let mut d = [vec![0.0f32; stride], vec![0.0f32; stride]];
    let [d0, d1] = &mut d;
    println!(
        "disparities both {:.3} ns/px",
        best(|| solve::disparities(level, [&r; 3], &inv, 4, &p, len, &mut [d0, d1])) / n
    );
    println!(
        "disparities first {:.3} ns/px",
        best(|| solve::disparities(level, [&r; 3], &inv, 4, &p, len, &mut [d0])) / n
    );
    println!(
        "L2: disparities both {:.3} ns/px",
        best(|| solve::disparities(
            level,
            [&m[..9], &m[9..18], &m[18..27]],
            &inv,
            4,
            &p,
            len,
            &mut [d0, d1]
        )) / n
    );
    {
        let mut o: Vec<Vec<f32>> = vec![vec![0.0; stride]; 9];
        let mut out: Vec<&mut [f32]> = o.iter_mut().map(|r| &mut r[..]).collect();
        println!(
            "L2: inverse both {:.3} ns/px",
            best(|| solve::inverse_rows(
                level,
                [&m[..9], &m[9..18], &m[18..27], &m[27..36], &m[36..]],
                4,
                &p,
                len,
                Fits::Both,
                &mut out
            )) / n
        );
    }
    let flagged = vec![1.0f32; len];
    println!(
        "refit both {:.3} ns/px",
        best(|| refit::refit_row(
            level,
            &refit::Window { s: &r, q: &r, w: &r, limit: 60.0 },
            &flagged,
            4,
            &p,
            len,
            Fits::Both,
            &mut [d0, d1]
        )) / n
    );
    println!(
        "refit first {:.3} ns/px",
        best(|| refit::refit_row(
            level,
            &refit::Window { s: &r, q: &r, w: &r, limit: 60.0 },
            &flagged,
            4,
            &p,
            len,
            Fits::First,
            &mut [d0, d1]
        )) / n
    );
}
