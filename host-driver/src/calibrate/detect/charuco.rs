//! ChArUco boards: corners by ChESS (Bennett and Lasenby 2014, crate `chess-corners`), their grid, and
//! the markers that tell which corner is which.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use chess_corners::{CornerDescriptor, Detector, DetectorConfig};
use nalgebra::{Point2, Vector2};
use rayon::prelude::*;

use super::gray::Gray;
use super::lattice::{self, Cell, Lattice, Nearby};
use super::refine::{self, Refined};
use super::{Detection, Problem, Quality};
use crate::calibrate::board::SQUARE_MODULES;
use crate::calibrate::dictionary::{self, CODES, MARKER_MODULES};
use crate::calibrate::observations::Sighting;
use crate::calibrate::{Board, homography};

/// Least response of a corner: half of what contrast 6 of 255 gives.
const RESPONSE_MIN: f32 = 15.0;
/// Widest angle between an axis of a corner and the direction to its neighbour.
const ANGLE_MAX: f64 = 0.28;
/// Seeds from which a grid is grown before the largest is taken.
const SEEDS: usize = 24;
/// Share of the board's points at which no other seed is tried.
const ENOUGH: f64 = 0.6;
/// Wrong modules that a marker's black border may have.
const BORDER_ERRORS_MAX: usize = 3;
/// Markers that have to agree on where the board is.
const VOTES_MIN: usize = 2;

/// Angle between two lines, 0 to half pi.
fn between(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(PI);
    d.min(PI - d)
}

struct Corner {
    /// Directions of the edges; the dark squares are between the first and the second, clockwise as
    /// seen in the image.
    axes: [f64; 2],
}

/// Finds a ChArUco board in an image.
pub fn detect(gray: &Gray, board: &Board) -> Result<Detection, Problem> {
    let config = DetectorConfig::chess().with_threshold(RESPONSE_MIN);
    let seen = Detector::new(config)
        .and_then(|mut d| d.detect_u8(&gray.to_u8(), gray.width() as u32, gray.height() as u32))
        .map_err(|error| Problem::Detector(error.to_string()))?;
    let seen: Vec<&CornerDescriptor> = seen.iter().filter(|c| c.axes.is_some()).collect();
    let points: Vec<Vector2<f64>> =
        seen.iter().map(|c| Vector2::new(f64::from(c.x), f64::from(c.y))).collect();
    let corners: Vec<Corner> = seen
        .iter()
        .filter_map(|c| Some(Corner { axes: c.axes?.map(|axis| f64::from(axis.angle)) }))
        .collect();
    let mut strongest: Vec<usize> = (0..points.len()).collect();
    strongest.sort_by(|&a, &b| seen[b].response.total_cmp(&seen[a].response));
    let nearby = Nearby::new(&points);
    // Markers have corners of their own: a board's grid is the one that its markers agree on.
    let mut best: Option<(Placement, Lattice)> = None;
    let mut tried: BTreeMap<usize, ()> = BTreeMap::new();
    let mut seeds = 0;
    for &seed in &strongest {
        if tried.contains_key(&seed) {
            continue;
        }
        let Some(along) = seed_vectors(&points, &corners, &nearby, seed) else { continue };
        seeds += 1;
        if seeds > SEEDS {
            break;
        }
        let lattice = lattice::grow(&points, &nearby, seed, along, |index, cell| {
            // Black and white change places from corner to corner.
            let same = (cell.0 + cell.1).rem_euclid(2) == 0;
            let [a, b] = corners[seed].axes;
            let [c, d] = corners[index].axes;
            let (c, d) = if same { (c, d) } else { (d, c) };
            between(a, c) < 0.6 && between(b, d) < 0.6
        });
        tried.extend(lattice.values().map(|&index| (index, ())));
        if lattice.len() < 4 {
            continue;
        }
        let placement = place(gray, board, &points, &lattice);
        let points_known = lattice.len();
        let is_better = best.as_ref().is_none_or(|(known, grown)| {
            (placement.votes, points_known) > (known.votes, grown.len())
        });
        if is_better {
            best = Some((placement, lattice));
        }
        let enough = ENOUGH * board.point_count() as f64;
        if best
            .as_ref()
            .is_some_and(|(p, grown)| p.votes >= VOTES_MIN && grown.len() as f64 >= enough)
        {
            break;
        }
    }
    let Some((placement, lattice)) = best else {
        return Err(Problem::NoBoard { corners: points.len() });
    };
    placement.check(&lattice)?;
    let refined = refined(gray, board, &points, &lattice, &placement);
    let mut quality = Quality::of(refined.iter().map(|(_, r)| r));
    quality.strays = placement.strays;
    let sightings = refined
        .into_iter()
        .map(|(point, refined)| Sighting { point, pixel: refined.pixel })
        .collect();
    Ok(Detection { sightings, quality })
}

