//! Threads that stand by for the many short loops of a frame.
//!
//! A depth frame is some thirty loops with a little serial work between them. A pool whose threads sleep
//! in between loses the time of a wake-up in each, and one that hands out large pieces loses the time that
//! one thread waits for another's last piece. Here the threads watch for the next loop while a frame is in
//! work, and sleep only between frames; how a loop is shared out is [`super::share`]'s matter.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How long a thread watches for the next loop before it sleeps.
const WATCH: Duration = Duration::from_micros(300);
/// Looks at the counter between two offers of the core to other threads.
const LOOKS: usize = 64;

/// A loop: what every thread is to do.
#[derive(Clone, Copy)]
struct Job(*const (dyn Fn(usize) + Sync));

// SAFETY: what it points to is `Sync`, and is called only while the thread that made it waits.
unsafe impl Send for Job {}

struct State {
    job: Option<Job>,
    /// Frames in work.
    frames: usize,
    asleep: usize,
    ends: bool,
    panic: Option<Box<dyn Any + Send>>,
}

/// What the threads of a team share.
pub(super) struct Shared {
    members: usize,
    state: Mutex<State>,
    wake: Condvar,
    /// Changes with the state.
    changes: AtomicU32,
    /// Threads in the loop in work, but for the one that made it.
    inside: AtomicUsize,
}

thread_local! {
    /// The team that this thread belongs to, for a helper always, for others during a frame, and its place
    /// in it.
    static MEMBER: RefCell<Option<(Arc<Shared>, usize)>> = const { RefCell::new(None) };
    /// Whether this thread is in a loop: a loop inside it is not shared out.
    static IN_LOOP: Cell<bool> = const { Cell::new(false) };
}

/// Helpers for the loops of whichever thread is in [`Team::frame`].
pub(super) struct Team {
    shared: Arc<Shared>,
    helpers: Vec<JoinHandle<()>>,
}

impl Team {
    /// A team of `members`, the thread that makes frames included; fewer where the system gives no more.
    pub fn new(members: usize) -> Self {
        let state = State { job: None, frames: 0, asleep: 0, ends: false, panic: None };
        let shared = Arc::new(Shared {
            members,
            state: Mutex::new(state),
            wake: Condvar::new(),
            changes: AtomicU32::new(0),
            inside: AtomicUsize::new(0),
        });
        let helper = |member: usize| {
            let shared = Arc::clone(&shared);
            let thread = std::thread::Builder::new().name(format!("stspp-matcher-{member}"));
            thread.spawn(move || help(&shared, member)).ok()
        };
        let helpers = (1..members).filter_map(helper).collect();
        Self { shared, helpers }
    }

    /// Calls `work`, for whose loops the helpers stand by.
    pub fn frame<T>(&self, work: impl FnOnce() -> T) -> T {
        /// Lets the helpers sleep, also after a panic.
        struct Frame<'a>(&'a Shared, Option<(Arc<Shared>, usize)>);
        impl Drop for Frame<'_> {
            fn drop(&mut self) {
                self.0.change(|state| state.frames -= 1);
                MEMBER.set(self.1.take());
            }
        }
        if in_loop() || current().is_some_and(|team| Arc::ptr_eq(&team, &self.shared)) {
            return work();
        }
        self.shared.change(|state| state.frames += 1);
        let before = MEMBER.replace(Some((Arc::clone(&self.shared), 0)));
        let _frame = Frame(&self.shared, before);
        work()
    }
}

impl std::fmt::Debug for Team {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Team").field("members", &self.shared.members).finish_non_exhaustive()
    }
}

impl Drop for Team {
    fn drop(&mut self) {
        self.shared.change(|state| state.ends = true);
        for helper in self.helpers.drain(..) {
            // Panics were handed on to whoever ran the loop.
            let _ = helper.join();
        }
    }
}

/// This thread's team, where a loop would be shared out.
pub(super) fn current() -> Option<Arc<Shared>> {
    MEMBER.with_borrow(|member| member.as_ref().map(|(team, _)| Arc::clone(team)))
}

