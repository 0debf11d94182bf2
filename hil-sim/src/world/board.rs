//! Printed calibration targets.

/// A printed target of black and white modules in the object's xy plane, centred on its origin:
/// a chessboard, a marker, a ChArUco board whose markers are whole modules.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardTexture {
    columns: usize,
    rows: usize,
    module_m: f64,
    is_black: Vec<bool>,
    white_albedo: f64,
    black_albedo: f64,
}

impl BoardTexture {
    /// A target from its modules, row by row from the top as the camera sees it upright.
    ///
    /// # Panics
    /// If `is_black` is not `columns * rows` long or `module_m` is not positive.
    #[must_use]
    pub fn new(columns: usize, rows: usize, module_m: f64, is_black: Vec<bool>) -> Self {
        assert_eq!(is_black.len(), columns * rows, "one entry per module");
        assert!(module_m > 0.0, "modules have a size");
        Self { columns, rows, module_m, is_black, white_albedo: 0.8, black_albedo: 0.06 }
    }

    /// A chessboard, black in the upper left corner.
    #[must_use]
    pub fn chessboard(columns: usize, rows: usize, square_m: f64) -> Self {
        let is_black =
            (0..columns * rows).map(|i| (i % columns + i / columns).is_multiple_of(2)).collect();
        Self::new(columns, rows, square_m, is_black)
    }

    /// Width and height of the printed part.
    #[must_use]
    pub fn size_m(&self) -> [f64; 2] {
        [self.columns as f64 * self.module_m, self.rows as f64 * self.module_m]
    }

    /// Albedo at a point of the board's plane; the margin around the print is white.
    pub(crate) fn albedo(&self, x: f64, y: f64) -> f64 {
        let [width, height] = self.size_m();
        let column = ((x + width / 2.0) / self.module_m).floor();
        let row = ((y + height / 2.0) / self.module_m).floor();
        let is_inside =
            column >= 0.0 && row >= 0.0 && column < self.columns as f64 && row < self.rows as f64;
        if is_inside && self.is_black[row as usize * self.columns + column as usize] {
            self.black_albedo
        } else {
            self.white_albedo
        }
    }
}
