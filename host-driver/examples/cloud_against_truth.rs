//! How far a point cloud is from what was really there: for clouds of the simulated sensor that were
//! computed elsewhere, such as in the machine of `cargo xtask e2e`.
//!
//! `cargo run --release --example cloud_against_truth -- CLOUD.ply 'sim:sphere?scale=2'` prints JSON:
//! points, the part of them within 5 mm of the surface along their ray, the RMS of those' errors, and the
//! median of their magnitudes, which the few points at depth steps do not move.

use stspp::PointCloud;
use stspp::sim::{SimOptions, SimSensor};

/// Errors beyond this are outliers.
const OUTLIER_M: f64 = 5e-3;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [cloud, uri] = arguments.as_slice() else {
        return Err("expected CLOUD.ply and a sim: source".into());
    };
    let cloud = PointCloud::read_ply(cloud)?;
    let stspp::SourceUri::Sim { scene, options } = uri.parse()? else {
        return Err(format!("{uri} is not a sim: source").into());
    };
    let sim = SimSensor::new(&SimOptions::parse(scene.as_deref(), &options)?)?;
    let truth = sim.world.truth();
    let origin = nalgebra::Vector3::zeros();
    let mut squares_mm2 = 0.0;
    let mut errors_mm = Vec::new();
    for point in &cloud.points_left_m {
        let point = point.coords.cast::<f64>();
        let Some(surface) = truth.surface_along_ray(&origin, &point, 0) else { continue };
        let error_m = point.norm() - surface.point_left_m.norm();
        if error_m.abs() <= OUTLIER_M {
            errors_mm.push((error_m * 1e3).abs());
            squares_mm2 += (error_m * 1e3).powi(2);
        }
    }
    let within = errors_mm.len();
    let rms_mm = (squares_mm2 / within.max(1) as f64).sqrt();
    let part = within as f64 / cloud.len().max(1) as f64;
    errors_mm.sort_unstable_by(f64::total_cmp);
    let median_mm = errors_mm.get(within / 2).copied().unwrap_or(0.0);
    println!(
        "{{\"points\": {}, \"within\": {part:.6}, \"rms_mm\": {rms_mm:.6}, \"median_mm\": {median_mm:.6}}}",
        cloud.len()
    );
    Ok(())
}
