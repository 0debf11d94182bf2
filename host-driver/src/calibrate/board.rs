//! Calibration boards: what is printed where.
//!
//! A board's frame has its origin in the middle of the print, x to the right, y down, z into the
//! board, in metres. A target point has an index that both cameras know it by.

use std::fmt;
use std::str::FromStr;

use nalgebra::Point2;
use serde::Serialize;

use super::dictionary::{self, CODES, MARKER_MODULES};

/// Modules of a square of a ChArUco board: six of the marker and a white one on each side.
pub const SQUARE_MODULES: usize = MARKER_MODULES + 2;

/// Radius of a disc, and of the hole of a ring, in parts of the pitch.
const DISC_RADIUS: f64 = 0.3;
const HOLE_RADIUS: f64 = 0.12;

/// A kind of board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pattern {
    /// A chessboard with an ArUco marker in each white square; the points are its inner corners.
    Charuco,
    /// Discs on a grid, three of them hollow to tell where is up; the points are their centres.
    Circles,
}

/// A board: pattern, size and number of its cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Board {
    /// What is printed.
    pub pattern: Pattern,
    /// Squares, or discs, across.
    pub columns: usize,
    /// Squares, or discs, down.
    pub rows: usize,
    /// Side of a square, or distance of neighbouring discs, in metres.
    pub pitch_m: f64,
}

impl Default for Board {
    /// For a sheet of A3.
    fn default() -> Self {
        Self { pattern: Pattern::Charuco, columns: 11, rows: 8, pitch_m: 0.035 }
    }
}

/// A board that cannot be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("board `{given}`: {what}; expected PATTERN:COLUMNSxROWS:MM such as charuco:11x8:35")]
pub struct BoardError {
    /// What was given.
    pub given: String,
    /// What is wrong with it.
    pub what: String,
}

impl fmt::Display for Board {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = match self.pattern {
            Pattern::Charuco => "charuco",
            Pattern::Circles => "circles",
        };
        // Tenths of a micrometre, so that a pitch computed in metres prints as it was given.
        let mm = (self.pitch_m * 1e7).round() / 1e4;
        write!(f, "{name}:{}x{}:{mm}", self.columns, self.rows)
    }
}

impl FromStr for Board {
    type Err = BoardError;

    fn from_str(text: &str) -> Result<Self, BoardError> {
        let wrong = |what: &str| BoardError { given: text.to_owned(), what: what.to_owned() };
        let mut parts = text.split(':');
        let pattern = match parts.next() {
            Some("charuco") => Pattern::Charuco,
            Some("circles") => Pattern::Circles,
            _ => return Err(wrong("the pattern is charuco or circles")),
        };
        let (columns, rows) = parts
            .next()
            .and_then(|size| size.split_once('x'))
            .and_then(|(c, r)| Some((c.parse().ok()?, r.parse().ok()?)))
            .ok_or_else(|| wrong("the size is COLUMNSxROWS"))?;
        let mm: f64 = parts
            .next()
            .and_then(|mm| mm.trim_end_matches("mm").parse().ok())
            .ok_or_else(|| wrong("the side of a square, or the pitch of the discs, is in mm"))?;
        if parts.next().is_some() {
            return Err(wrong("three parts are expected"));
        }
        let board = Self { pattern, columns, rows, pitch_m: mm * 1e-3 };
        board.check().map_err(|what| wrong(&what))?;
        Ok(board)
    }
}

impl Board {
    /// Says what is wrong with the numbers.
    ///
    /// # Errors
    /// In words.
    pub fn check(&self) -> Result<(), String> {
        let least = match self.pattern {
            Pattern::Charuco => 4,
            Pattern::Circles => 5,
        };
        if self.columns < least || self.rows < least || self.columns > 60 || self.rows > 60 {
            return Err(format!("{least} to 60 columns and rows are possible"));
        }
        if self.pattern == Pattern::Charuco && self.markers() > CODES.len() {
            return Err(format!(
                "it has {} white squares, there are {} markers",
                self.markers(),
                CODES.len()
            ));
        }
        if !(1e-3..=0.5).contains(&self.pitch_m) {
            return Err("a pitch of 1 to 500 mm is possible".into());
        }
        Ok(())
    }

    /// Columns and rows of target points.
    pub fn points(&self) -> (usize, usize) {
        match self.pattern {
            Pattern::Charuco => (self.columns - 1, self.rows - 1),
            Pattern::Circles => (self.columns, self.rows),
        }
    }

    /// Number of target points.
    pub fn point_count(&self) -> usize {
        let (columns, rows) = self.points();
        columns * rows
    }

