//! A cubic grid of cells: fewer points, spread evenly, and what is found by place.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use nalgebra::Point3;

/// What belongs to cells, by [`cell_key`].
pub(crate) type CellMap<V> = HashMap<u64, V, BuildHasherDefault<KeyHasher>>;

/// The cell of a point: 21 bits an axis, so that cells of 0.01 mm reach over 20 m. What is farther
/// shares the outermost cells.
pub(crate) fn cell_key(point_m: &Point3<f64>, cell_m: f64) -> u64 {
    let bits = |c: f64| ((c / cell_m).floor() as i64 + (1 << 20)).clamp(0, (1 << 21) - 1) as u64;
    bits(point_m.x) << 42 | bits(point_m.y) << 21 | bits(point_m.z)
}

/// Keys are spread by one multiplication: the standard hasher would take most of the time.
#[derive(Default)]
pub(crate) struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.write_u64(u64::from(*byte));
        }
    }

    fn write_u64(&mut self, value: u64) {
        let mixed = (self.0 ^ value).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        self.0 = mixed ^ (mixed >> 32);
    }
}

/// The first point of every cell of `cell_m`, in the cloud's order; not-finite points are left out.
pub fn thinned_by(points_m: &[Point3<f64>], cell_m: f64) -> Vec<usize> {
    let mut taken = CellMap::default();
    points_m
        .iter()
        .enumerate()
        .filter(|(_, p)| p.coords.iter().all(|c| c.is_finite()))
        .filter(|(_, p)| taken.insert(cell_key(p, cell_m), ()).is_none())
        .map(|(k, _)| k)
        .collect()
}

/// At most about `points` points, one a cell of a grid that is coarse enough.
pub fn thinned(points_m: &[Point3<f64>], points: usize) -> Vec<Point3<f64>> {
    let at = |chosen: &[usize]| chosen.iter().map(|&k| points_m[k]).collect::<Vec<_>>();
    if points_m.len() <= points {
        return points_m.to_vec();
    }
    let (extent, _) = crate::measure::units::bulk_extent(points_m);
    // A surface of the cloud's extent has about (extent / cell)^2 cells.
    let mut cell_m = (extent / (points as f64).sqrt() / 2.0).max(1e-9);
    loop {
        let chosen = thinned_by(points_m, cell_m);
        if chosen.len() <= points {
            return at(&chosen);
        }
        cell_m *= (chosen.len() as f64 / points as f64).sqrt() * 1.05;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_the_spread_and_the_limit() {
        let points: Vec<_> = (0..100_000)
            .map(|k| Point3::new(f64::from(k % 400) * 1e-3, f64::from(k / 400) * 1e-3, 1.0))
            .collect();
        let thin = thinned(&points, 2000);
        assert!(thin.len() <= 2000 && thin.len() > 800, "{}", thin.len());
        let far = thin.iter().map(|p| p.x).fold(0.0, f64::max);
        assert!(far > 0.38, "{far}");
        assert_eq!(thinned_by(&[Point3::new(f64::NAN, 0.0, 0.0)], 1.0), Vec::<usize>::new());
    }
}
