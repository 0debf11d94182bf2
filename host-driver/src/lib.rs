//! Driver of the stspp 3D sensor: calibration, rectification, depth frames, recordings and their
//! files.
//!
//! Lengths are metres, the frame is the left camera's optical frame (+x right, +y down, +z forward,
//! origin at the centre of the unrectified camera 0), transforms are named `a_from_b`, an invalid
//! pixel is NaN.
//!
//! ```no_run
//! let mut sensor = stspp::Sensor::open("sim:")?;
//! sensor.set_timing(stspp::ProjectionTiming::default())?;
//! for frame in sensor.stream()? {
//!     frame?.point_cloud().write_ply("cloud.ply")?;
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#[cfg(feature = "sim")]
pub mod accuracy;
pub mod calibrate;
pub mod calibration;
pub mod check;
pub mod cpu_time;
#[cfg(feature = "sim")]
pub mod experiment;
pub mod export;
pub mod frame;
pub mod fuse;
pub mod geometry;
pub mod image_io;
pub mod measure;
pub mod raw;
pub mod reconstruct;
pub mod recording;
pub mod rectify;
pub mod register;
pub mod report;
pub mod reproject;

// The live part: from sources to depth frames.
pub mod camera;
pub mod clock;
pub mod error;
pub mod pipeline;
pub mod sensor;
#[cfg(feature = "sim")]
pub mod sim;
pub mod sync;
pub mod timing;
pub mod transport;
pub mod uri;

pub use calibration::{CameraIntrinsics, StereoCalibration};
pub use frame::{DepthFrame, PointCloud, SlotLabel};
pub use geometry::RectifiedGeometry;
pub use raw::RawImage;
pub use recording::Recording;
pub use rectify::{Canvas, DepthRange, Rectifier};

pub use error::Error;
pub use pipeline::{
    BudgetPolicy, DepthStream, LabelledPair, PairStream, StreamOptions, StreamStats,
};
pub use sensor::{Sensor, SensorInfo};
pub use stspp_protocol::timing::{ProjectionTiming, Slot};
pub use stspp_protocol::trigger::{ExternalTrigger, TriggerEdge, TriggerInput, TriggerSource};
pub use uri::{SourceUri, UriError};
