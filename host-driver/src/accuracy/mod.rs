//! Accuracy on the simulated sensor: recordings of known scenes, reconstructed and compared with the
//! truth behind every pixel.

pub mod bound;
pub mod budget;
pub mod capture;
pub mod circles;
pub mod compare;
pub mod maps;
pub mod resampling;
pub mod score;
pub mod similar;
pub mod tables;
pub mod truth;

pub use capture::Capture;
pub use score::Score;
pub use truth::CanvasTruth;