/// Vectors from a corner to its neighbours along its axes, right-handed.
fn seed_vectors(
    points: &[Vector2<f64>],
    corners: &[Corner],
    nearby: &Nearby<'_>,
    seed: usize,
) -> Option<[Vector2<f64>; 2]> {
    let along = |axis: f64| {
        for reach in [24.0, 48.0, 96.0, 192.0] {
            let found = nearby
                .within(points[seed], reach)
                .filter(|&index| {
                    let v = points[index] - points[seed];
                    index != seed
                        && v.norm() > 5.0
                        && between(v.y.atan2(v.x), axis) < ANGLE_MAX
                        && between(corners[index].axes[0], corners[seed].axes[1]) < 0.4
                        && between(corners[index].axes[1], corners[seed].axes[0]) < 0.4
                })
                .min_by(|&a, &b| {
                    let distance = |index: usize| (points[index] - points[seed]).norm();
                    distance(a).total_cmp(&distance(b))
                });
            if let Some(index) = found {
                return Some(points[index] - points[seed]);
            }
        }
        None
    };
    let [a, b] = corners[seed].axes;
    let (first, second) = (along(a)?, along(b)?);
    let handed = first.perp(&second);
    Some(if handed > 0.0 { [first, second] } else { [first, -second] })
}

/// Where the board lies on a lattice: board square (column, row) of the square whose upper left corner
/// is cell (0, 0), and quarters by which the board is turned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Pose {
    quarters: usize,
    column: i32,
    row: i32,
}

struct Placement {
    pose: Option<Pose>,
    votes: usize,
    /// Markers that were read and say something else.
    strays: usize,
    /// Votes for the best placement of the mirrored board.
    mirrored: usize,
    /// Markers read at all.
    read: usize,
}

/// Direction (column, row) on the board of one cell to the right, and of one cell down, on a lattice
/// on which the board is turned by `quarters` clockwise.
fn turned_steps(quarters: usize) -> [(i32, i32); 2] {
    match quarters % 4 {
        0 => [(1, 0), (0, 1)],
        1 => [(0, -1), (1, 0)],
        2 => [(-1, 0), (0, -1)],
        _ => [(0, 1), (-1, 0)],
    }
}

impl Pose {
    /// Board square of the square right of and below a cell.
    fn square(&self, cell: Cell) -> (i32, i32) {
        let [right, down] = turned_steps(self.quarters);
        (
            self.column + right.0 * cell.0 + down.0 * cell.1,
            self.row + right.1 * cell.0 + down.1 * cell.1,
        )
    }

    /// Index of the board's inner corner at a cell.
    fn point(&self, cell: Cell, board: &Board) -> Option<usize> {
        // A cell is the upper left corner of its square on the lattice; on the board it is another
        // corner of that square when the board is turned.
        let (column, row) = self.square(cell);
        let (dx, dy) = match self.quarters % 4 {
            0 => (0, 0),
            1 => (0, 1),
            2 => (1, 1),
            _ => (1, 0),
        };
        let (column, row) = (column + dx - 1, row + dy - 1);
        let (columns, rows) = board.points();
        let inside = (0..columns as i32).contains(&column) && (0..rows as i32).contains(&row);
        inside.then(|| row as usize * columns + column as usize)
    }
}

impl Placement {
    fn check(&self, lattice: &Lattice) -> Result<(), Problem> {
        if self.mirrored >= VOTES_MIN && self.mirrored > 2 * self.votes {
            return Err(Problem::Mirrored);
        }
        if self.votes < VOTES_MIN {
            return Err(if self.read >= VOTES_MIN {
                Problem::OtherBoard { markers: self.read }
            } else {
                Problem::NoMarkers { corners: lattice.len() }
            });
        }
        if self.strays > self.votes {
            return Err(Problem::OtherBoard { markers: self.strays });
        }
        Ok(())
    }
}

/// Reads the markers of all squares and lets them vote.
fn place(gray: &Gray, board: &Board, points: &[Vector2<f64>], lattice: &Lattice) -> Placement {
    let mut votes: BTreeMap<Pose, usize> = BTreeMap::new();
    let mut mirrored: BTreeMap<Pose, usize> = BTreeMap::new();
    let mut read = 0;
    for &cell in lattice.keys() {
        let Some(code) = read_marker(gray, points, lattice, cell) else { continue };
        let vote = |votes: &mut BTreeMap<Pose, usize>, code: u16, is_mirrored: bool| {
            // All markers of the dictionary: those beyond the board's own show another board.
            let Some((id, to_upright)) = dictionary::decode(code, CODES.len(), 1) else {
                return false;
            };
            let quarters = (4 - to_upright) % 4;
            if let Some(pose) = pose_of(board, id, quarters, cell, is_mirrored) {
                *votes.entry(pose).or_default() += 1;
            }
            true
        };
        read += usize::from(vote(&mut votes, code, false));
        vote(&mut mirrored, dictionary::mirrored(code), true);
    }
    let most = |votes: &BTreeMap<Pose, usize>| {
        votes.iter().max_by_key(|(_, count)| **count).map(|(pose, count)| (*pose, *count))
    };
    let (pose, votes) = most(&votes).map_or((None, 0), |(pose, count)| (Some(pose), count));
    let mirrored = most(&mirrored).map_or(0, |(_, count)| count);
    Placement { pose, votes, strays: read.saturating_sub(votes), mirrored, read }
}

