//! Streams: the threads of the pipeline and what they hand out.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, bounded};

use super::budget::Budget;
use super::capture::{self, Capture};
use super::depth::{Cycle, Cycles, DepthEngine, MatchInfo, MatchThread};
use super::pair::PairThread;
use super::replay::Replay;
use super::stats::{Progress, StreamStats};
use super::{CAPTURE_QUEUE, DEPTH_QUEUE, LOSSLESS_QUEUE, LabelledPair, PAIR_QUEUE, StreamOptions};
use crate::clock::{Clock, duration_ns};
use crate::error::{Error, Missing, Timeout};
use crate::sensor::{Lease, Session};
use crate::sync::pairer::PairerConfig;
use crate::{DepthFrame, Recording};

/// How often a waiting user looks at the source's clock.
const POLL: Duration = Duration::from_millis(5);

/// Stops a stream from another thread, such as a signal handler's: the light goes off within
/// milliseconds, and the iterator ends.
#[derive(Debug, Clone, Default)]
pub struct StopHandle(Arc<AtomicBool>);

impl StopHandle {
    /// Stops the stream.
    pub fn stop(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether the stream has been told to stop.
    pub fn is_stopped(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

type Results<T> = Receiver<Result<T, Error>>;

/// The threads behind a stream, and what they report.
struct Threads {
    stop: StopHandle,
    progress: Arc<Progress>,
    clock: Arc<dyn Clock>,
    session: Option<Arc<Session>>,
    handles: Vec<(&'static str, JoinHandle<()>)>,
    // Given back after the threads have ended.
    _lease: Option<Lease>,
}

impl Threads {
    fn spawn(
        &mut self,
        name: &'static str,
        run: impl FnOnce() + Send + 'static,
    ) -> Result<(), Error> {
        let handle = std::thread::Builder::new()
            .name(format!("stspp-{name}"))
            .spawn(run)
            .map_err(|error| Error::Thread { thread: name, what: error.to_string() })?;
        self.handles.push((name, handle));
        Ok(())
    }

    fn stats(&self) -> StreamStats {
        let mut stats = self.progress.snapshot();
        if let Some(session) = &self.session {
            stats.link = session.link().stats();
        }
        stats
    }

    /// The next result, waiting up to `timeout` of the source's clock; `observe` is called meanwhile.
    fn next<T>(
        &mut self,
        results: &Results<T>,
        timeout: Option<Duration>,
        observe: &mut dyn FnMut(&StreamStats),
    ) -> Option<Result<T, Error>> {
        let start_ns = self.clock.now_ns();
        let deadline_ns = timeout.map(|timeout| start_ns.saturating_add(duration_ns(timeout)));
        loop {
            match results.recv_timeout(POLL) {
                Ok(result) => return Some(result),
                Err(RecvTimeoutError::Disconnected) => return self.panicked().map(Err),
                Err(RecvTimeoutError::Timeout) if self.stop.is_stopped() => return None,
                Err(RecvTimeoutError::Timeout) => observe(&self.progress.snapshot()),
            }
            // Simulated time runs ahead of a matcher at work; that is no silence.
            let working = self.clock.is_virtual() && self.progress.is_busy();
            if deadline_ns.is_some_and(|deadline_ns| self.clock.now_ns() >= deadline_ns) && !working
            {
                let missing = match &self.session {
                    Some(session) => match capture::missing(session, &self.progress, start_ns) {
                        Ok(missing) => missing,
                        Err(error) => return Some(Err(error)),
                    },
                    None => Missing::Matching,
                };
                let waited = timeout.unwrap_or_default();
                return Some(Err(Timeout { waited, missing }.into()));
            }
        }
    }

    fn finish(mut self) -> StreamStats {
        self.end();
        self.stats()
    }

    fn end(&mut self) {
        self.stop.stop();
        for (_, handle) in self.handles.drain(..) {
            // A panic has been printed by its thread; there is no one to give it to here.
            let _ = handle.join();
        }
    }

    /// The threads have ended: whether one of them by a panic.
    fn panicked(&mut self) -> Option<Error> {
        self.stop.stop();
        let mut panicked = None;
        for (thread, handle) in self.handles.drain(..) {
            if handle.join().is_err() {
                panicked.get_or_insert(thread);
            }
        }
        let what = "it panicked, which is a bug in stspp".to_owned();
        panicked.map(|thread| Error::Thread { thread, what })
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        self.end();
    }
}

/// Depth frames as they come: an iterator that owns its threads. Dropping it stops the device and
/// switches its light off.
///
/// An error of kind [`Error::Timeout`] does not end the stream: ask again. Others do.
pub struct DepthStream {
    // Dropped first: threads that wait for room notice.
    results: Results<DepthFrame>,
    threads: Threads,
    info: MatchInfo,
}

impl DepthStream {
    /// The next depth frame, waiting up to `timeout` on the source's clock (simulated time for `sim:`).
    ///
    /// # Errors
    /// [`Error::Timeout`] says what is missing; whatever ends the stream; [`Error::Stopped`] after its
    /// end.
    pub fn next_timeout(&mut self, timeout: Duration) -> Result<DepthFrame, Error> {
        self.threads.next(&self.results, Some(timeout), &mut |_| {}).unwrap_or(Err(Error::Stopped))
    }

    /// The next depth frame; `observe` is shown the counters every few milliseconds until it is there.
    pub fn next_observed(
        &mut self,
        mut observe: impl FnMut(&StreamStats),
    ) -> Option<Result<DepthFrame, Error>> {
        self.threads.next(&self.results, None, &mut observe)
    }

    /// Counters since the start.
    pub fn stats(&self) -> StreamStats {
        self.threads.stats()
    }

    /// Stops this stream from another thread.
    pub fn stop_handle(&self) -> StopHandle {
        self.threads.stop.clone()
    }

    /// Stops the stream, waits for its threads and returns the final counters. Frames that were not
    /// fetched are counted as such.
    pub fn finish(self) -> StreamStats {
        let Self { results, mut threads, .. } = self;
        threads.end();
        let left = results.try_iter().filter(Result::is_ok).count() as u64;
        threads.progress.count(|s| s.dropped_depth += left);
        threads.stats()
    }

    /// How this stream matches.
    pub fn matching(&self) -> &MatchInfo {
        &self.info
    }
}

impl Iterator for DepthStream {
    type Item = Result<DepthFrame, Error>;

    fn next(&mut self) -> Option<Self::Item> {
        self.threads.next(&self.results, None, &mut |_| {})
    }
}

/// Labelled raw pairs as they come; otherwise as [`DepthStream`].
pub struct PairStream {
    results: Results<LabelledPair>,
    threads: Threads,
}

impl PairStream {
    /// The next pair, waiting up to `timeout` on the source's clock.
    ///
    /// # Errors
    /// As [`DepthStream::next_timeout`].
    pub fn next_timeout(&mut self, timeout: Duration) -> Result<LabelledPair, Error> {
        self.take(Some(timeout)).unwrap_or(Err(Error::Stopped))
    }

    /// Counters since the start.
    pub fn stats(&self) -> StreamStats {
        self.threads.stats()
    }

    /// Stops this stream from another thread.
    pub fn stop_handle(&self) -> StopHandle {
        self.threads.stop.clone()
    }

    /// Stops the stream, waits for its threads and returns the final counters.
    pub fn finish(self) -> StreamStats {
        drop(self.results);
        self.threads.finish()
    }

    fn take(&mut self, timeout: Option<Duration>) -> Option<Result<LabelledPair, Error>> {
        let result = self.threads.next(&self.results, timeout, &mut |_| {})?;
        if result.is_ok() {
            self.threads.progress.mark(super::stats::Mark::Window, self.threads.clock.now_ns());
            self.threads.progress.end_work();
        }
        Some(result)
    }
}

impl Iterator for PairStream {
    type Item = Result<LabelledPair, Error>;

    fn next(&mut self) -> Option<Self::Item> {
        self.take(None)
    }
}

/// Where the pairs of a stream come from.
pub(crate) enum PairSource {
    Live { session: Arc<Session>, lease: Lease },
    Replay { recording: Arc<Recording>, clock: Arc<dyn Clock> },
}

/// Starts pairs flowing; the receiver's end is what they flow to.
fn start_pairs(
    source: PairSource,
    options: &StreamOptions,
) -> Result<(Threads, Results<LabelledPair>, bool), Error> {
    let stop = StopHandle::default();
    match source {
        PairSource::Live { session, lease } => {
            let clock = Arc::clone(&session.clock);
            let started = session.start()?;
            // From here on dropping the capture thread's guard switches the light off.
            let progress = Arc::new(Progress::new(clock.now_ns()));
            let lossless = session.cameras().is_lossless();
            let room = |queue| if lossless { LOSSLESS_QUEUE } else { queue };
            let (captured, input) = bounded(room(CAPTURE_QUEUE));
            let (out, results) = bounded(room(PAIR_QUEUE));
            let mut threads = Threads {
                stop: stop.clone(),
                progress: Arc::clone(&progress),
                clock,
                session: Some(Arc::clone(&session)),
                handles: Vec::new(),
                _lease: Some(lease),
            };
            let period_us = session
                .timing(started.timing_generation)
                .map_or(33_333, |timing| timing.frame_period_us);
            let mut config = PairerConfig::new(period_us, started.first_frame_sequence);
            // Who allows more time than usual has a slow machine: its frames take longer, too.
            let usual = StreamOptions::default().timeout;
            let more_ns = duration_ns(options.timeout.saturating_sub(usual)) / 10;
            config.patience_ns = config.patience_ns.max(more_ns);
            let capture = Capture {
                session: Arc::clone(&session),
                progress: Arc::clone(&progress),
                stop: stop.clone(),
                timeout: options.timeout,
                out: captured,
                generation: started.timing_generation,
            };
            if let Err(error) = threads.spawn("capture", move || capture.run()) {
                session.stop();
                return Err(error);
            }
            let pairing = PairThread { input, out, progress, stop, config, lossless };
            threads.spawn("pair", move || pairing.run())?;
            Ok((threads, results, lossless))
        }
        PairSource::Replay { recording, clock } => {
            let (out, results) = bounded(LOSSLESS_QUEUE);
            let progress = Arc::new(Progress::new(clock.now_ns()));
            let mut threads = Threads {
                stop: stop.clone(),
                progress: Arc::clone(&progress),
                clock,
                session: None,
                handles: Vec::new(),
                _lease: None,
            };
            let replay = Replay { recording, out, progress, stop, first: options.matching.first };
            threads.spawn("replay", move || replay.run())?;
            Ok((threads, results, true))
        }
    }
}

/// Starts a stream of raw pairs.
pub(crate) fn pairs(source: PairSource, options: &StreamOptions) -> Result<PairStream, Error> {
    let (threads, results, _) = start_pairs(source, options)?;
    Ok(PairStream { results, threads })
}

/// Starts a stream of depth frames.
pub(crate) fn depth(source: PairSource, options: &StreamOptions) -> Result<DepthStream, Error> {
    // All that can be refused is refused before there is light.
    let (engine, cycles, live): (_, Cycles, _) = match &source {
        PairSource::Live { session, .. } => {
            let session = Arc::clone(session);
            let engine = DepthEngine::new(session.calibration()?, &options.matching)?;
            let cycles = move |generation| Some(Cycle::of(&session.timing(generation)?));
            (engine, Box::new(cycles), true)
        }
        PairSource::Replay { recording, .. } => {
            let engine = DepthEngine::new(&recording.calibration, &options.matching)?;
            let engine = if recording.labels.is_some() { engine } else { engine.without_labels() };
            let cycle = super::replay::cycle(recording, options.matching.first);
            (engine, Box::new(move |_| Some(cycle.clone())), false)
        }
    };
    let info = engine.info();
    let (mut threads, input, lossless) = start_pairs(source, options)?;
    let (out, results) = bounded(DEPTH_QUEUE);
    let matching = MatchThread {
        engine,
        input,
        out,
        oldest: results.clone(),
        cycles,
        progress: Arc::clone(&threads.progress),
        clock: Arc::clone(&threads.clock),
        stop: threads.stop.clone(),
        lossless,
        live,
        skipped_in_row: 0,
        budget: Budget::new(options.budget),
    };
    threads.spawn("match", move || matching.run())?;
    Ok(DepthStream { results, threads, info })
}
