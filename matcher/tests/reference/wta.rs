//! Eq 5.

/// The disparity of least cost, from (disparity, cost) pairs; of equal ones the largest disparity, the
/// nearest surface.
pub fn winner(costs: &[(i64, Option<f64>)]) -> Option<(i64, f64)> {
    let mut best: Option<(i64, f64)> = None;
    for &(d, cost) in costs {
        let Some(cost) = cost else { continue };
        if best.is_none_or(|(bd, bc)| cost < bc || (cost == bc && d > bd)) {
            best = Some((d, cost));
        }
    }
    best
}

/// Least cost of the disparities more than `valley` away.
pub fn runner_up(costs: &[(i64, Option<f64>)], winner: i64, valley: i64) -> Option<f64> {
    costs
        .iter()
        .filter(|(d, _)| (d - winner).abs() > valley)
        .filter_map(|(_, c)| *c)
        .min_by(f64::total_cmp)
}
