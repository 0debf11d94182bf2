//! The capture thread: moves events and frames to the host, keeps the heart beating, watches for
//! silence, and switches the light off at the end.

use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::{SendTimeoutError, Sender, TrySendError};
use stspp_protocol::event::TriggerEvent;
use stspp_protocol::message::Event;
use stspp_protocol::reply::DeviceState;

use super::stats::{Mark, Progress};
use super::stream::StopHandle;
use crate::camera::CameraFrame;
use crate::clock::duration_ns;
use crate::error::{Error, Faulted, Missing, Timeout};
use crate::sensor::Session;
use crate::sync::pairer::Reject;
use crate::sync::{Side, Trigger};
use crate::{ProjectionTiming, SlotLabel};

/// How long the cameras are waited for before the control link is looked at again.
const SLICE: Duration = Duration::from_millis(2);

/// How often a full queue is tried again, and the stop flag looked at.
const RETRY: Duration = Duration::from_millis(20);

/// What capture hands to pairing.
pub(crate) enum Captured {
    Trigger(Trigger),
    Frame(Box<CameraFrame>),
    /// Triggers of this timing follow.
    Timing(ProjectionTiming),
    /// Time has passed.
    Tick(u64),
    Failed(Error),
}

pub(crate) struct Capture {
    pub session: Arc<Session>,
    pub progress: Arc<Progress>,
    pub stop: StopHandle,
    pub timeout: Duration,
    pub out: Sender<Captured>,
    pub generation: u16,
}

/// Switches the light off, however the thread ends.
struct LightsOff<'a>(&'a Session);

impl Drop for LightsOff<'_> {
    fn drop(&mut self) {
        self.0.stop();
    }
}

impl Capture {
    /// Runs until told to stop, until nobody takes frames any more, or until the device is at fault.
    pub fn run(mut self) {
        let session = Arc::clone(&self.session);
        let _lights_off = LightsOff(&session);
        if let Err(error) = self.stream() {
            self.send(Captured::Failed(error));
        }
    }

    fn stream(&mut self) -> Result<(), Error> {
        let session = Arc::clone(&self.session);
        let mut cameras = session.cameras();
        let lossless = cameras.is_lossless();
        let mut seen_damaged = cameras.damaged();
        while !self.stop.is_stopped() {
            if !self.take_events()? {
                return Ok(());
            }
            let frame = cameras.next_frame(SLICE)?;
            let damaged = cameras.damaged();
            if damaged != seen_damaged {
                let new = [0, 1].map(|side| damaged[side] - seen_damaged[side]);
                seen_damaged = damaged;
                self.progress.count(|s| {
                    s.damaged_left += new[0];
                    s.damaged_right += new[1];
                });
            }
            let now_ns = self.session.clock.now_ns();
            let going_on = match frame {
                Some(frame) => self.take_frame(frame, lossless)?,
                None => self.send(Captured::Tick(now_ns)),
            };
            if !going_on {
                return Ok(());
            }
            self.check_silence(now_ns)?;
        }
        Ok(())
    }

    /// Passes on what the device has said. `false` when nobody listens any more.
    fn take_events(&mut self) -> Result<bool, Error> {
        loop {
            let event = {
                let mut link = self.session.link();
                match link.next_event() {
                    Some(event) => event,
                    None => {
                        link.pump(Duration::ZERO)?;
                        match link.next_event() {
                            Some(event) => event,
                            None => return Ok(true),
                        }
                    }
                }
            };
            let going_on = match event.event {
                Event::TriggerEvent(trigger) => self.take_trigger(trigger, event.arrival_host_ns),
                Event::FaultEvent(fault) => {
                    return Err(Faulted {
                        record: Some(fault.record),
                        latched: fault.latched,
                        state: DeviceState::Faulted,
                    }
                    .into());
                }
                Event::BootEvent(boot) => {
                    return Err(Error::DeviceReset(format!("{:?}", boot.reset_cause)));
                }
                // The triggers themselves carry the generation; a state is told by its consequences.
                Event::TimingEvent(_) | Event::StateEvent(_) => true,
            };
            if !going_on {
                return Ok(false);
            }
        }
    }

