//! The shortest program that gets depth from a sensor: `cargo run --release --example depth_frames`.
//!
//! The simulated sensor stands in for a real one; another source can be given as the argument.

use stspp::{ProjectionTiming, Sensor};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let source = std::env::args().nth(1).unwrap_or_else(|| "sim:".into());
    let mut sensor = Sensor::open(&source)?;
    sensor.set_timing(ProjectionTiming::default())?;
    for frame in sensor.stream()?.take(3) {
        let frame = frame?;
        println!("frame {}: {} points", frame.sequence, frame.valid_points());
        frame.point_cloud().write_ply("cloud.ply")?;
    }
    Ok(())
}
