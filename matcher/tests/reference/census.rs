//! Eq 1-4.

use super::{Volume, sample};

/// Descriptor of pixel (x, y), in the order of eq 1; `None` outside the image or mask. The equations
/// do not say what a missing sample's bit is: `outside(t, x, y)` does.
pub fn census(
    volume: &Volume,
    (x, y): (i64, i64),
    radius: i64,
    outside: &dyn Fn(usize, i64, i64) -> bool,
) -> Option<Vec<bool>> {
    sample(volume, 0, x, y)?;
    let mut values = Vec::new();
    for t in 0..volume.len() {
        for i in -radius..=radius {
            for j in -radius..=radius {
                values.push((sample(volume, t, x + i, y + j), (t, x + i, y + j)));
            }
        }
    }
    // Eq 3, over the samples that exist.
    let inside: Vec<f64> = values.iter().filter_map(|v| v.0).collect();
    let mean = inside.iter().sum::<f64>() / inside.len() as f64;
    let bit = |(v, (t, x, y)): (Option<f64>, _)| v.map_or_else(|| outside(t, x, y), |v| v > mean);
    Some(values.into_iter().map(bit).collect())
}

/// Eq 4, of `counted` bits; `None` where the right pixel is no candidate.
pub fn cost(left: &[bool], right: Option<&Vec<bool>>, counted: f64) -> Option<f64> {
    let differing = left.iter().zip(right?).filter(|(a, b)| a != b).count();
    Some(differing as f64 / counted)
}
