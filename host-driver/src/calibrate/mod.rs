//! Stereo calibration from images of a board.
//!
//! [`detect`] finds the target points of a [`Board`] in images, [`solve`](solve::solve) turns them
//! into a calibration with its uncertainty ([`zhang`] starts, [`bundle`] adjusts), [`coverage`] and
//! [`findings`] say what the images lacked, [`report`] writes it down. [`print`] draws boards.

pub mod board;
pub mod bundle;
pub mod detect;
pub mod dictionary;
pub mod eccentricity;
pub mod homography;
pub mod observations;
#[cfg(feature = "sim")]
pub mod rendered;
pub mod solve;
pub mod tour;
pub mod zhang;

pub use board::{Board, BoardError, Pattern};
pub use observations::{Observations, Sighting, View};
pub use solve::{Solution, SolveError, solve};
