//! Grids in images: which points are neighbours on a grid that perspective and lens have bent.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Vector2;

/// Cell of a lattice.
pub type Cell = (i32, i32);

/// A grown lattice: the point in each cell. Cell (i + 1, j) is to the right of (i, j) in the grid's own
/// sense, (i, j + 1) below it; the two directions are right-handed in the image (x right, y down).
pub type Lattice = BTreeMap<Cell, usize>;

/// How far a point may be from where its neighbours say it is, as a part of the pitch.
const TOLERANCE: f64 = 0.22;

/// The four neighbours of a cell.
const NEIGHBOURS: [Cell; 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];

/// Points sorted into boxes, so that the nearest one is found without looking at all.
pub struct Nearby<'a> {
    points: &'a [Vector2<f64>],
    boxes: BTreeMap<(i64, i64), Vec<usize>>,
}

const BOX_PX: f64 = 16.0;

impl<'a> Nearby<'a> {
    /// Sorts the points.
    pub fn new(points: &'a [Vector2<f64>]) -> Self {
        let mut boxes: BTreeMap<(i64, i64), Vec<usize>> = BTreeMap::new();
        for (index, p) in points.iter().enumerate() {
            boxes.entry(Self::key(*p)).or_default().push(index);
        }
        Self { points, boxes }
    }

    fn key(p: Vector2<f64>) -> (i64, i64) {
        ((p.x / BOX_PX).floor() as i64, (p.y / BOX_PX).floor() as i64)
    }

    /// The points within `reach` of a place.
    pub fn within(&self, place: Vector2<f64>, reach: f64) -> impl Iterator<Item = usize> + '_ {
        let (low, high) = (place.add_scalar(-reach), place.add_scalar(reach));
        let (low, high) = (Self::key(low), Self::key(high));
        (low.0..=high.0)
            .flat_map(move |x| (low.1..=high.1).map(move |y| (x, y)))
            .filter_map(|key| self.boxes.get(&key))
            .flatten()
            .copied()
            .filter(move |&index| (self.points[index] - place).norm() <= reach)
    }

    /// The nearest point within `reach` that `fits`.
    pub fn nearest(
        &self,
        place: Vector2<f64>,
        reach: f64,
        fits: impl Fn(usize) -> bool,
    ) -> Option<usize> {
        self.within(place, reach).filter(|&index| fits(index)).min_by(|&a, &b| {
            let distance = |index: usize| (self.points[index] - place).norm();
            distance(a).total_cmp(&distance(b))
        })
    }
}

/// Grows a lattice from a point and the vectors to its neighbours. `fits(index, cell)` says whether a
/// point can be in a cell.
pub fn grow(
    points: &[Vector2<f64>],
    nearby: &Nearby<'_>,
    seed: usize,
    along: [Vector2<f64>; 2],
    fits: impl Fn(usize, Cell) -> bool,
) -> Lattice {
    let mut lattice = Lattice::from([((0, 0), seed)]);
    let mut taken = BTreeMap::from([(seed, (0, 0))]);
    let mut queue = VecDeque::from([((0, 0), along)]);
    // A cell is left as soon as its neighbours are there; those that are missing are looked for again
    // from the other side.
    while let Some((cell, along)) = queue.pop_front() {
        let here = points[lattice[&cell]];
        for (k, step) in NEIGHBOURS.into_iter().enumerate() {
            let next = (cell.0 + step.0, cell.1 + step.1);
            if lattice.contains_key(&next) {
                continue;
            }
            let sign = if k < 2 { 1.0 } else { -1.0 };
            let vector = along[k % 2] * sign;
            // Two points in a row tell the third, perspective aside; else the vector found last.
            let before = lattice.get(&(cell.0 - step.0, cell.1 - step.1));
            let vector = before.map_or(vector, |&index| here - points[index]);
            let reach = TOLERANCE * vector.norm();
            let found = nearby.nearest(here + vector, reach, |index| {
                !taken.contains_key(&index) && fits(index, next)
            });
            let Some(index) = found else { continue };
            lattice.insert(next, index);
            taken.insert(index, next);
            let mut along = along;
            along[k % 2] = (points[index] - here) * sign;
            queue.push_back((next, along));
        }
    }
    lattice
}

/// The vectors from a cell to its neighbours to the right and below, from the points about it.
pub fn vectors(
    points: &[Vector2<f64>],
    lattice: &Lattice,
    cell: Cell,
) -> Option<[Vector2<f64>; 2]> {
    let here = points[*lattice.get(&cell)?];
    let along = |step: Cell| {
        let ahead = lattice.get(&(cell.0 + step.0, cell.1 + step.1)).map(|&i| points[i] - here);
        let behind = lattice.get(&(cell.0 - step.0, cell.1 - step.1)).map(|&i| here - points[i]);
        match (ahead, behind) {
            (Some(a), Some(b)) => Some((a + b) / 2.0),
            (one, other) => one.or(other),
        }
    };
    Some([along((1, 0))?, along((0, 1))?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_grid_with_gaps_and_strays_is_followed() {
        let mut points = Vec::new();
        let mut truth = BTreeMap::new();
        for j in 0..9 {
            for i in 0..12 {
                if (i, j) == (4, 4) || (i, j) == (7, 2) {
                    continue;
                }
                let (x, y) = (f64::from(i), f64::from(j));
                let w = 1.0 + 0.02 * x + 0.01 * y;
                truth.insert((i, j), points.len());
                points.push(Vector2::new(
                    (100.0 + 40.0 * x + 6.0 * y) / w,
                    (80.0 - 5.0 * x + 38.0 * y + 0.1 * x * x) / w,
                ));
            }
        }
        let strays = points.len();
        for p in points.clone() {
            points.push(p + Vector2::new(17.0, 15.0));
        }
        let nearby = Nearby::new(&points);
        let seed = truth[&(5, 5)];
        let along = [Vector2::new(30.0, -6.0), Vector2::new(2.0, 30.0)];
        let lattice = grow(&points, &nearby, seed, along, |_, _| true);
        assert_eq!(lattice.len(), truth.len());
        for ((i, j), index) in &lattice {
            assert!(*index < strays);
            assert_eq!(truth[&(i + 5, j + 5)], *index);
        }
    }
}
