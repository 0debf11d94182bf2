//! Boards of discs: dark spots, their outlines as ellipses, their grid, and the three hollow ones that
//! tell where the board begins. A plain grid, without hollow discs, is taken when it is seen whole.

use std::collections::BTreeMap;

use nalgebra::Vector2;
use rayon::prelude::*;
use stspp_matcher::Image;

use super::gray::Gray;
use super::lattice::{self, Cell, Lattice, Nearby};
use super::refine::{self, Ellipse, Refined};
use super::{BLUR_MAX_PX, Detection, Problem, Quality};
use crate::calibrate::Board;
use crate::calibrate::observations::Sighting;

/// Side of the window whose mean the spots are darker than, as a part of the image's width.
const WINDOW: f64 = 1.0 / 14.0;
/// How much darker than their surroundings, in grey values of 8 bits, at least.
const DARKER: f32 = 5.0;
/// Least and largest area of a spot in px.
const AREA_PX: std::ops::Range<usize> = 24..20_000;
/// Largest ratio of a spot's axes: a tilt of 70 degrees.
const ELONGATION_MAX: f64 = 3.0;
/// Discs in one line beside the board that make it another board.
const LINE: usize = 4;
/// Seeds from which a grid is grown.
const SEEDS: usize = 16;

/// A dark spot.
struct Spot {
    ellipse: Ellipse,
    /// Grey value in the middle and of the dark part.
    is_hollow: bool,
    dark: f64,
    light: f64,
}

/// Finds a board of discs in an image.
pub fn detect(gray: &Gray, board: &Board) -> Result<Detection, Problem> {
    let spots = spots(gray);
    let points: Vec<Vector2<f64>> = spots.iter().map(|spot| spot.ellipse.centre).collect();
    let nearby = Nearby::new(&points);
    let mut best = Lattice::new();
    let mut seeds = 0;
    // From the middle of all spots outwards: the board is where the spots are.
    let middle = points.iter().sum::<Vector2<f64>>() / points.len().max(1) as f64;
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|&a, &b| (points[a] - middle).norm().total_cmp(&(points[b] - middle).norm()));
    let mut tried = vec![false; points.len()];
    for &seed in &order {
        if tried[seed] || seeds == SEEDS {
            continue;
        }
        let Some(along) = seed_vectors(&points, seed) else { continue };
        seeds += 1;
        let size = |index: usize| spots[index].ellipse.shape[0] + spots[index].ellipse.shape[2];
        let lattice = lattice::grow(&points, &nearby, seed, along, |index, _| {
            (0.4..2.5).contains(&(size(index) / size(seed)))
        });
        lattice.values().for_each(|&index| tried[index] = true);
        if lattice.len() > best.len() {
            best = lattice;
        }
    }
    if best.len() < 6 {
        return Err(Problem::NoBoard { corners: points.len() });
    }
    let placement = match placed(&spots, &points, &best, board) {
        // Out of focus the hollow discs fill up first.
        Err(Problem::NoOrigin { hollow }) => {
            let all: Vec<(usize, usize)> = best.values().map(|spot| (*spot, *spot)).collect();
            let blur_px = Quality::of(refined(gray, &spots, &all).iter().map(|(_, r)| r)).blur_px;
            let is_blurred = blur_px > BLUR_MAX_PX;
            return Err(if is_blurred {
                Problem::Blurred { blur_px }
            } else {
                Problem::NoOrigin { hollow }
            });
        }
        placed => placed?,
    };
    let inside: Vec<(usize, usize)> =
        best.iter().filter_map(|(cell, spot)| Some((placement.point(*cell)?, *spot))).collect();
    let strays = best.len() - inside.len();
    if strays > inside.len() / 4 || placement.has_line_beside(best.keys()) {
        return Err(Problem::OtherBoard { markers: strays });
    }
    let refined = refined(gray, &spots, &inside);
    let mut quality = Quality::of(refined.iter().map(|(_, r)| r));
    quality.strays = strays;
    let sightings =
        refined.into_iter().map(|(point, r)| Sighting { point, pixel: r.pixel }).collect();
    Ok(Detection { sightings, quality })
}

/// Exact outlines of spots, given with what they are to be called.
fn refined(gray: &Gray, spots: &[Spot], wanted: &[(usize, usize)]) -> Vec<(usize, Refined)> {
    wanted
        .par_iter()
        .filter_map(|&(point, spot)| {
            let Spot { ellipse, dark, light, .. } = spots[spot];
            Some((point, refine::disc(gray, ellipse, light, dark)?))
        })
        .collect()
}

