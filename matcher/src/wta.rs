//! Winner takes all (paper eq 5) with the runner-up, for the test of uniqueness.

use crate::cost::{CostKernel, CostLine, NO_CANDIDATE};

/// Columns next to the winner that belong to its own valley, on either side: a dot is two to four
/// pixels wide, so that a shift of two pixels still resembles the match.
pub const VALLEY: usize = 2;

/// Fewest bits that the runner-up must be worse by: with short descriptors, a part of the bits is less
/// than chance alone gives one of hundreds of candidates.
pub const MARGIN_MIN: f32 = 4.0;

/// The best candidate of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Winner {
    /// Its column in the other image.
    pub column: usize,
    /// Its cost in bits.
    pub cost: u16,
    /// Lowest cost outside the winner's valley; [`NO_CANDIDATE`] when there is no candidate there.
    pub runner_up: u16,
}

impl Winner {
    /// Whether every candidate outside the valley is worse by at least `margin` bits, and
    /// [`MARGIN_MIN`].
    pub fn is_unique(&self, margin: f32) -> bool {
        self.runner_up as f32 - self.cost as f32 >= margin.max(MARGIN_MIN)
    }
}

/// The candidate of lowest cost; of equal ones the lowest column, which on the right image is the
/// nearest surface. `None` without any candidate.
pub fn winner(line: &CostLine, kernel: CostKernel) -> Option<Winner> {
    let costs = line.costs();
    let cost = kernel.smallest(costs);
    if cost == NO_CANDIDATE {
        return None;
    }
    let at = kernel.find(costs, cost)?;
    let below = kernel.smallest(&costs[..at.saturating_sub(VALLEY)]);
    let above = kernel.smallest(&costs[(at + VALLEY + 1).min(costs.len())..]);
    Some(Winner { column: line.first() + at, cost, runner_up: below.min(above) })
}
