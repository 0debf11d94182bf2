//! What a stream counts, and what its threads tell each other about progress.

use std::sync::atomic::{AtomicI64, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::sync::Side;
use crate::sync::pairer::Reject;
use crate::transport::LinkStats;

/// Frames that came to nothing, by cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Rejected {
    /// Delivered twice.
    pub duplicate: u64,
    /// Arrived after their trigger had been given up.
    pub late: u64,
    /// No trigger event fits them.
    pub no_trigger: u64,
    /// Timestamp, count and arrival contradict each other.
    pub mislabelled: u64,
    /// The other camera's frame is missing.
    pub partner_missing: u64,
    /// The camera's clock was not tied to the device's yet.
    pub unsynchronised: u64,
    /// On their way when the stream ended.
    pub discarded: u64,
}

impl Rejected {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.duplicate
            + self.late
            + self.no_trigger
            + self.mislabelled
            + self.partner_missing
            + self.unsynchronised
            + self.discarded
    }

    pub(crate) fn count(&mut self, cause: Reject) {
        *match cause {
            Reject::Duplicate => &mut self.duplicate,
            Reject::Late => &mut self.late,
            Reject::NoTrigger => &mut self.no_trigger,
            Reject::Mislabelled => &mut self.mislabelled,
            Reject::PartnerMissing => &mut self.partner_missing,
            Reject::Unsynchronised => &mut self.unsynchronised,
            Reject::Discarded => &mut self.discarded,
        } += 1;
    }
}

/// Counters of a stream since its start. Every camera frame is in exactly one of: `pairs` (two
/// each), `rejected`, `dropped_capture`, or still on its way.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct StreamStats {
    /// Trigger events received.
    pub triggers: u64,
    /// Trigger events that never came.
    pub events_lost: u64,
    /// Trigger events that came twice or for an unknown timing.
    pub events_ignored: u64,
    /// Frames of the left camera.
    pub frames_left: u64,
    /// Frames of the right camera.
    pub frames_right: u64,
    /// Frames of the left camera that arrived damaged; not in `frames_left`.
    pub damaged_left: u64,
    /// Frames of the right camera that arrived damaged; not in `frames_right`.
    pub damaged_right: u64,
    /// Frames that overtook another of their camera.
    pub overtaken: u64,
    /// Frames that came to nothing.
    pub rejected: Rejected,
    /// Triggers whose left frame is missing.
    pub missing_left: u64,
    /// Triggers whose right frame is missing.
    pub missing_right: u64,
    /// Labelled pairs.
    pub pairs: u64,
    /// Pairs whose light was not what the timing says: not matched.
    pub pairs_mislabelled: u64,
    /// Times that the window started over because a pair was missing.
    pub window_gaps: u64,
    /// Complete windows.
    pub windows: u64,
    /// Depth frames made.
    pub depth_frames: u64,
    /// Frames dropped because pairing was too slow.
    pub dropped_capture: u64,
    /// Pairs dropped because matching was too slow by more than a window.
    pub dropped_pairs: u64,
    /// Complete windows skipped for a newer one because matching was too slow.
    pub skipped_windows: u64,
    /// Every how manyth window is matched: 1 on a machine that keeps up with the camera.
    pub match_every: u32,
    /// Matches that took longer than a window's time.
    pub over_budget: u64,
    /// Depth frames made with the first-order shape function for want of time.
    pub reduced_frames: u64,
    /// Wall time of the newest match in milliseconds.
    pub match_ms: f64,
    /// Those of them that the user did not fetch: in time, or at all.
    pub dropped_depth: u64,
    /// Depth frames per second of wall time, over the last ones.
    pub fps: f64,
    /// Time from the last exposure's end to the depth frame, of the newest frame, in milliseconds.
    pub latency_ms: f64,
    /// Rate of the left camera's clock against the device's, millionths.
    pub drift_left_ppm: f64,
    /// Rate of the right camera's clock against the device's, millionths.
    pub drift_right_ppm: f64,
    /// The control link.
    pub link: LinkStats,
}

/// Shared by the threads of a stream.
#[derive(Debug)]
pub(crate) struct Progress {
    stats: Mutex<StreamStats>,
    /// Work that is queued or under way: while there is some, nothing is missing.
    busy: AtomicUsize,
    /// Host times of the last trigger event, left frame, right frame, pair, window; -1 for none.
    last_ns: [AtomicI64; 5],
    published: Mutex<Vec<Instant>>,
    timeouts_base_ns: AtomicU64,
}

/// What progress is measured by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mark {
    Trigger,
    Frame(Side),
    Pair,
    Window,
}

impl Mark {
    fn index(self) -> usize {
        match self {
            Mark::Trigger => 0,
            Mark::Frame(side) => 1 + side.index(),
            Mark::Pair => 3,
            Mark::Window => 4,
        }
    }
}

impl Progress {
    pub fn new(now_ns: u64) -> Self {
        Self {
            stats: Mutex::default(),
            busy: AtomicUsize::new(0),
            last_ns: std::array::from_fn(|_| AtomicI64::new(-1)),
            published: Mutex::default(),
            timeouts_base_ns: AtomicU64::new(now_ns),
        }
    }

    pub fn count(&self, change: impl FnOnce(&mut StreamStats)) {
        change(&mut self.stats.lock().unwrap_or_else(PoisonError::into_inner));
    }

    pub fn snapshot(&self) -> StreamStats {
        let mut stats = *self.stats.lock().unwrap_or_else(PoisonError::into_inner);
        let published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
        if let (Some(first), Some(last), 2..) =
            (published.first(), published.last(), published.len())
        {
            let elapsed_s = (*last - *first).as_secs_f64();
            stats.fps = (published.len() - 1) as f64 / elapsed_s.max(1e-9);
        }
        stats
    }

    pub fn publish(&self, latency: Duration) {
        self.count(|s| {
            s.depth_frames += 1;
            s.latency_ms = latency.as_secs_f64() * 1e3;
        });
        let mut published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
        if published.len() == 31 {
            published.remove(0);
        }
        published.push(Instant::now());
    }

    pub fn mark(&self, mark: Mark, now_ns: u64) {
        let now_ns = i64::try_from(now_ns).unwrap_or(i64::MAX);
        self.last_ns[mark.index()].fetch_max(now_ns, Ordering::AcqRel);
    }

    /// Whether `mark` was reached since `since_ns`.
    pub fn reached(&self, mark: Mark, since_ns: u64) -> bool {
        let last_ns = self.last_ns[mark.index()].load(Ordering::Acquire);
        u64::try_from(last_ns).is_ok_and(|last_ns| last_ns >= since_ns)
    }

    /// Since when there has been no window.
    pub fn waiting_since_ns(&self) -> u64 {
        let window_ns = self.last_ns[Mark::Window.index()].load(Ordering::Acquire);
        let base_ns = self.timeouts_base_ns.load(Ordering::Acquire);
        u64::try_from(window_ns).map_or(base_ns, |window_ns| window_ns.max(base_ns))
    }

    /// Begins to count time anew, after a timeout has been reported.
    pub fn restart_waiting(&self, now_ns: u64) {
        self.timeouts_base_ns.fetch_max(now_ns, Ordering::AcqRel);
    }

    pub fn begin_work(&self) {
        self.busy.fetch_add(1, Ordering::AcqRel);
    }

    pub fn end_work(&self) {
        self.busy.fetch_sub(1, Ordering::AcqRel);
    }

    pub fn is_busy(&self) -> bool {
        self.busy.load(Ordering::Acquire) > 0
    }
}
