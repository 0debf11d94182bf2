//! Spatio-temporal speckle matching of rectified stereo stacks.
//!
//! Data flow: a [`StereoStack`] of N rectified pairs goes through census, Hamming cost, winner takes
//! all, parabola, reliability retry, left-right check, sub-pixel refinement by Stereo-DIC, growth into
//! the gaps, a try with single rows where surfaces are steep, the verdict on pixels at depth steps, and
//! comes out as a [`Matched`] disparity and ZNCC map. Each stage is a file.

mod aligned;
pub mod bspline;
pub mod census;
pub mod check;
pub mod coarse;
pub mod cost;
pub mod cpu_time;
pub mod dense;
pub mod error;
mod fast;
#[cfg(test)]
mod guarded;
pub mod icgn;
pub mod image;
mod lanes;
pub mod level;
pub mod machine;
pub mod matched;
mod memory;
pub mod parabola;
pub mod parallel;
pub mod params;
pub mod pipeline;
pub mod regions;
pub mod retry;
pub mod search;
pub mod stack;
pub mod steep;
pub mod step;
pub mod synthetic;
pub mod wta;
pub mod zncc;

pub use error::Error;
pub use image::{Image, Spares};
pub use level::Level;
pub use matched::{Matched, StageTime};
pub use params::{Advanced, DisparityRange, Interpolation, Method, Params, ShapeFunction};
pub use pipeline::Matcher;
pub use stack::{SAMPLES_PER_DN8, Sample, StereoStack};
