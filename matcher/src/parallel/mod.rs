//! Threads: a pool of the caller's or of our own, and loops over rows.
//!
//! Every loop hands each task its own rows to write, so results do not depend on the number of
//! threads.

mod share;
mod team;

use std::sync::{Arc, Mutex, OnceLock};

use rayon::prelude::*;

use crate::Error;
pub use share::Share;
use team::Team;

/// Where parallel loops run: the process-wide rayon pool, or one of a fixed number of threads; and, for
/// the loops of a frame, threads of its own that stand by.
#[derive(Debug, Clone, Default)]
pub struct Pool {
    rayon: Option<Arc<rayon::ThreadPool>>,
    /// Made by the first frame.
    team: Arc<OnceLock<Team>>,
}

impl Pool {
    /// A pool of `threads`; the process-wide one when `None`.
    ///
    /// # Errors
    /// [`Error::Parameter`] for zero threads, or when the system gives none.
    pub fn new(threads: Option<usize>) -> Result<Self, Error> {
        let Some(threads) = threads else { return Ok(Self::default()) };
        let bad = |allowed: String| Error::Parameter {
            name: "advanced.threads",
            got: threads.to_string(),
            allowed,
        };
        if !(1..=1024).contains(&threads) {
            return Err(bad("1 to 1024".to_owned()));
        }
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("stspp-matcher-{i}"))
            .build()
            .map_err(|e| bad(format!("what the system can start ({e})")))?;
        Ok(Self { rayon: Some(Arc::new(pool)), team: Arc::default() })
    }

    /// Runs `work` inside the pool: parallel loops in it use the pool's threads.
    pub fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        match &self.rayon {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }

    /// Runs `work` on this thread, with as many others less one standing by for its loops of [`Share`]:
    /// they do not sleep between loops. For what one depth frame takes; a frame inside a frame is a part
    /// of it.
    pub fn frame<T>(&self, work: impl FnOnce() -> T) -> T {
        self.team.get_or_init(|| Team::new(self.threads())).frame(work)
    }

    /// Number of threads loops are spread over.
    pub fn threads(&self) -> usize {
        self.rayon.as_ref().map_or_else(rayon::current_num_threads, |p| p.current_num_threads())
    }
}

/// Number of threads that loops are spread over here, and this thread's place among them.
fn place() -> (usize, usize) {
    let rayon = || (rayon::current_num_threads(), rayon::current_thread_index().unwrap_or(0));
    team::place().unwrap_or_else(rayon)
}

/// Number of threads that loops are spread over here.
pub(crate) fn threads() -> usize {
    place().0.max(1)
}

/// Whether loops of [`Share`] are shared out item by item here, as they are within a frame.
pub(crate) fn is_shared() -> bool {
    team::place().is_some()
}

/// Buffers for parallel loops, one per thread, kept between frames.
#[derive(Debug)]
pub(crate) struct PerThread<T>(Vec<Mutex<T>>);

impl<T> Default for PerThread<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Default> PerThread<T> {
    /// Makes buffers for all threads of the current pool; call it before a loop.
    pub(crate) fn ready(&mut self) -> &Self {
        let threads = threads();
        self.0.resize_with(threads.max(self.0.len()), Mutex::default);
        self
    }

    /// Calls `work` with the current thread's buffers.
    pub(crate) fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> R {
        let thread = place().1 % self.0.len();
        work(&mut self.0[thread].lock().unwrap_or_else(|e| e.into_inner()))
    }
}

/// Cuts `data` into bands of `rows` rows of `width` values (the last may be shorter) and calls
/// `work(first_row, band)` for each, in parallel, with a scratch made once per thread's share.
///
/// Does nothing when `width` is zero.
pub fn for_bands<T: Send, S: Send>(
    data: &mut [T],
    width: usize,
    rows: usize,
    scratch: impl Fn() -> S + Sync + Send,
    work: impl Fn(&mut S, usize, &mut [T]) + Sync + Send,
) {
    if width == 0 {
        return;
    }
    let rows = rows.max(1);
    data.par_chunks_mut(width * rows)
        .enumerate()
        .for_each_init(scratch, |s, (band, chunk)| work(s, band * rows, chunk));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_cover_every_row_once() {
        let mut data = vec![0u32; 7 * 23];
        for_bands(
            &mut data,
            7,
            4,
            || (),
            |(), y0, band| {
                for (i, row) in band.chunks_mut(7).enumerate() {
                    row.iter_mut().for_each(|v| *v += (y0 + i) as u32 + 1);
                }
            },
        );
        for (y, row) in data.chunks(7).enumerate() {
            assert!(row.iter().all(|&v| v == y as u32 + 1));
        }
    }

    #[test]
    fn pool_has_the_threads_asked_for() {
        assert_eq!(Pool::new(Some(3)).unwrap().threads(), 3);
        assert!(Pool::new(Some(0)).is_err());
    }
}
