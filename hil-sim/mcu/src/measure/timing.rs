//! Gates and triggers from their edges: on-times, gaps, offsets, jitter.

use stspp_hil_sim::device::{Line, PinEdge};

/// A level that was high from `rise_ns` to `fall_ns`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pulse {
    /// Which line.
    pub line: Line,
    /// Start.
    pub rise_ns: u64,
    /// End.
    pub fall_ns: u64,
}

/// The pulses in `edges`, by their start. A pulse that has not ended is left out.
#[must_use]
pub fn pulses(edges: &[PinEdge], wanted: impl Fn(Line) -> bool) -> Vec<Pulse> {
    let mut open: Vec<(Line, u64)> = Vec::new();
    let mut found = Vec::new();
    for edge in edges.iter().filter(|edge| wanted(edge.line)) {
        let position = open.iter().position(|(line, _)| *line == edge.line);
        match (edge.high, position) {
            (true, None) => open.push((edge.line, edge.time_ns)),
            (false, Some(position)) => {
                let (line, rise_ns) = open.swap_remove(position);
                found.push(Pulse { line, rise_ns, fall_ns: edge.time_ns });
            }
            _ => {}
        }
    }
    found.sort_by_key(|pulse| pulse.rise_ns);
    found
}

/// Whether a line is a projector's gate.
#[must_use]
pub fn is_projector(line: Line) -> bool {
    matches!(line, Line::Projector(_))
}

/// Whether a line makes light.
#[must_use]
pub fn is_light(line: Line) -> bool {
    matches!(line, Line::Projector(_) | Line::Floodlight)
}

/// Largest deviation in nanoseconds of `times` from a grid of `period_ns` through the first.
#[must_use]
pub fn grid_deviation_ns(times: &[u64], period_ns: u64) -> u64 {
    let Some(&first) = times.first() else { return 0 };
    times
        .iter()
        .enumerate()
        .map(|(n, &time)| time.abs_diff(first + n as u64 * period_ns))
        .max()
        .unwrap_or(0)
}

/// The time of the last fall among the lines of `wanted`; `None` where one is still high. Lines in
/// `high` are high before the first edge.
#[must_use]
pub fn last_fall_ns(
    edges: &[PinEdge],
    mut high: Vec<Line>,
    wanted: impl Fn(Line) -> bool,
) -> Option<u64> {
    high.retain(|line| wanted(*line));
    let mut last = None;
    for edge in edges.iter().filter(|edge| wanted(edge.line)) {
        if edge.high {
            high.push(edge.line);
        } else if let Some(position) = high.iter().position(|line| *line == edge.line) {
            high.swap_remove(position);
            last = Some(edge.time_ns);
        }
    }
    if high.is_empty() { last } else { None }
}