/// Mean grey value of a window about each pixel, by an integral image.
fn local_mean(gray: &Gray) -> Image<f32> {
    let (w, h) = (gray.width(), gray.height());
    let reach = ((w as f64 * WINDOW) as usize / 2).max(4);
    let mut sums = vec![0.0_f64; (w + 1) * (h + 1)];
    for y in 0..h {
        let mut line = 0.0;
        for (x, value) in gray.pixels.row(y).iter().enumerate() {
            line += f64::from(*value);
            sums[(y + 1) * (w + 1) + x + 1] = sums[y * (w + 1) + x + 1] + line;
        }
    }
    let mut mean = Image::new(w, h, 0.0_f32);
    for y in 0..h {
        let (top, bottom) = (y.saturating_sub(reach), (y + reach + 1).min(h));
        for (x, out) in mean.row_mut(y).iter_mut().enumerate() {
            let (left, right) = (x.saturating_sub(reach), (x + reach + 1).min(w));
            let at = |x: usize, y: usize| sums[y * (w + 1) + x];
            let sum = at(right, bottom) - at(left, bottom) - at(right, top) + at(left, top);
            *out = (sum / ((right - left) * (bottom - top)) as f64) as f32;
        }
    }
    mean
}

/// The connected dark spots that look like discs or rings.
fn spots(gray: &Gray) -> Vec<Spot> {
    let mean = local_mean(gray);
    let (w, h) = (gray.width(), gray.height());
    let is_dark: Vec<bool> = gray
        .pixels
        .as_slice()
        .iter()
        .zip(mean.as_slice())
        .map(|(value, mean)| *value < mean - DARKER)
        .collect();
    let mut seen = vec![false; w * h];
    let mut spots = Vec::new();
    let mut stack = Vec::new();
    for first in 0..w * h {
        if !is_dark[first] || seen[first] {
            continue;
        }
        let mut pixels = Vec::new();
        let mut touches_border = false;
        stack.push(first);
        seen[first] = true;
        while let Some(index) = stack.pop() {
            pixels.push(index);
            let (x, y) = (index % w, index / w);
            if x == 0 || y == 0 || x + 1 == w || y + 1 == h {
                touches_border = true;
                continue;
            }
            for next in [index - 1, index + 1, index - w, index + w] {
                if is_dark[next] && !seen[next] {
                    seen[next] = true;
                    stack.push(next);
                }
            }
        }
        if !touches_border && AREA_PX.contains(&pixels.len()) {
            spots.extend(spot(gray, &pixels));
        }
    }
    spots
}

/// A spot from its pixels; `None` when it is not the image of a disc or ring.
fn spot(gray: &Gray, pixels: &[usize]) -> Option<Spot> {
    let w = gray.width();
    let n = pixels.len() as f64;
    let place = |index: usize| Vector2::new((index % w) as f64, (index / w) as f64);
    let centre = pixels.iter().map(|&i| place(i)).sum::<Vector2<f64>>() / n;
    let (mut xx, mut xy, mut yy) = (1.0 / 12.0, 0.0, 1.0 / 12.0);
    for &index in pixels {
        let d = place(index) - centre;
        xx += d.x * d.x / n;
        xy += d.x * d.y / n;
        yy += d.y * d.y / n;
    }
    let (mean, difference) = ((xx + yy) / 2.0, (xx - yy) / 2.0);
    let spread = difference.hypot(xy);
    let (largest, least) = (mean + spread, mean - spread);
    if least <= 0.0 || (largest / least).sqrt() > ELONGATION_MAX {
        return None;
    }
    // A full ellipse of these moments has this area; a ring less, and nothing else much more.
    let full = 4.0 * std::f64::consts::PI * (largest * least).sqrt();
    let filled = n / full;
    let dark = pixels.iter().map(|&i| f64::from(gray.pixels.as_slice()[i])).sum::<f64>() / n;
    let middle = gray.at(centre);
    let radius = 2.0 * largest.sqrt();
    let light = (0..16)
        .map(|k| {
            let angle = f64::from(k) / 16.0 * std::f64::consts::TAU;
            gray.at(centre + Vector2::new(angle.cos(), angle.sin()) * (1.25 * radius + 2.0))
        })
        .fold(f64::NEG_INFINITY, f64::max);
    let is_hollow = middle > dark + 0.3 * (light - dark);
    // A ring's moments are larger than those of the disc with its outline: by 1 + 0.4^2 for a hole of
    // 0.4 radii.
    let (expected, shrink) = if is_hollow { (0.72, 1.16) } else { (1.0, 1.0) };
    if !(0.75..1.2).contains(&(filled / expected)) {
        return None;
    }
    let shape = [xx, xy, yy].map(|v| 4.0 * v / shrink);
    Some(Spot { ellipse: Ellipse { centre, shape }, is_hollow, dark, light })
}

