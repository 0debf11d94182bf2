//! Eq 1-4.

use super::{Volume, sample};

/// Descriptor of pixel (x, y), in the order of eq 1; `None` outside the image or mask.
pub fn census(volume: &Volume, x: i64, y: i64, radius: i64) -> Option<Vec<bool>> {
    sample(volume, 0, x, y)?;
    let mut values = Vec::new();
    for t in 0..volume.len() {
        for i in -radius..=radius {
            for j in -radius..=radius {
                values.push(sample(volume, t, x + i, y + j));
            }
        }
    }
    // Eq 3, over the samples that exist.
    let inside: Vec<f64> = values.iter().copied().flatten().collect();
    let mean = inside.iter().sum::<f64>() / inside.len() as f64;
    Some(values.into_iter().map(|v| v.is_some_and(|v| v > mean)).collect())
}

/// Eq 4; `None` where the right pixel is no candidate.
pub fn cost(left: &[bool], right: Option<&Vec<bool>>) -> Option<f64> {
    let differing = left.iter().zip(right?).filter(|(a, b)| a != b).count();
    Some(differing as f64 / left.len() as f64)
}