    fn take_trigger(&mut self, event: TriggerEvent, arrival_host_ns: u64) -> bool {
        self.progress.mark(Mark::Trigger, arrival_host_ns);
        let Some(timing) = self.session.timing(event.timing_generation) else {
            self.progress.count(|s| s.events_ignored += 1);
            return true;
        };
        self.progress.count(|s| s.triggers += 1);
        let exposure_us = timing.exposure_us;
        if event.timing_generation != self.generation {
            self.generation = event.timing_generation;
            if !self.send(Captured::Timing(timing)) {
                return false;
            }
        }
        self.send(Captured::Trigger(Trigger {
            label: SlotLabel {
                sequence: event.frame_sequence,
                slot: u16::from(event.slot_index),
                projector_mask: event.projector_mask,
                floodlight: event.floodlight,
                trigger_time_us: event.trigger_time_us,
                exposure_us,
            },
            timing_generation: event.timing_generation,
            arrival_host_ns,
            usb_sof: event.usb_sof,
        }))
    }

    fn take_frame(&mut self, frame: CameraFrame, lossless: bool) -> Result<bool, Error> {
        let side = frame.stamp.side;
        self.progress.mark(Mark::Frame(side), frame.stamp.arrival_host_ns);
        self.progress.count(|s| match side {
            Side::Left => s.frames_left += 1,
            Side::Right => s.frames_right += 1,
        });
        self.session.check_size(side, &frame.image)?;
        self.progress.begin_work();
        let frame = Captured::Frame(Box::new(frame));
        let sent = if lossless {
            self.send(frame)
        } else {
            match self.out.try_send(frame) {
                Ok(()) => return Ok(true),
                Err(TrySendError::Full(_)) => {
                    self.progress.count(|s| s.dropped_capture += 1);
                    self.progress.end_work();
                    return Ok(true);
                }
                Err(TrySendError::Disconnected(_)) => false,
            }
        };
        if !sent {
            self.progress.count(|s| s.rejected.count(Reject::Discarded));
            self.progress.end_work();
        }
        Ok(sent)
    }

    /// Reports that no window has come for too long, and why.
    fn check_silence(&mut self, now_ns: u64) -> Result<(), Error> {
        let since_ns = self.progress.waiting_since_ns();
        let silent_ns = now_ns.saturating_sub(since_ns);
        if silent_ns < duration_ns(self.timeout) || self.progress.is_busy() {
            return Ok(());
        }
        let missing = missing(&self.session, &self.progress, since_ns)?;
        self.progress.restart_waiting(now_ns);
        self.send(Captured::Failed(Timeout { waited: self.timeout, missing }.into()));
        Ok(())
    }

    /// Sends, waiting for room. `false` when nobody listens any more or the stream is stopped.
    fn send(&self, mut item: Captured) -> bool {
        loop {
            match self.out.send_timeout(item, RETRY) {
                Ok(()) => return true,
                Err(SendTimeoutError::Disconnected(_)) => return false,
                Err(SendTimeoutError::Timeout(_)) if self.stop.is_stopped() => return false,
                Err(SendTimeoutError::Timeout(back)) => item = back,
            }
        }
    }
}

/// What has been missing since `since_ns`.
///
/// # Errors
/// When the reason is a latched fault, or the device does not answer at all.
pub(crate) fn missing(
    session: &Session,
    progress: &Progress,
    since_ns: u64,
) -> Result<Missing, Error> {
    let reached = |mark| progress.reached(mark, since_ns);
    if !reached(Mark::Trigger) {
        session.check_faults()?;
        return Ok(Missing::Trigger);
    }
    let frames = Side::BOTH.map(|side| reached(Mark::Frame(side)));
    Ok(match frames {
        [false, false] => Missing::Exposure,
        [false, true] => Missing::Camera(Side::Left),
        [true, false] => Missing::Camera(Side::Right),
        _ if !reached(Mark::Pair) => Missing::Pairing,
        _ if progress.is_busy() => Missing::Matching,
        _ => Missing::Window,
    })
}
