//! Stereo calibration from images of a board.
//!
//! [`detect`] finds the target points of a [`Board`] in images, [`solve`](solve::solve) turns them
//! into a calibration with its uncertainty ([`zhang`] starts, [`bundle`] adjusts), [`coverage`] and
//! [`findings`] say what the images lacked, [`report`] writes it down. [`mod@print`] draws boards.

pub mod board;
pub mod bundle;
pub mod collect;
pub mod coverage;
pub mod date;
pub mod detect;
pub mod dictionary;
pub mod eccentricity;
pub mod findings;
pub mod homography;
pub mod images;
pub mod observations;
pub mod print;
#[cfg(feature = "sim")]
pub mod rendered;
pub mod report;
pub mod solve;
pub mod tour;
#[cfg(feature = "sim")]
pub mod trials;
pub mod zhang;

pub use board::{Board, BoardError, Pattern};
pub use observations::{Observations, Sighting, View};
pub use solve::{Solution, SolveError, solve};