/// The placement that puts marker `id`, seen turned by `quarters`, into the square of `cell`. On a
/// mirrored board columns run backwards, which is undone by counting cells backwards.
fn pose_of(
    board: &Board,
    id: usize,
    quarters: usize,
    cell: Cell,
    is_mirrored: bool,
) -> Option<Pose> {
    let (column, row) = (0..board.rows)
        .flat_map(|row| (0..board.columns).map(move |column| (column, row)))
        .find(|&(column, row)| board.marker(column, row) == Some(id))?;
    let cell = if is_mirrored { (-cell.0, cell.1) } else { cell };
    let [right, down] = turned_steps(quarters);
    Some(Pose {
        quarters,
        column: column as i32 - right.0 * cell.0 - down.0 * cell.1,
        row: row as i32 - right.1 * cell.0 - down.1 * cell.1,
    })
}

/// The bits of the marker in the square right of and below a cell; `None` when there is none.
fn read_marker(
    gray: &Gray,
    points: &[Vector2<f64>],
    lattice: &Lattice,
    (i, j): Cell,
) -> Option<u16> {
    let at = |cell: Cell| lattice.get(&cell).map(|&index| Point2::from(points[index]));
    let to = [at((i, j))?, at((i + 1, j))?, at((i + 1, j + 1))?, at((i, j + 1))?];
    let from = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Point2::new(x, y));
    let pixel_of_square = homography::fit(&from, &to)?;
    let module = |column: usize, row: usize| {
        let mut sum = 0.0;
        for k in 0..9 {
            let (dx, dy) = ((k % 3) as f64 * 0.2 - 0.2, (k / 3) as f64 * 0.2 - 0.2);
            let x = (column as f64 + 0.5 + dx) / SQUARE_MODULES as f64;
            let y = (row as f64 + 0.5 + dy) / SQUARE_MODULES as f64;
            sum += gray.at(homography::map(&pixel_of_square, Point2::new(x, y))?.coords);
        }
        Some(sum / 9.0)
    };
    let mut values = [[0.0; SQUARE_MODULES]; SQUARE_MODULES];
    for (row, line) in values.iter_mut().enumerate() {
        for (column, value) in line.iter_mut().enumerate() {
            *value = module(column, row)?;
        }
    }
    // White is the margin around the marker, black its border.
    let last = SQUARE_MODULES - 1;
    let ring = |inset: usize| {
        let values = &values;
        (0..SQUARE_MODULES)
            .flat_map(move |row| (0..SQUARE_MODULES).map(move |column| (column, row)))
            .filter(move |&(c, r)| c.min(r).min(last - c).min(last - r) == inset)
            .map(move |(c, r)| values[r][c])
    };
    let mean = |inset: usize| {
        let (sum, count) = ring(inset).fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
        sum / count
    };
    let (white, black) = (mean(0), mean(1));
    if white - black < 6.0 {
        return None;
    }
    let middle = (white + black) / 2.0;
    if ring(1).filter(|v| *v > middle).count() > BORDER_ERRORS_MAX {
        return None;
    }
    let mut code = 0_u16;
    for value in values[2..MARKER_MODULES].iter().flat_map(|row| &row[2..MARKER_MODULES]) {
        code = code << 1 | u16::from(*value > middle);
    }
    Some(code)
}

/// The board's points with their refined places.
fn refined(
    gray: &Gray,
    board: &Board,
    points: &[Vector2<f64>],
    lattice: &Lattice,
    placement: &Placement,
) -> Vec<(usize, Refined)> {
    let Some(pose) = placement.pose else { return Vec::new() };
    let cells: Vec<(Cell, usize)> = lattice.iter().map(|(cell, index)| (*cell, *index)).collect();
    let clear = 1.0 / SQUARE_MODULES as f64;
    cells
        .par_iter()
        .filter_map(|&(cell, index)| {
            let point = pose.point(cell, board)?;
            let along = lattice::vectors(points, lattice, cell)?;
            Some((point, refine::corner(gray, points[index], along, clear)?))
        })
        .collect()
}
