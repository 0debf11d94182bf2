//! The median of a sample of a map's pixels.

use rayon::prelude::*;

use crate::parallel::Share;

/// Pixels from one that is sampled to the next.
const STEP: usize = 97;
/// Samples of a task: each is a line from memory.
const TASK: usize = 256;

/// Finds medians; keeps its buffer.
#[derive(Debug, Default)]
pub(crate) struct SampledMedian(Vec<f32>);

impl SampledMedian {
    /// The median of `value` at every 97th of `pixels`, without those that are NaN; `None` where all are.
    pub fn of(&mut self, pixels: usize, value: impl Fn(usize) -> f32 + Sync + Send) -> Option<f32> {
        self.0.resize(pixels.div_ceil(STEP), 0.0);
        self.0.par_chunks_mut(TASK).enumerate().share(|(k, sample)| {
            sample.iter_mut().zip(k * TASK..).for_each(|(to, i)| *to = value(i * STEP));
        });
        self.0.retain(|v| !v.is_nan());
        let middle = self.0.len() / 2;
        (!self.0.is_empty()).then(|| *self.0.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}