/// Number of threads of this thread's team, if it belongs to one, and its place among them.
pub(super) fn place() -> Option<(usize, usize)> {
    MEMBER.with_borrow(|member| member.as_ref().map(|(team, place)| (team.members, *place)))
}

/// Whether this thread is in a loop of its team.
pub(super) fn in_loop() -> bool {
    IN_LOOP.get()
}

impl Shared {
    /// Number of threads, helpers or not.
    pub fn members(&self) -> usize {
        self.members
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the state and tells the helpers.
    fn change(&self, to: impl FnOnce(&mut State)) {
        let mut state = self.state();
        to(&mut state);
        self.changes.fetch_add(1, Ordering::Release);
        let asleep = state.asleep > 0;
        drop(state);
        if asleep {
            self.wake.notify_all();
        }
    }

    /// Calls `work` on this thread with 0 and on each helper that comes while it runs with its place;
    /// returns when all have. Helpers may not come at all.
    ///
    /// # Panics
    /// When `work` does, on any thread.
    pub fn run(&self, work: &(dyn Fn(usize) + Sync)) {
        let job = std::ptr::from_ref(work);
        // SAFETY: only the lifetime is changed. No helper calls `work` after this function's end: helpers
        // take a job and count themselves under the lock, the job is taken back below under the same
        // lock, and then those counted are waited for. Nothing in between unwinds.
        let job = Job(unsafe {
            std::mem::transmute::<*const (dyn Fn(usize) + Sync + '_), *const (dyn Fn(usize) + Sync)>(
                job,
            )
        });
        self.change(|state| state.job = Some(job));
        let own = in_a_loop(|| work(0));
        self.state().job = None;
        let mut looks = 0;
        while self.inside.load(Ordering::Acquire) != 0 {
            look_again(&mut looks);
        }
        if let Err(panic) = own {
            resume_unwind(panic);
        }
        let panic = self.state().panic.take();
        if let Some(panic) = panic {
            resume_unwind(panic);
        }
    }

    /// Waits for a change after `seen`, and gives the job, if there is one; `None` at the team's end.
    fn next(&self, seen: &mut u32) -> Option<Option<Job>> {
        let (mut looks, mut since) = (0, None);
        while self.changes.load(Ordering::Acquire) == *seen {
            look_again(&mut looks);
            if looks.is_multiple_of(LOOKS) {
                let since = *since.get_or_insert_with(Instant::now);
                if since.elapsed() > WATCH {
                    break;
                }
            }
        }
        let mut state = self.state();
        loop {
            let now = self.changes.load(Ordering::Relaxed);
            if state.ends {
                return None;
            }
            // Between frames there is nothing to watch for.
            if now != *seen && state.frames > 0 {
                *seen = now;
                if state.job.is_some() {
                    self.inside.fetch_add(1, Ordering::Relaxed);
                }
                return Some(state.job);
            }
            *seen = now;
            state.asleep += 1;
            state = self.wake.wait(state).unwrap_or_else(PoisonError::into_inner);
            state.asleep -= 1;
        }
    }
}

/// Lets a moment pass.
fn look_again(looks: &mut usize) {
    *looks += 1;
    if looks.is_multiple_of(LOOKS) {
        // Who has more threads than cores loses no more than this.
        std::thread::yield_now();
    } else {
        std::hint::spin_loop();
    }
}

/// Calls `work`, in which loops are not shared out.
fn in_a_loop(work: impl FnOnce()) -> std::thread::Result<()> {
    let before = IN_LOOP.replace(true);
    let result = catch_unwind(AssertUnwindSafe(work));
    IN_LOOP.set(before);
    result
}

/// A helper's life.
fn help(shared: &Arc<Shared>, member: usize) {
    MEMBER.set(Some((Arc::clone(shared), member)));
    let mut seen = 0;
    while let Some(job) = shared.next(&mut seen) {
        let Some(Job(work)) = job else { continue };
        // SAFETY: this thread is counted in `inside`, so that whoever made the job keeps it and waits.
        let result = in_a_loop(|| unsafe { (*work)(member) });
        if let Err(panic) = result {
            shared.state().panic = Some(panic);
        }
        // After all that this thread wrote.
        shared.inside.fetch_sub(1, Ordering::Release);
    }
}
