//! Median and small regions, by their definitions.

/// Fills gaps and replaces outliers by the 3x3 median where five of the neighbours agree with it.
pub fn median_3x3(map: &[Vec<f64>], step: f64) -> Vec<Vec<f64>> {
    let (h, w) = (map.len() as i64, map[0].len() as i64);
    let mut out = map.to_vec();
    for y in 0..h {
        for x in 0..w {
            let mut near = Vec::new();
            for dy in -1..=1 {
                for dx in -1..=1 {
                    let (px, py) = (x + dx, y + dy);
                    if px >= 0
                        && py >= 0
                        && px < w
                        && py < h
                        && !map[py as usize][px as usize].is_nan()
                    {
                        near.push(map[py as usize][px as usize]);
                    }
                }
            }
            near.sort_by(f64::total_cmp);
            if near.len() < 5 {
                continue;
            }
            let median = near[near.len() / 2];
            let here = map[y as usize][x as usize];
            let agree = near.iter().filter(|v| (**v - median).abs() <= step).count();
            if (here.is_nan() || (here - median).abs() > step) && agree >= 5 {
                out[y as usize][x as usize] = median;
            }
        }
    }
    out
}

/// Removes regions, found by flooding from each pixel in turn. Neighbours a, b belong together when they
/// differ by at most 1.5, or by at most 4 and no more than 1 differently than b and the pixel beyond it,
/// or than a and the pixel before it.
pub fn remove_small_regions(map: &[Vec<f64>], least: usize) -> Vec<Vec<f64>> {
    let (h, w) = (map.len() as i64, map[0].len() as i64);
    let mut out = map.to_vec();
    for y in 0..h {
        for x in 0..w {
            let mut seen = std::collections::BTreeSet::from([(x, y)]);
            let mut open = vec![(x, y)];
            while let Some((px, py)) = open.pop() {
                for (nx, ny) in [(px - 1, py), (px + 1, py), (px, py - 1), (px, py + 1)] {
                    if nx < 0 || ny < 0 || nx >= w || ny >= h || seen.contains(&(nx, ny)) {
                        continue;
                    }
                    let value = |x: i64, y: i64| {
                        let inside = x >= 0 && y >= 0 && x < w && y < h;
                        if inside { map[y as usize][x as usize] } else { f64::NAN }
                    };
                    let (dx, dy) = (nx - px, ny - py);
                    let across = value(nx, ny) - value(px, py);
                    let before = value(px, py) - value(px - dx, py - dy);
                    let after = value(nx + dx, ny + dy) - value(nx, ny);
                    let slope_goes_on =
                        (across - before).abs() <= 1.0 || (across - after).abs() <= 1.0;
                    if across.abs() <= 1.5 || (across.abs() <= 4.0 && slope_goes_on) {
                        seen.insert((nx, ny));
                        open.push((nx, ny));
                    }
                }
            }
            if seen.len() < least {
                out[y as usize][x as usize] = f64::NAN;
            }
        }
    }
    out
}