/// Vectors to the neighbours of a spot: of its four nearest, two opposite pairs. Right-handed.
fn seed_vectors(points: &[Vector2<f64>], seed: usize) -> Option<[Vector2<f64>; 2]> {
    let mut near: Vec<Vector2<f64>> = (0..points.len())
        .filter(|&index| index != seed)
        .map(|index| points[index] - points[seed])
        .collect();
    near.sort_by(|a, b| a.norm().total_cmp(&b.norm()));
    near.truncate(4);
    let first = *near.first()?;
    let is_opposite = |a: &Vector2<f64>, b: &Vector2<f64>| (a + b).norm() < 0.3 * a.norm();
    let opposite = near.iter().position(|v| is_opposite(&first, v))?;
    let rest: Vec<_> = (1..near.len()).filter(|&k| k != opposite).map(|k| near[k]).collect();
    let [second, third] = rest[..] else { return None };
    if !is_opposite(&second, &third) {
        return None;
    }
    Some(if first.perp(&second) > 0.0 { [first, second] } else { [first, -second] })
}

/// Where the board lies on the lattice.
struct Placement {
    /// A cell, and the column and row that it is on the board.
    cell: Cell,
    column: i32,
    row: i32,
    /// Steps on the lattice along the board's columns and rows.
    along: Cell,
    down: Cell,
    /// Size of the board.
    columns: i32,
    rows: i32,
}

impl Placement {
    /// Index of the board's point in a cell; `None` beside the board.
    fn point(&self, cell: Cell) -> Option<usize> {
        let (column, row) = self.place(cell);
        let inside = (0..self.columns).contains(&column) && (0..self.rows).contains(&row);
        inside.then(|| (row * self.columns + column) as usize)
    }

    /// Column and row of a cell, on the board or beside it.
    fn place(&self, cell: Cell) -> (i32, i32) {
        let d = minus(cell, self.cell);
        (
            self.column + d.0 * self.along.0 + d.1 * self.along.1,
            self.row + d.0 * self.down.0 + d.1 * self.down.1,
        )
    }

    /// Whether several discs stand in one line beside the board: then it is a larger one. Single spots
    /// of a background may be anywhere.
    fn has_line_beside<'a>(&self, cells: impl Iterator<Item = &'a Cell>) -> bool {
        let mut beside: BTreeMap<(bool, i32), usize> = BTreeMap::new();
        for cell in cells {
            let (column, row) = self.place(*cell);
            let is_in = [(0..self.columns).contains(&column), (0..self.rows).contains(&row)];
            match is_in {
                [true, false] => *beside.entry((true, row)).or_default() += 1,
                [false, true] => *beside.entry((false, column)).or_default() += 1,
                _ => {}
            }
        }
        beside.values().any(|count| *count >= LINE)
    }
}

fn minus(p: Cell, q: Cell) -> Cell {
    (p.0 - q.0, p.1 - q.1)
}

/// Where the board lies, from the hollow discs, or from the outline when there are none.
fn placed(
    spots: &[Spot],
    points: &[Vector2<f64>],
    lattice: &Lattice,
    board: &Board,
) -> Result<Placement, Problem> {
    let hollow: Vec<Cell> =
        lattice.iter().filter(|(_, spot)| spots[**spot].is_hollow).map(|(cell, _)| *cell).collect();
    let [a, b, c] = hollow[..] else {
        let plain = if hollow.is_empty() { placed_whole(points, lattice, board) } else { None };
        return plain.ok_or(Problem::NoOrigin { hollow: hollow.len() });
    };
    let mut found = None;
    let mut is_mirrored = false;
    for [corner, long, short] in [[a, b, c], [a, c, b], [b, a, c], [b, c, a], [c, a, b], [c, b, a]]
    {
        let (x, y) = (minus(long, corner), minus(short, corner));
        let is_l = x.0 * y.0 + x.1 * y.1 == 0
            && x.0.abs() + x.1.abs() == 2
            && (x.0 == 0 || x.1 == 0)
            && y.0.abs() + y.1.abs() == 1;
        if is_l {
            let (x, y) = ((x.0 / 2, x.1 / 2), y);
            // The grid's own directions are right-handed, and so are the board's.
            if x.0 * y.1 - x.1 * y.0 == 1 {
                found = Some((corner, x, y));
            } else {
                is_mirrored = true;
            }
        }
    }
    let Some((corner, x, y)) = found else {
        return Err(if is_mirrored {
            Problem::Mirrored
        } else {
            Problem::NoOrigin { hollow: hollow.len() }
        });
    };
    let [(column, row), ..] = board.hollow();
    Ok(Placement {
        cell: corner,
        column: column as i32,
        row: row as i32,
        along: x,
        down: y,
        columns: board.columns as i32,
        rows: board.rows as i32,
    })
}

