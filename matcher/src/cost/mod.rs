//! Hamming cost over all candidates (paper eq 4), as a whole number of bits.
//!
//! Candidates are indexed by the other image's column, not by disparity, so that every load and
//! store of the kernels is aligned to whole blocks. A column that is outside the image, its mask or
//! the disparity range is no candidate and costs [`NO_CANDIDATE`].

pub mod kernel;

use crate::census::{BLOCK, CensusRow};

pub use kernel::CostKernel;

/// Cost of a column that is no candidate.
pub const NO_CANDIDATE: u16 = u16::MAX;

/// Costs of one pixel against a stretch of the other image's row.
#[derive(Debug, Default)]
pub struct CostLine {
    words: Vec<u16>,
    costs: Vec<u16>,
    first: usize,
    from: usize,
    to: usize,
}

impl CostLine {
    /// Compares pixel `x` of `reference` with the columns `candidates` of `other`; both rows of the
    /// same radius and number of frames. The range may reach outside the image.
    pub fn fill(
        &mut self,
        reference: &CensusRow,
        x: usize,
        other: &CensusRow,
        candidates: std::ops::Range<i64>,
        kernel: CostKernel,
    ) {
        debug_assert_eq!(reference.bits(), other.bits());
        let width = other.width() as i64;
        self.from = candidates.start.clamp(0, width) as usize;
        self.to = candidates.end.clamp(self.from as i64, width) as usize;
        self.first = self.from / BLOCK * BLOCK;
        let end = self.to.next_multiple_of(BLOCK).max(self.first);
        let stride = reference.stride();
        self.words.clear();
        self.words.extend(reference.planes().chunks_exact(stride).map(|plane| plane[x]));
        self.costs.resize(end - self.first, 0);
        kernel.costs(&self.words, other.planes(), other.invalid(), self.first, &mut self.costs);
        // Columns of the outer blocks that are outside the range.
        self.costs[..self.from - self.first].fill(NO_CANDIDATE);
        self.costs[self.to - self.first..].fill(NO_CANDIDATE);
    }

    /// First column that [`CostLine::costs`] has a cost for; a multiple of [`BLOCK`].
    pub fn first(&self) -> usize {
        self.first
    }

    /// Costs in bits, of whole blocks of columns.
    pub fn costs(&self) -> &[u16] {
        &self.costs
    }

    /// Cost of a column, [`NO_CANDIDATE`] where it is none.
    pub fn at(&self, column: i64) -> u16 {
        let index = usize::try_from(column - self.first as i64).ok();
        index.and_then(|i| self.costs.get(i).copied()).unwrap_or(NO_CANDIDATE)
    }
}
