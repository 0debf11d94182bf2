//! Norms and similarity of subsets (paper eq 10-12).

/// Least variance of a subset's samples, in squared DN of 8 bits, for it to count as texture: the
/// rounding of an 8-bit camera alone gives 1/12.
pub const VARIANCE_MIN: f64 = 0.25;

/// Square root of the summed squared deviations from the mean (eq 11, 12), from the sum and the sum of
/// squares of `n` samples; `None` when there is no texture.
pub fn norm(sum: f64, squares: f64, n: f64) -> Option<f64> {
    let deviation = squares - sum * sum / n;
    (deviation > VARIANCE_MIN * n).then(|| deviation.sqrt())
}

/// Similarity of two subsets with the given ZNSSD (eq 10): 1 - ZNSSD / 2.
pub fn from_znssd(znssd: f64) -> f64 {
    1.0 - 0.5 * znssd
}
