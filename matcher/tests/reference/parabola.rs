//! Eq 6.

/// Sub-pixel disparity from the costs around the winner `d`.
pub fn subpixel(d: i64, below: Option<f64>, at: f64, above: Option<f64>) -> f64 {
    let (Some(below), Some(above)) = (below, above) else { return d as f64 };
    let denominator = 2.0 * above + 2.0 * below - 4.0 * at;
    if denominator <= 0.0 {
        return d as f64;
    }
    d as f64 - (above - below) / denominator
}
