//! Printed calibration targets.

/// Albedo of the paper and of the ink: laser print in the near infrared.
const WHITE_ALBEDO: f64 = 0.8;
const BLACK_ALBEDO: f64 = 0.06;

/// A printed target in the object's xy plane, centred on its origin: x to the right and y down as a
/// camera sees it upright. Black on white, with a white margin.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardTexture {
    size_m: [f64; 2],
    print: Print,
}

/// What is black.
#[derive(Debug, Clone, PartialEq)]
enum Print {
    /// Square modules, row by row from the top.
    Modules { columns: usize, rows: usize, module_m: f64, is_black: Vec<bool> },
    /// Discs on a grid; those that are rings have a white middle.
    Discs {
        columns: usize,
        rows: usize,
        pitch_m: f64,
        radius_m: f64,
        hole_m: f64,
        rings: Vec<bool>,
    },
}

impl BoardTexture {
    /// A target from its modules, row by row from the top: a chessboard, a marker, a ChArUco board
    /// whose markers are whole modules.
    ///
    /// # Panics
    /// If `is_black` is not `columns * rows` long or `module_m` is not positive.
    #[must_use]
    pub fn new(columns: usize, rows: usize, module_m: f64, is_black: Vec<bool>) -> Self {
        assert_eq!(is_black.len(), columns * rows, "one entry per module");
        assert!(module_m > 0.0, "modules have a size");
        Self {
            size_m: [columns as f64 * module_m, rows as f64 * module_m],
            print: Print::Modules { columns, rows, module_m, is_black },
        }
    }

    /// A chessboard, black in the upper left corner.
    #[must_use]
    pub fn chessboard(columns: usize, rows: usize, square_m: f64) -> Self {
        let is_black =
            (0..columns * rows).map(|i| (i % columns + i / columns).is_multiple_of(2)).collect();
        Self::new(columns, rows, square_m, is_black)
    }

    /// A grid of discs `pitch_m` apart; where `rings` is true, a white disc of `hole_m` is in the
    /// middle of the black one. The print reaches half a pitch beyond the outer centres.
    ///
    /// # Panics
    /// If `rings` is not `columns * rows` long or the sizes do not fit into each other.
    #[must_use]
    pub fn discs(
        columns: usize,
        rows: usize,
        pitch_m: f64,
        radius_m: f64,
        hole_m: f64,
        rings: Vec<bool>,
    ) -> Self {
        assert_eq!(rings.len(), columns * rows, "one entry per disc");
        assert!(
            0.0 < hole_m && hole_m < radius_m && 2.0 * radius_m < pitch_m,
            "holes are in discs, discs do not touch"
        );
        Self {
            size_m: [columns as f64 * pitch_m, rows as f64 * pitch_m],
            print: Print::Discs { columns, rows, pitch_m, radius_m, hole_m, rings },
        }
    }

    /// The same print seen from behind, as through a film or after a copying mistake.
    #[must_use]
    pub fn mirrored(mut self) -> Self {
        fn mirror(columns: usize, cells: &mut [bool]) {
            cells.chunks_mut(columns).for_each(<[bool]>::reverse);
        }
        match &mut self.print {
            Print::Modules { columns, is_black, .. } => mirror(*columns, is_black),
            Print::Discs { columns, rings, .. } => mirror(*columns, rings),
        }
        self
    }

    /// Width and height of the printed part.
    #[must_use]
    pub fn size_m(&self) -> [f64; 2] {
        self.size_m
    }

    /// Albedo at a point of the board's plane; the margin around the print is white.
    pub(crate) fn albedo(&self, x: f64, y: f64) -> f64 {
        if self.is_black(x + self.size_m[0] / 2.0, y + self.size_m[1] / 2.0) {
            BLACK_ALBEDO
        } else {
            WHITE_ALBEDO
        }
    }

    /// Whether there is ink at a point, from the upper left corner.
    fn is_black(&self, x: f64, y: f64) -> bool {
        let cell = |pitch_m: f64, columns: usize, rows: usize| {
            let (column, row) = ((x / pitch_m).floor(), (y / pitch_m).floor());
            let is_inside =
                column >= 0.0 && row >= 0.0 && column < columns as f64 && row < rows as f64;
            is_inside.then_some((column as usize, row as usize))
        };
        match &self.print {
            Print::Modules { columns, rows, module_m, is_black } => {
                cell(*module_m, *columns, *rows).is_some_and(|(c, r)| is_black[r * columns + c])
            }
            Print::Discs { columns, rows, pitch_m, radius_m, hole_m, rings } => {
                cell(*pitch_m, *columns, *rows).is_some_and(|(c, r)| {
                    let from_centre =
                        (x - (c as f64 + 0.5) * pitch_m).hypot(y - (r as f64 + 0.5) * pitch_m);
                    from_centre <= *radius_m && !(rings[r * columns + c] && from_centre <= *hole_m)
                })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rings_are_white_in_the_middle_and_mirroring_moves_them() {
        let rings = vec![true, false, false, false, false, false];
        let board = BoardTexture::discs(3, 2, 0.03, 0.01, 0.004, rings);
        assert_eq!(board.size_m(), [0.09, 0.06]);
        assert_eq!(board.albedo(-0.03, -0.015), WHITE_ALBEDO);
        assert_eq!(board.albedo(-0.03, -0.015 + 0.007), BLACK_ALBEDO);
        assert_eq!(board.albedo(0.03, -0.015), BLACK_ALBEDO);
        assert_eq!(board.albedo(0.015, 0.0), WHITE_ALBEDO);
        let mirrored = board.mirrored();
        assert_eq!(mirrored.albedo(-0.03, -0.015), BLACK_ALBEDO);
        assert_eq!(mirrored.albedo(0.03, -0.015), WHITE_ALBEDO);
    }
}
