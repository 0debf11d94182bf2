//! Hardware-in-the-loop simulator of the stspp sensor.
//!
//! [`world`] is what light does: scene, projectors, cameras, noise. [`device`] is what the sensor's
//! controller does: protocol in, pin edges out. A camera joins them: it integrates the light over the
//! gate waveform that the controller produced: [`rig`]. [`front`] shows the same sensor to other
//! programs.

pub mod device;
pub mod front;
pub mod rig;
pub mod world;
