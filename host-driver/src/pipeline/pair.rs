//! The pairing thread: feeds [`Pairer`] and counts what comes out.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, TrySendError};

use super::LabelledPair;
use super::capture::Captured;
use super::stats::{Mark, Progress};
use super::stream::StopHandle;
use crate::camera::CameraFrame;
use crate::error::Error;
use crate::sync::Side;
use crate::sync::pairer::{Outcome, Pair, Pairer, PairerConfig, Reject};

pub(crate) struct PairThread {
    pub input: Receiver<Captured>,
    pub out: Sender<Result<LabelledPair, Error>>,
    pub progress: Arc<Progress>,
    pub stop: StopHandle,
    pub config: PairerConfig,
    /// Wait for the matcher instead of dropping pairs.
    pub lossless: bool,
}

impl PairThread {
    /// Runs until capture ends or nobody takes pairs any more.
    pub fn run(self) {
        let mut pairer: Pairer<Box<CameraFrame>> = Pairer::new(self.config);
        let mut outcomes = Vec::new();
        let mut now_ns = 0;
        let mut going_on = true;
        for item in self.input.iter() {
            let is_frame = matches!(item, Captured::Frame(_));
            match item {
                Captured::Trigger(trigger) => {
                    now_ns = now_ns.max(trigger.arrival_host_ns);
                    pairer.push_trigger(trigger, &mut outcomes);
                }
                Captured::Frame(frame) => {
                    now_ns = now_ns.max(frame.stamp.arrival_host_ns);
                    pairer.push_frame(frame.stamp, frame, &mut outcomes);
                }
                Captured::Timing(timing) => pairer.set_period_us(timing.frame_period_us),
                Captured::Tick(tick_ns) => {
                    now_ns = now_ns.max(tick_ns);
                    pairer.settle(now_ns, &mut outcomes);
                }
                Captured::Failed(error) => going_on = self.out.send(Err(error)).is_ok(),
            }
            for outcome in outcomes.drain(..) {
                going_on &= self.handle(outcome, now_ns);
            }
            let drift_ppm =
                |side| pairer.camera_clock(side).and_then(|fit| fit.drift()).unwrap_or(0.0) * 1e6;
            self.progress.count(|s| {
                s.drift_left_ppm = drift_ppm(Side::Left);
                s.drift_right_ppm = drift_ppm(Side::Right);
            });
            if is_frame {
                self.progress.end_work();
            }
            if !going_on {
                break;
            }
        }
        // Nobody wants more: capture ends soon; what it still had is counted. Where capture ended by
        // itself, what it said last is on its way and must arrive: then nothing is stopped here.
        if !going_on {
            self.stop.stop();
        }
        for item in self.input.iter() {
            if let Captured::Frame(_) = item {
                self.progress.count(|s| s.rejected.count(Reject::Discarded));
                self.progress.end_work();
            }
        }
        pairer.finish(&mut outcomes);
        for outcome in outcomes {
            self.handle(outcome, now_ns);
        }
    }

    fn handle(&self, outcome: Outcome<Box<CameraFrame>>, now_ns: u64) -> bool {
        match outcome {
            Outcome::Pair(pair) => return self.pass_on(pair, now_ns),
            Outcome::Rejected { cause, .. } => self.progress.count(|s| s.rejected.count(cause)),
            Outcome::Incomplete { missing, .. } => self.progress.count(|s| {
                s.missing_left += u64::from(missing[0]);
                s.missing_right += u64::from(missing[1]);
            }),
            Outcome::EventsLost { count } => {
                self.progress.count(|s| s.events_lost += u64::from(count));
            }
            Outcome::EventIgnored { .. } => self.progress.count(|s| s.events_ignored += 1),
            Outcome::Overtaken { .. } => self.progress.count(|s| s.overtaken += 1),
            Outcome::Locked { .. } | Outcome::Unlocked { .. } => {}
        }
        true
    }

    fn pass_on(&self, pair: Pair<Box<CameraFrame>>, now_ns: u64) -> bool {
        self.progress.mark(Mark::Pair, now_ns);
        self.progress.count(|s| s.pairs += 1);
        // The event is sent at the end of the exposure.
        let last_ns = pair.stamps.iter().map(|s| s.arrival_host_ns).max().unwrap_or(now_ns);
        let arrival_delay =
            Duration::from_nanos(last_ns.saturating_sub(pair.trigger.arrival_host_ns));
        let labelled = Ok(LabelledPair {
            label: pair.trigger.label,
            timing_generation: pair.trigger.timing_generation,
            left: pair.left.image,
            right: pair.right.image,
            stamps: Some(pair.stamps),
            arrival_delay,
            paired_at: Instant::now(),
        });
        self.progress.begin_work();
        if self.lossless {
            let sent = self.out.send(labelled).is_ok();
            if !sent {
                self.progress.end_work();
            }
            return sent;
        }
        match self.out.try_send(labelled) {
            Ok(()) => true,
            Err(TrySendError::Full(_)) => {
                self.progress.count(|s| s.dropped_pairs += 1);
                self.progress.end_work();
                true
            }
            Err(TrySendError::Disconnected(_)) => {
                self.progress.end_work();
                false
            }
        }
    }
}
