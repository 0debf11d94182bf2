//! Slow, obvious f64 versions of the stages, written from the paper's equations and from nothing else.

#![allow(dead_code)]

pub mod bspline;
pub mod census;
pub mod check;
pub mod icgn;
pub mod parabola;
pub mod wta;

/// One side of a stack: `[t][y][x]`, NaN outside the mask.
pub type Volume = Vec<Vec<Vec<f64>>>;

/// The sample at a place, if it is inside the image and its mask.
pub fn sample(volume: &Volume, t: usize, x: i64, y: i64) -> Option<f64> {
    let row = volume[t].get(usize::try_from(y).ok()?)?;
    let value = *row.get(usize::try_from(x).ok()?)?;
    (!value.is_nan()).then_some(value)
}
