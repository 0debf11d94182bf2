//! Pairing: which trigger each camera frame belongs to, and which two frames make a pair.
//!
//! A frame belongs to a trigger when three things agree: its timestamp is where the fitted line puts
//! the trigger, the difference of the two sequence numbers is what it was, and it reached the host as
//! long after its exposure's end as frames do; or, on the device's own USB bus, when its timestamp and
//! the bus's frame number agree. A frame that is only late waits until later frames have
//! confirmed the first two; whatever else disagrees is rejected with a cause. Pairs come out in the
//! triggers' order; a trigger waits for its frames, and a gap for its event, at most
//! [`PairerConfig::patience_ns`].

use std::collections::VecDeque;

use super::fit::ClockFit;
use super::lock::{self, LockConfig};
use super::{FrameStamp, Side, Trigger};

/// Finished triggers that late and repeated frames are recognised by.
const HISTORY: usize = 64;

/// Triggers that may wait for frames; at 1 kHz a quarter of a second.
const PENDING: usize = 256;

/// Frames of one camera that may wait for a lock.
const HELD: usize = 24;

/// Consecutive frames after which a changed difference of sequence numbers is believed: the camera
/// has missed an exposure.
const CONFIRM: u32 = 3;

/// Later frames that must agree on the difference of sequence numbers before a late frame is used: an
/// exposure missed just before a wrong timestamp looks like a late frame until then.
const CONFIRM_LATE: usize = 2;

/// Frames whose delays and sequence numbers are remembered.
const RECENT: usize = 8;

/// Consecutive frames without a trigger after which the camera's clock is taken for a new one.
const MISFITS: u32 = 8;

/// What the pairer needs to know of the timing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PairerConfig {
    /// Period of the triggers in nanoseconds.
    pub period_ns: u64,
    /// How long a trigger waits for its frames and a frame for its trigger, in nanoseconds of the
    /// host's clock.
    pub patience_ns: u64,
    /// Distance of a timestamp from the fitted line up to which it is that trigger's.
    pub tolerance_ns: u64,
    /// How much later than the least delayed frame an event may reach the host.
    pub slack_ns: u64,
    /// Sequence of the first trigger, when the cameras were started before it, so that their first
    /// frames are its.
    pub first_sequence: Option<u32>,
}

impl PairerConfig {
    /// Defaults for triggers every `period_us`, of which the first is number `first_sequence`; the
    /// cameras were started before.
    pub fn new(period_us: u32, first_sequence: u32) -> Self {
        let period_ns = u64::from(period_us) * 1000;
        Self {
            period_ns,
            patience_ns: (3 * period_ns).max(100_000_000),
            tolerance_ns: (period_ns / 4).min(4_000_000),
            slack_ns: (period_ns / 8).min(4_000_000),
            first_sequence: Some(first_sequence),
        }
    }
}

/// Why a frame came to nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Reject {
    /// Its sequence number, its pixels or its trigger had been seen before.
    Duplicate,
    /// Its trigger had been given up.
    Late,
    /// No trigger event fits its timestamp.
    NoTrigger,
    /// Timestamp, sequence number and arrival contradict each other.
    Mislabelled,
    /// The other camera's frame of the same trigger is missing.
    PartnerMissing,
    /// The camera's clock could not be tied to the device's.
    Unsynchronised,
    /// The stream was stopped or its timing changed while the frame was waiting.
    Discarded,
}

/// Two frames of one trigger.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair<F> {
    /// The trigger.
    pub trigger: Trigger,
    /// Stamps of the frames, left first.
    pub stamps: [FrameStamp; 2],
    /// The left frame.
    pub left: F,
    /// The right frame.
    pub right: F,
}

/// What came of the input.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome<F> {
    /// A pair; pairs come in the triggers' order.
    Pair(Pair<F>),
    /// A frame that came to nothing.
    Rejected {
        /// Its stamp.
        stamp: FrameStamp,
        /// The frame.
        frame: F,
        /// Why.
        cause: Reject,
    },
    /// A trigger without its frames.
    Incomplete {
        /// The trigger.
        trigger: Trigger,
        /// Whether the [left, right] frame is missing.
        missing: [bool; 2],
    },
    /// Trigger events that never came, seen by the gap in their sequence.
    EventsLost {
        /// Number of events.
        count: u32,
    },
    /// A trigger event that came twice, or too late to be of use.
    EventIgnored {
        /// Its sequence number.
        sequence: u32,
    },
    /// A frame overtook another of its camera; it is used all the same.
    Overtaken {
        /// The frame that came second though it was taken first.
        stamp: FrameStamp,
    },
    /// A camera's clock was tied to the device's.
    Locked {
        /// Which camera.
        side: Side,
        /// Least delay from exposure end to arrival, in nanoseconds.
        latency_ns: i64,
    },
    /// A camera's clock no longer fits the device's.
    Unlocked {
        /// Which camera.
        side: Side,
    },
}