    /// Place of a target point in the board's plane, in metres.
    pub fn point_m(&self, index: usize) -> Point2<f64> {
        let (columns, rows) = self.points();
        let at = |k: usize, count: usize| (k as f64 - (count as f64 - 1.0) / 2.0) * self.pitch_m;
        Point2::new(at(index % columns, columns), at(index / columns, rows))
    }

    /// Width and height of the print in metres.
    pub fn size_m(&self) -> [f64; 2] {
        [self.columns as f64 * self.pitch_m, self.rows as f64 * self.pitch_m]
    }

    /// Radius of a disc in metres; `None` for a board without discs.
    pub fn disc_radius_m(&self) -> Option<f64> {
        (self.pattern == Pattern::Circles).then_some(DISC_RADIUS * self.pitch_m)
    }

    /// Radius of the white middle of a hollow disc in metres.
    pub fn hole_radius_m(&self) -> f64 {
        HOLE_RADIUS * self.pitch_m
    }

    /// Markers of a ChArUco board.
    pub fn markers(&self) -> usize {
        self.columns * self.rows / 2
    }

    /// The marker in square (`column`, `row`); `None` in black squares. The upper left square is
    /// black, and markers are numbered row by row.
    pub fn marker(&self, column: usize, row: usize) -> Option<usize> {
        // Black and white alternate along the rows; where a row begins white, the black square
        // before it (or after it) evens the count, so that half of the squares before are white.
        (!(column + row).is_multiple_of(2)).then_some((row * self.columns + column) / 2)
    }

    /// The hollow discs as (column, row): the corner of an L, the end of its long leg along x, the
    /// end of its short leg along y. No turn of the board, and no mirror, maps the L to itself.
    pub fn hollow(&self) -> [(usize, usize); 3] {
        let (column, row) = (self.columns.saturating_sub(2) / 2, self.rows.saturating_sub(2) / 2);
        [(column, row), (column + 2, row), (column, row + 1)]
    }

    /// Modules of a ChArUco board, row by row: (columns, rows, black). A module is
    /// 1/[`SQUARE_MODULES`] of a square.
    pub fn modules(&self) -> (usize, usize, Vec<bool>) {
        let (width, height) = (self.columns * SQUARE_MODULES, self.rows * SQUARE_MODULES);
        let black = (0..width * height)
            .map(|index| {
                let (x, y) = (index % width, index / width);
                let (column, row) = (x / SQUARE_MODULES, y / SQUARE_MODULES);
                let inside = |at: usize| (at % SQUARE_MODULES).checked_sub(1);
                match self.marker(column, row) {
                    None => true,
                    Some(id) => match (inside(x), inside(y)) {
                        (Some(x), Some(y)) if x.max(y) < MARKER_MODULES => {
                            !dictionary::is_white(id, x, y)
                        }
                        _ => false,
                    },
                }
            })
            .collect();
        (width, height, black)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boards_print_as_they_are_given() {
        for text in ["charuco:11x8:35", "circles:12x9:22.5", "charuco:4x4:1"] {
            assert_eq!(text.parse::<Board>().unwrap().to_string(), text);
        }
        for (text, what) in [
            ("chess:11x8:35", "charuco or circles"),
            ("charuco:11:35", "COLUMNSxROWS"),
            ("charuco:11x8", "in mm"),
            ("charuco:11x8:35:2", "three parts"),
            ("charuco:3x8:35", "4 to 60"),
            ("charuco:20x20:35", "100 markers"),
            ("circles:8x8:0.5", "1 to 500 mm"),
            ("circles:8x8:NaN", "1 to 500 mm"),
        ] {
            let error = text.parse::<Board>().unwrap_err().to_string();
            assert!(error.contains(what) && error.contains(text), "{error}");
        }
    }

    #[test]
    fn markers_are_numbered_row_by_row_over_the_white_squares() {
        for text in ["charuco:11x8:35", "charuco:6x5:20", "charuco:5x7:20"] {
            let board: Board = text.parse().unwrap();
            let mut next = 0;
            for row in 0..board.rows {
                for column in 0..board.columns {
                    if let Some(id) = board.marker(column, row) {
                        assert_eq!(id, next, "{text} {column} {row}");
                        next += 1;
                    }
                }
            }
            assert_eq!(next, board.markers());
        }
    }

    #[test]
    fn points_are_centred_and_a_pitch_apart() {
        let board = Board::default();
        let sum: nalgebra::Vector2<f64> =
            (0..board.point_count()).map(|i| board.point_m(i).coords).sum();
        assert!(sum.norm() < 1e-12);
        assert!((board.point_m(1).x - board.point_m(0).x - 0.035).abs() < 1e-12);
        assert!((board.point_m(10).y - board.point_m(0).y - 0.035).abs() < 1e-12);
    }
}
