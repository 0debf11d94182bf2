//! Asks for samples before they are needed: twenty images are more streams than the processor follows by
//! itself. A row's lines are asked for a few at a time between the stages of the row before, since a
//! burst of them waits for itself.

use super::tile::Job;

/// Samples of a cache line.
const LINE: usize = 32;
/// How often [`Ahead::some`] is called for a row, at least.
const CALLS: usize = 20;

/// What is still to be asked for.
#[derive(Debug, Default)]
pub(crate) struct Ahead {
    row: usize,
    /// Columns of the left images.
    columns: (usize, usize),
    /// Columns of the right images, one for each line.
    right: Vec<usize>,
    next: usize,
    count: usize,
}

impl Ahead {
    /// Row `y` is next, columns `x0..x1` of the left images.
    pub fn begin(&mut self, job: &Job<'_>, y: usize, (x0, x1): (usize, usize)) {
        (self.next, self.count) = (0, 0);
        let (width, height) = (job.start.width(), job.start.height());
        if y >= height {
            return;
        }
        (self.row, self.columns, self.count) = (y, (x0, x1), 2 * job.frames);
        self.right.clear();
        let blocks = job.start.row(y)[x0..x1].chunks(LINE).enumerate();
        self.right.extend(blocks.map(|(b, start)| {
            let w = start[start.len() / 2];
            let w = if w.is_nan() { job.origin } else { w };
            (((x0 + b * LINE) as f32 - w) as usize).min(width - 1)
        }));
    }

    /// Asks for the next part.
    pub fn some(&mut self, job: &Job<'_>) {
        let to = (self.next + self.count.div_ceil(CALLS)).min(self.count);
        for image in self.next..to {
            match image.checked_sub(job.frames) {
                None => {
                    let row = &job.left[image].row(self.row)[self.columns.0..self.columns.1];
                    row.chunks(LINE).for_each(|line| ask(&line[0]));
                }
                Some(image) => {
                    let row = job.right[image].row(self.row);
                    self.right.iter().for_each(|&at| ask(&row[at]));
                }
            }
        }
        self.next = to;
    }
}

/// A hint that the line around `at` will be read.
#[inline]
fn ask<T>(at: &T) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint about memory that the reference is to.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(at).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = at;
}