/// Where a plain grid lies that is seen whole, by its outline: `None` for a part of one, or for one as
/// high as wide. Half a turn of such a board changes nothing but the numbers of its points; both cameras,
/// which stand upright beside each other, must only choose alike. So its rows run to the right and rather
/// up than down: nobody holds a board just along the line where that choice tips over.
fn placed_whole(points: &[Vector2<f64>], lattice: &Lattice, board: &Board) -> Option<Placement> {
    let (columns, rows) = (board.columns as i32, board.rows as i32);
    let first = (lattice.keys().map(|c| c.0).min()?, lattice.keys().map(|c| c.1).min()?);
    let last = (lattice.keys().map(|c| c.0).max()?, lattice.keys().map(|c| c.1).max()?);
    let size = (last.0 - first.0 + 1, last.1 - first.1 + 1);
    let is_whole = lattice.len() == board.columns * board.rows;
    // The lattice's directions are right-handed, and so are the board's: a quarter or half turns only.
    let (along, down, end) = match size {
        _ if !is_whole || columns == rows => return None,
        size if size == (columns, rows) => ((1, 0), (0, 1), (last.0, first.1)),
        size if size == (rows, columns) => ((0, 1), (-1, 0), (last.0, last.1)),
        _ => return None,
    };
    let start = if along == (1, 0) { first } else { (last.0, first.1) };
    let row = points[*lattice.get(&end)?] - points[*lattice.get(&start)?];
    let (cell, along, down) = if row.x - 0.5 * row.y > 0.0 {
        (start, along, down)
    } else {
        let opposite = (first.0 + last.0 - start.0, first.1 + last.1 - start.1);
        (opposite, (-along.0, -along.1), (-down.0, -down.1))
    };
    Some(Placement { cell, column: 0, row: 0, along, down, columns, rows })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A lattice whose own directions are turned by `quarters` against a 6 x 5 grid in the image, which
    /// itself is rolled by `roll` radians.
    fn grid(quarters: u32, roll: f64) -> (Vec<Vector2<f64>>, Lattice) {
        let mut points = Vec::new();
        let mut lattice = Lattice::new();
        for row in 0..5 {
            for column in 0..6 {
                let (x, y) = (20.0 * f64::from(column), 20.0 * f64::from(row));
                let mut cell = (column, row);
                for _ in 0..quarters {
                    cell = (cell.1, -cell.0);
                }
                lattice.insert((cell.0 + 7, cell.1 - 3), points.len());
                let (sin, cos) = roll.sin_cos();
                points.push(Vector2::new(cos * x - sin * y, sin * x + cos * y));
            }
        }
        (points, lattice)
    }

    #[test]
    fn a_plain_grid_seen_whole_is_numbered_alike_however_it_was_found() {
        let board: Board = "circles:6x5:20".parse().expect("a board");
        for quarters in 0..4 {
            for (roll, is_turned) in
                [(0.0, false), (0.7, false), (1.5, true), (3.1, true), (-1.5, false)]
            {
                let (points, lattice) = grid(quarters, roll);
                let placement = placed_whole(&points, &lattice, &board).expect("whole");
                for (cell, &index) in &lattice {
                    let expected = if is_turned { 29 - index } else { index };
                    assert_eq!(placement.point(*cell), Some(expected), "{quarters} {roll}");
                }
            }
        }
        let (points, mut lattice) = grid(0, 0.0);
        lattice.pop_first();
        assert!(placed_whole(&points, &lattice, &board).is_none());
    }
}