struct Pending<F> {
    trigger: Trigger,
    frames: [Option<(FrameStamp, F)>; 2],
}

struct Finished {
    trigger: Trigger,
    paired: bool,
}

struct Tied {
    fit: ClockFit,
    offset: i64,
    /// (sequence, delay after the exposure's end) of the last frames that were used.
    recent: VecDeque<(u32, i64)>,
    /// Whether the bus's frame numbers tied it.
    proven: bool,
    changed: Option<(i64, u32)>,
    misfits: u32,
}

impl Tied {
    fn misfit(&mut self, cause: Reject) -> Verdict {
        self.misfits += 1;
        if self.misfits >= MISFITS { Verdict::Unlock } else { Verdict::Reject(cause) }
    }

    fn latency_ns(&self) -> i64 {
        self.recent.iter().map(|&(_, latency_ns)| latency_ns).min().unwrap_or(0)
    }

    fn longest_latency_ns(&self) -> u64 {
        let longest_ns = self.recent.iter().map(|&(_, latency_ns)| latency_ns).max();
        longest_ns.and_then(|ns| u64::try_from(ns).ok()).unwrap_or(0)
    }
}

struct Camera<F> {
    tied: Option<Tied>,
    counted_offset: Option<i64>,
    held: VecDeque<(FrameStamp, F)>,
    /// Its bus frame numbers fit no trigger: some cameras send anything there.
    sof_is_wrong: bool,
    seen: VecDeque<(u32, Option<u64>)>,
}

/// The state machine.
pub struct Pairer<F> {
    config: PairerConfig,
    pending: VecDeque<Pending<F>>,
    finished: VecDeque<Finished>,
    cameras: [Camera<F>; 2],
    next_sequence: Option<u32>,
}

enum Verdict {
    Wait,
    Attach(usize),
    Reject(Reject),
    Unlock,
}

enum Place {
    Pending(usize),
    Finished { paired: bool },
}

fn offset_of(trigger: &Trigger, stamp: &FrameStamp) -> i64 {
    i64::from(trigger.label.sequence) - i64::from(stamp.sequence)
}

impl<F> Pairer<F> {
    /// A pairer for triggers that start after this.
    pub fn new(config: PairerConfig) -> Self {
        let camera = || Camera {
            tied: None,
            counted_offset: config.first_sequence.map(i64::from),
            held: VecDeque::new(),
            sof_is_wrong: false,
            seen: VecDeque::new(),
        };
        Self {
            config,
            pending: VecDeque::new(),
            finished: VecDeque::new(),
            cameras: [camera(), camera()],
            next_sequence: config.first_sequence,
        }
    }

    /// Goes on with triggers every `period_us`: a new timing took effect.
    pub fn set_period_us(&mut self, period_us: u32) {
        let PairerConfig { first_sequence, patience_ns, .. } = self.config;
        let new = PairerConfig::new(period_us, 0);
        let patience_ns = new.patience_ns.max(patience_ns);
        self.config = PairerConfig { first_sequence, patience_ns, ..new };
    }

    /// Takes a trigger event.
    pub fn push_trigger(&mut self, trigger: Trigger, out: &mut Vec<Outcome<F>>) {
        let sequence = trigger.label.sequence;
        let known = self.pending.iter().any(|p| p.trigger.label.sequence == sequence)
            || self.finished.iter().any(|f| f.trigger.label.sequence == sequence);
        if known || self.next_sequence.is_some_and(|next| sequence < next) {
            out.push(Outcome::EventIgnored { sequence });
            return;
        }
        let at = self.pending.partition_point(|p| p.trigger.label.sequence < sequence);
        self.pending.insert(at, Pending { trigger, frames: [None, None] });
        self.settle(trigger.arrival_host_ns, out);
    }

