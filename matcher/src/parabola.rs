//! Sub-pixel disparity from a parabola through the costs (paper eq 6).

/// What to add to the winning disparity D, given the costs at D - 1, D and D + 1; within half a pixel
/// either way. Zero where the costs have no minimum at D.
pub fn offset(below: f32, at: f32, above: f32) -> f32 {
    let curvature = 2.0 * above + 2.0 * below - 4.0 * at;
    if curvature > 0.0 && below >= at && above >= at { -(above - below) / curvature } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::offset;

    #[test]
    fn finds_the_vertex() {
        for vertex in [-0.5f32, -0.2, 0.0, 0.31, 0.5] {
            let cost = |d: f32| 3.0 * (d - vertex) * (d - vertex) + 7.0;
            assert!((offset(cost(-1.0), cost(0.0), cost(1.0)) - vertex).abs() < 1e-5);
        }
        assert_eq!(offset(5.0, 5.0, 5.0), 0.0);
        assert_eq!(offset(1.0, 5.0, 9.0), 0.0);
    }
}
