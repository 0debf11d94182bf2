//! How a loop's items are shared out among a team's threads.
//!
//! Each thread begins with an equal run of neighbouring items, and goes through it in order. One that is
//! done takes the rear half of the longest run that is left. So a thread's items follow each other, most
//! of the time, and none waits longer than for another's last few.

use std::sync::{Mutex, MutexGuard, PoisonError};

use rayon::iter::IndexedParallelIterator;
use rayon::iter::plumbing::{Producer, ProducerCallback};

use super::team::{self, Shared};

/// Most runs; threads beyond begin by taking.
const RUNS: usize = 64;

/// Loops over items that a frame's threads share.
pub trait Share: IndexedParallelIterator {
    /// Calls `work` for every item: within [`super::Pool::frame`] on the pool's threads, elsewhere on
    /// rayon's.
    fn share(self, work: impl Fn(Self::Item) + Sync + Send) {
        self.share_runs(1, work);
    }

    /// As [`Self::share`]; of a run that its thread is going through, fewer than `least` items are left
    /// to that thread.
    fn share_runs(self, least: usize, work: impl Fn(Self::Item) + Sync + Send) {
        let Some(team) = team::current() else { return self.for_each(work) };
        let len = self.len();
        self.with_producer(Sharing { team: &team, len, least: least.max(1), work });
    }
}

impl<I: IndexedParallelIterator> Share for I {}

struct Sharing<'a, W> {
    team: &'a Shared,
    len: usize,
    least: usize,
    work: W,
}

/// Items that are left of a thread's run.
struct Run<P> {
    items: P,
    len: usize,
    /// Whether its thread goes through it: one that does not come leaves all of it to others.
    begun: bool,
}

impl<T, W: Fn(T) + Sync> ProducerCallback<T> for Sharing<'_, W> {
    type Output = ();

    fn callback<P: Producer<Item = T>>(self, items: P) {
        let Self { team, len, least, work } = self;
        let count = team.members().min(len).min(RUNS);
        if count < 2 || team::in_loop() {
            return items.into_iter().for_each(work);
        }
        let runs: [Mutex<Option<Run<P>>>; RUNS] = [const { Mutex::new(None) }; RUNS];
        let runs = &runs[..count];
        let (mut rest, mut end) = (items, len);
        for (k, run) in runs.iter().enumerate().skip(1).rev() {
            let from = len * k / count;
            let (before, items) = rest.split_at(from);
            *lock(run) = Some(Run { items, len: end - from, begun: false });
            (rest, end) = (before, from);
        }
        *lock(&runs[0]) = Some(Run { items: rest, len: end, begun: true });
        team.run(&|member| {
            // A thread without a run begins by taking, and what it takes is seen by no other.
            let spare = Mutex::new(None);
            let own = runs.get(member).unwrap_or(&spare);
            go_through(own, &work);
            while let Some(taken) = take(runs, least) {
                *lock(own) = Some(taken);
                go_through(own, &work);
            }
        });
    }
}

fn lock<P>(run: &Mutex<Option<Run<P>>>) -> MutexGuard<'_, Option<Run<P>>> {
    // What a panic interrupts is an item, never a run.
    run.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Calls `work` for the items of a run, from whose end others may take meanwhile.
fn go_through<P: Producer>(run: &Mutex<Option<Run<P>>>, work: impl Fn(P::Item)) {
    loop {
        let mut place = lock(run);
        let Some(Run { items, len, .. }) = place.take() else { return };
        let first = if len > 1 {
            let (first, items) = items.split_at(1);
            *place = Some(Run { items, len: len - 1, begun: true });
            first
        } else {
            items
        };
        drop(place);
        first.into_iter().for_each(&work);
    }
}

