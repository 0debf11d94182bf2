//! Spatio-temporal speckle matching of rectified stereo stacks.
//!
//! Data flow: a [`StereoStack`] of N rectified pairs goes through census, Hamming cost, winner takes
//! all, parabola, reliability retry, left-right check, sub-pixel refinement by Stereo-DIC, and comes
//! out as a [`Matched`] disparity and ZNCC map. Each stage is a file.

pub mod error;
pub mod image;
pub mod matched;
pub mod params;
pub mod stack;

pub use error::Error;
pub use image::Image;
pub use matched::{Matched, StageTime};
pub use params::{Advanced, DisparityRange, Method, Params, ShapeFunction};
pub use stack::{SAMPLES_PER_DN8, Sample, StereoStack};
