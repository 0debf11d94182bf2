//! What was seen: target points in the images of both cameras.

use nalgebra::Vector2;

use super::Board;

/// A target point in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// Its index on the board.
    pub point: usize,
    /// Where its centre is seen, in raw pixels.
    pub pixel: Vector2<f64>,
}

/// One pair of images of the board.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct View {
    /// How reports call it, such as "07".
    pub name: String,
    /// Points seen by the left camera.
    pub left: Vec<Sighting>,
    /// Points seen by the right camera.
    pub right: Vec<Sighting>,
}

impl View {
    /// The points seen by camera 0 (left) or 1.
    pub fn side(&self, side: usize) -> &[Sighting] {
        if side == 0 { &self.left } else { &self.right }
    }

    /// Points that both cameras saw: (point, left pixel, right pixel).
    pub fn shared(&self) -> impl Iterator<Item = (usize, Vector2<f64>, Vector2<f64>)> {
        self.left.iter().filter_map(|l| {
            let r = self.right.iter().find(|r| r.point == l.point)?;
            Some((l.point, l.pixel, r.pixel))
        })
    }
}

/// All views of one board by one rig.
#[derive(Debug, Clone, PartialEq)]
pub struct Observations {
    /// The board.
    pub board: Board,
    /// Size of both cameras' images.
    pub resolution_px: [usize; 2],
    /// The views.
    pub views: Vec<View>,
}