    /// Takes a camera frame.
    pub fn push_frame(&mut self, mut stamp: FrameStamp, frame: F, out: &mut Vec<Outcome<F>>) {
        let camera = &mut self.cameras[stamp.side.index()];
        let repeated = camera.seen.iter().any(|&(sequence, fingerprint)| {
            sequence == stamp.sequence
                || (fingerprint.is_some() && fingerprint == stamp.fingerprint)
        });
        if repeated {
            out.push(Outcome::Rejected { stamp, frame, cause: Reject::Duplicate });
            return;
        }
        if camera.seen.iter().any(|&(sequence, _)| sequence > stamp.sequence) {
            out.push(Outcome::Overtaken { stamp });
        }
        if camera.seen.len() == HISTORY {
            camera.seen.pop_front();
        }
        camera.seen.push_back((stamp.sequence, stamp.fingerprint));
        if camera.held.len() == HELD {
            // So many frames, and no lock in sight: without that witness, then.
            if camera.tied.is_none() {
                camera.sof_is_wrong = true;
                camera.held.iter_mut().for_each(|(stamp, _)| stamp.usb_sof = None);
            }
            let (stamp, frame) = camera.held.pop_front().expect("HELD is not 0");
            out.push(Outcome::Rejected { stamp, frame, cause: Reject::Unsynchronised });
        }
        if camera.sof_is_wrong {
            stamp.usb_sof = None;
        }
        camera.held.push_back((stamp, frame));
        self.settle(stamp.arrival_host_ns, out);
    }

    /// Lets time pass to `now_host_ns`: gives up what has waited too long.
    pub fn settle(&mut self, now_host_ns: u64, out: &mut Vec<Outcome<F>>) {
        for side in Side::BOTH {
            if self.cameras[side.index()].tied.is_none() {
                self.try_lock(side, out);
            }
            self.label_held(side, now_host_ns, out);
        }
        self.emit(now_host_ns, out);
    }

    /// Rejects everything that is still waiting.
    pub fn finish(&mut self, out: &mut Vec<Outcome<F>>) {
        for camera in &mut self.cameras {
            for (stamp, frame) in camera.held.drain(..) {
                out.push(Outcome::Rejected { stamp, frame, cause: Reject::Discarded });
            }
        }
        for pending in self.pending.drain(..) {
            for (stamp, frame) in pending.frames.into_iter().flatten() {
                out.push(Outcome::Rejected { stamp, frame, cause: Reject::Discarded });
            }
        }
    }

    /// The fitted clock of a camera, once it is locked.
    pub fn camera_clock(&self, side: Side) -> Option<&ClockFit> {
        self.cameras[side.index()].tied.as_ref().map(|tied| &tied.fit)
    }

    /// Frames that are waiting for a trigger or for their partner.
    pub fn waiting_frames(&self) -> usize {
        self.cameras.iter().map(|c| c.held.len()).sum::<usize>()
            + self.pending.iter().flat_map(|p| &p.frames).filter(|f| f.is_some()).count()
    }

    fn triggers(&self) -> impl Iterator<Item = &Trigger> {
        self.finished.iter().map(|f| &f.trigger).chain(self.pending.iter().map(|p| &p.trigger))
    }

    fn try_lock(&mut self, side: Side, out: &mut Vec<Outcome<F>>) {
        let camera = &self.cameras[side.index()];
        let mut stamps: Vec<FrameStamp> = camera.held.iter().map(|(stamp, _)| *stamp).collect();
        stamps.sort_by_key(|stamp| stamp.sequence);
        let mut triggers: Vec<Trigger> = self.triggers().copied().collect();
        triggers.sort_by_key(|t| t.label.sequence);
        let config = LockConfig {
            period_ns: self.config.period_ns,
            tolerance_ns: self.config.tolerance_ns,
            slack_ns: self.config.slack_ns,
            counted_offset: camera.counted_offset,
        };
        let Some(lock) = lock::find(&triggers, &stamps, &config) else { return };
        // Two cameras of one sensor are read out alike: half a period apart, one of them is off. Not so
        // where the bus's frame number decides: a slow host fetches one picture long after the other.
        let other = &self.cameras[1 - side.index()];
        let apart = other.tied.as_ref().filter(|tied| {
            (tied.latency_ns() - lock.latency_ns).unsigned_abs() > self.config.period_ns / 2
        });
        if let Some(tied) = apart.filter(|_| !lock.proven) {
            if !tied.proven {
                self.unlock(Side::BOTH[1 - side.index()], out);
            }
            return;
        }
        let mut fit = ClockFit::default();
        for &(device_ns, camera_ns) in &lock.points_ns {
            fit.add(device_ns, camera_ns);
        }
        out.push(Outcome::Locked { side, latency_ns: lock.latency_ns });
        self.cameras[side.index()].tied = Some(Tied {
            fit,
            offset: lock.offset,
            recent: lock.latencies_ns.into_iter().collect(),
            proven: lock.proven,
            changed: None,
            misfits: 0,
        });
    }