/// Takes the rear half of the longest run that is left, or a single item; `None` where there is none, or
/// none of `least` items that its thread has not begun.
fn take<P: Producer>(runs: &[Mutex<Option<Run<P>>>], least: usize) -> Option<Run<P>> {
    let left = |run: &Option<Run<P>>| match run {
        Some(Run { len, begun, .. }) if *len >= least || !begun => *len,
        _ => 0,
    };
    loop {
        let longest = runs.iter().max_by_key(|run| left(&lock(run)))?;
        let mut place = lock(longest);
        if left(&place) == 0 {
            drop(place);
            // Another may have taken it meanwhile.
            if runs.iter().all(|run| left(&lock(run)) == 0) {
                return None;
            }
            continue;
        }
        let Run { items, len, begun } = place.take()?;
        let kept = len / 2;
        let (front, rear) = items.split_at(kept);
        if kept > 0 {
            *place = Some(Run { items: front, len: kept, begun });
        }
        return Some(Run { items: rear, len: len - kept, begun: true });
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use rayon::prelude::*;

    use super::super::{PerThread, Pool};
    use super::*;

    #[test]
    fn every_item_is_worked_on_once_by_any_number_of_threads() {
        for threads in [1, 2, 3, 7, 70] {
            let pool = Pool::new(Some(threads)).unwrap();
            let mut members = PerThread::<usize>::default();
            for len in [0usize, 1, 2, 3, 8, 65, 200] {
                for least in [1, 4] {
                    let mut data = vec![0usize; 3 * len];
                    pool.frame(|| {
                        let members = members.ready();
                        let chunks = data.par_chunks_mut(3).enumerate();
                        chunks.share_runs(least, |(k, chunk)| {
                            members.with(|n| *n += 1);
                            chunk.iter_mut().for_each(|v| *v += k + 1);
                            // A loop in a loop is not shared out.
                            let inner = AtomicUsize::new(0);
                            (0..5usize).into_par_iter().share(|i| {
                                inner.fetch_add(i, Ordering::Relaxed);
                            });
                            assert_eq!(inner.into_inner(), 10);
                        });
                    });
                    assert!(data.iter().enumerate().all(|(i, v)| *v == i / 3 + 1), "{threads}");
                }
            }
        }
    }

    #[test]
    fn one_that_is_done_takes_from_the_end_of_what_is_left() {
        let pool = Pool::new(Some(2)).unwrap();
        // The first item lasts until all others are done, so the other thread must have done them.
        let (done, order) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
        pool.frame(|| {
            (0..100usize).into_par_iter().share(|i| {
                if i == 0 {
                    while done.load(Ordering::Acquire) < 99 {
                        std::thread::yield_now();
                    }
                } else {
                    order.lock().unwrap().push(i);
                    done.fetch_add(1, Ordering::Release);
                }
            });
        });
        let order = order.into_inner().unwrap();
        assert_eq!(order.iter().copied().collect::<BTreeSet<_>>().len(), 99);
        assert!(order[..50].is_sorted() && order[0] == 50, "{order:?}");
        // 1..50 in rear halves: 25..50, 13..25, ...
        assert_eq!(order[50..75], (25..50).collect::<Vec<_>>()[..]);
    }

    #[test]
    fn a_panic_reaches_who_made_the_loop_and_the_pool_goes_on() {
        let pool = Pool::new(Some(3)).unwrap();
        for bad in [0usize, 59, 99] {
            let result = catch_unwind(AssertUnwindSafe(|| {
                pool.frame(|| {
                    (0..100usize).into_par_iter().share(|i| assert_ne!(i, bad));
                });
            }));
            assert!(result.is_err());
            let sum = AtomicUsize::new(0);
            pool.frame(|| {
                (0..100usize).into_par_iter().share(|i| {
                    sum.fetch_add(i, Ordering::Relaxed);
                });
            });
            assert_eq!(sum.into_inner(), 4950);
        }
    }

    #[test]
    fn two_frames_at_once_on_one_pool() {
        let pool = Pool::new(Some(2)).unwrap();
        let sum = AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for _ in 0..3 {
                scope.spawn(|| {
                    for _ in 0..50 {
                        pool.frame(|| {
                            (0..20usize).into_par_iter().share(|i| {
                                sum.fetch_add(i, Ordering::Relaxed);
                            });
                        });
                    }
                });
            }
        });
        assert_eq!(sum.into_inner(), 3 * 50 * 190);
    }
}