    fn unlock(&mut self, side: Side, out: &mut Vec<Outcome<F>>) {
        let camera = &mut self.cameras[side.index()];
        camera.counted_offset = camera.tied.take().map(|tied| tied.offset);
        out.push(Outcome::Unlocked { side });
    }

    fn label_held(&mut self, side: Side, now_host_ns: u64, out: &mut Vec<Outcome<F>>) {
        let mut index = 0;
        while let Some(&(stamp, _)) = self.cameras[side.index()].held.get(index) {
            match self.judge(&stamp, now_host_ns) {
                Verdict::Wait => {
                    index += 1;
                    continue;
                }
                Verdict::Unlock => {
                    self.unlock(side, out);
                    return;
                }
                Verdict::Attach(at) => {
                    let held = self.cameras[side.index()].held.remove(index);
                    self.pending[at].frames[side.index()] = held;
                }
                Verdict::Reject(cause) => {
                    if let Some((stamp, frame)) = self.cameras[side.index()].held.remove(index) {
                        out.push(Outcome::Rejected { stamp, frame, cause });
                    }
                }
            }
        }
    }

    /// The trigger that a frame's timestamp fits, if any: pending ones by their index.
    fn by_time(&self, stamp: &FrameStamp) -> Option<(Trigger, Place)> {
        let fit = &self.cameras[stamp.side.index()].tied.as_ref()?.fit;
        let tolerance_ns = self.config.tolerance_ns as f64;
        let pending =
            self.pending.iter().enumerate().map(|(at, p)| (p.trigger, Place::Pending(at)));
        let finished =
            self.finished.iter().map(|f| (f.trigger, Place::Finished { paired: f.paired }));
        pending
            .chain(finished)
            .filter(|(trigger, _)| trigger.sof_agrees(stamp) != Some(false))
            .filter_map(|(trigger, place)| {
                let residual_ns =
                    fit.residual_ns(trigger.time_device_ns(), stamp.timestamp_camera_ns)?.abs();
                (residual_ns <= tolerance_ns).then_some((residual_ns, trigger, place))
            })
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, trigger, place)| (trigger, place))
    }

    /// How many later frames of the camera agree with `offset`; `None` when one disagrees.
    fn confirmations(&self, stamp: &FrameStamp, offset: i64) -> Option<usize> {
        let camera = &self.cameras[stamp.side.index()];
        let used = camera.tied.as_ref().map_or(0, |tied| {
            tied.recent.iter().filter(|&&(sequence, _)| sequence > stamp.sequence).count()
        });
        let later = camera.held.iter().map(|(s, _)| s).filter(|s| s.sequence > stamp.sequence);
        later
            .filter_map(|s| Some(offset_of(&self.by_time(s)?.0, s)))
            .try_fold(used, |count, other| (other == offset).then_some(count + 1))
    }

    /// Decides on one held frame, and learns from it.
    fn judge(&mut self, stamp: &FrameStamp, now_host_ns: u64) -> Verdict {
        let newest = self.pending.iter().rev().map(|p| &p.trigger);
        let newest = newest.chain(self.finished.iter().rev().map(|f| &f.trigger));
        let host_from_device_ns = lock::host_from_device_ns(newest);
        let found = self.by_time(stamp);
        let confirmations = found
            .as_ref()
            .and_then(|(trigger, _)| self.confirmations(stamp, offset_of(trigger, stamp)));
        let patient = now_host_ns < stamp.arrival_host_ns.saturating_add(self.config.patience_ns);
        let Some(tied) = self.cameras[stamp.side.index()].tied.as_mut() else {
            return Verdict::Wait;
        };
        let (at, trigger) = match found {
            Some((trigger, Place::Pending(at))) => (at, trigger),
            Some((_, Place::Finished { paired: true })) => {
                return Verdict::Reject(Reject::Duplicate);
            }
            Some((_, Place::Finished { paired: false })) => return Verdict::Reject(Reject::Late),
            None if patient => return Verdict::Wait,
            None => return tied.misfit(Reject::NoTrigger),
        };
        let end_ns = (trigger.time_device_ns() + trigger.exposure_ns()) as i64;
        let latency_ns = stamp.arrival_host_ns as i64 - end_ns - host_from_device_ns.unwrap_or(0);
        let usual = (latency_ns - tied.latency_ns()).unsigned_abs() < self.config.period_ns / 2;
        let offset = offset_of(&trigger, stamp);
        // The bus's frame number is the same instant on one clock: no other witness is needed.
        let proven = trigger.sof_agrees(stamp) == Some(true);
        if offset != tied.offset && proven {
            // Frames were lost before they were counted.
            tied.offset = offset;
            tied.recent.clear();
        } else if offset != tied.offset {
            let count = match tied.changed {
                Some((changed, count)) if changed == offset => count + 1,
                _ => 1,
            };
            tied.changed = Some((offset, count));
            if count < CONFIRM {
                return Verdict::Reject(Reject::Mislabelled);
            }
            // A missed exposure leaves the delay as it was; a jump of the camera's clock does not.
            if !usual {
                return Verdict::Unlock;
            }
            tied.offset = offset;
            tied.recent.clear();
        } else if latency_ns < -(self.config.slack_ns as i64) {
            return Verdict::Reject(Reject::Mislabelled);
        } else if !proven
            && !usual
            && (tied.changed.is_some() || confirmations.is_none_or(|count| count < CONFIRM_LATE))
        {
            if patient {
                return Verdict::Wait;
            }
            return tied.misfit(Reject::Late);
        }
        tied.changed = None;
        tied.misfits = 0;
        if self.pending[at].frames[stamp.side.index()].is_some() {
            return Verdict::Reject(Reject::Duplicate);
        }
        tied.fit.add(trigger.time_device_ns(), stamp.timestamp_camera_ns);
        while tied.recent.len() >= RECENT {
            tied.recent.pop_front();
        }
        tied.recent.push_back((stamp.sequence, latency_ns));
        Verdict::Attach(at)
    }

    /// Lets go of the oldest triggers that are complete or have waited too long.
    fn emit(&mut self, now_host_ns: u64, out: &mut Vec<Outcome<F>>) {
        let locked = self.cameras.iter().all(|camera| camera.tied.is_some());
        // A host that takes long to fetch a frame takes long to fetch each.
        let usual_ns =
            self.cameras.iter().filter_map(|c| Some(c.tied.as_ref()?.longest_latency_ns())).max();
        let patience_ns = self.config.patience_ns + usual_ns.unwrap_or(0);
        while let Some(front) = self.pending.front() {
            let trigger = front.trigger;
            let sequence = trigger.label.sequence;
            let waited_ns = now_host_ns.saturating_sub(trigger.arrival_host_ns);
            let overfull = self.pending.len() > PENDING;
            let complete = front.frames.iter().all(Option::is_some);
            // Before the lock nothing can have arrived, so that nothing is late either.
            let impatient = overfull
                || if locked {
                    waited_ns > trigger.exposure_ns() + patience_ns
                } else {
                    self.pending.len() > HELD
                };
            let in_order = self.next_sequence.is_none_or(|next| sequence == next);
            if !(impatient || complete && (in_order || waited_ns > self.config.patience_ns)) {
                return;
            }
            let Some(front) = self.pending.pop_front() else { return };
            if let Some(count @ 1..) = self.next_sequence.map(|next| sequence.saturating_sub(next))
            {
                out.push(Outcome::EventsLost { count });
            }
            self.next_sequence = sequence.checked_add(1);
            if self.finished.len() == HISTORY {
                self.finished.pop_front();
            }
            self.finished.push_back(Finished { trigger, paired: complete });
            match front.frames {
                [Some((left_stamp, left)), Some((right_stamp, right))] => {
                    let stamps = [left_stamp, right_stamp];
                    out.push(Outcome::Pair(Pair { trigger, stamps, left, right }));
                }
                frames => {
                    let missing = [frames[0].is_none(), frames[1].is_none()];
                    out.push(Outcome::Incomplete { trigger, missing });
                    for (stamp, frame) in frames.into_iter().flatten() {
                        let cause = Reject::PartnerMissing;
                        out.push(Outcome::Rejected { stamp, frame, cause });
                    }
                }
            }
        }
    }
}
