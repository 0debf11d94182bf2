//! Tying a camera's clock to the device's, from nothing.
//!
//! Triggers and exposures are both periodic, so that timestamps alone fit at every shift by a period.
//! Two witnesses decide the shift:
//!
//! 1. causality: a frame reaches the host after its exposure's end and, when it is not delayed, before
//!    the next exposure's end. The least delayed quarter of the frames is looked at.
//! 2. counting: cameras are started before the triggers, so that the first frame (camera sequence 0)
//!    is the first trigger's, unless one was lost.
//!
//! Where camera and device hang on one USB bus, both tell its frame number at the exposure's start: a
//! third witness, which needs no other, as it is the same instant on one clock.
//!
//! Where both agree, four frames are enough. Where they do not (an exposure was missed at the start,
//! or every frame was delayed by a period), the lock waits for twelve and follows causality.

use super::{FrameStamp, Trigger};

/// Frames needed when both witnesses agree.
const FRAMES_AGREED: usize = 4;

/// Frames needed when causality stands alone.
const FRAMES_ALONE: usize = 12;

/// What is known before the lock.
#[derive(Debug, Clone, Copy)]
pub struct LockConfig {
    /// Period of the triggers in nanoseconds.
    pub period_ns: u64,
    /// Scatter of timestamps that is still one exposure's.
    pub tolerance_ns: u64,
    /// How much later than the least delayed frame an event may reach the host.
    pub slack_ns: u64,
    /// Trigger sequence minus frame sequence as counted from the start, where that is known.
    pub counted_offset: Option<i64>,
}

/// A camera's clock tied to the device's.
#[derive(Debug, Clone, PartialEq)]
pub struct Lock {
    /// Trigger sequence minus frame sequence.
    pub offset: i64,
    /// Delay of the least delayed frames' arrival after the exposure's end, in nanoseconds.
    pub latency_ns: i64,
    /// (device, camera) times of the frames that agree, in nanoseconds.
    pub points_ns: Vec<(u64, u64)>,
    /// (frame sequence, arrival after the exposure's end in nanoseconds) of the same frames.
    pub latencies_ns: Vec<(u32, i64)>,
    /// Whether the bus's frame numbers say so, and nothing else was needed.
    pub proven: bool,
}

/// Newest events that tie the host's clock to the device's. When the host's clock has stepped, events of
/// before say nothing of it any more: they must be gone before [`FRAMES_ALONE`] frames could agree on a
/// wrong shift.
const EVENTS: usize = 8;

/// Offset from device to host time: the least time from an exposure's end, when the device sends the
/// trigger's event, to the event's arrival. The least delayed event was not queued anywhere. Triggers
/// come newest first.
pub fn host_from_device_ns<'a>(newest: impl Iterator<Item = &'a Trigger>) -> Option<i64> {
    newest
        .take(EVENTS)
        .map(|t| t.arrival_host_ns.wrapping_sub(t.time_device_ns() + t.exposure_ns()) as i64)
        .min()
}

/// Looks for the shift at which `frames` (of one camera) belong to `triggers` (in order). `None`
/// while there are too few, or they contradict each other.
pub fn find(triggers: &[Trigger], frames: &[FrameStamp], config: &LockConfig) -> Option<Lock> {
    if frames.len() < FRAMES_AGREED || triggers.len() < FRAMES_AGREED {
        return None;
    }
    let host_from_device_ns = host_from_device_ns(triggers.iter().rev())?;
    let mut delays_ns: Vec<i64> = frames
        .iter()
        .map(|f| f.arrival_host_ns.wrapping_sub(f.timestamp_camera_ns) as i64)
        .collect();
    delays_ns.sort_unstable();
    let host_from_camera_ns = delays_ns[delays_ns.len() / 4];

    let exposure_end_host_ns =
        |t: &Trigger| (t.time_device_ns() + t.exposure_ns()) as i64 + host_from_device_ns;
    let mut found: Vec<(&FrameStamp, &Trigger, i64)> = Vec::new();
    for frame in frames {
        let arrival_ns = frame.timestamp_camera_ns.wrapping_add_signed(host_from_camera_ns) as i64;
        // Where the bus's frame number agrees, it is enough that the frame came after its event: both
        // offsets are wrong for a host that gets slower and slower.
        let candidate = triggers.iter().rev().find(|t| match t.sof_agrees(frame) {
            Some(false) => false,
            Some(true) if t.arrival_host_ns <= frame.arrival_host_ns + config.slack_ns => true,
            _ => exposure_end_host_ns(t) <= arrival_ns + config.slack_ns as i64,
        });
        if let Some(trigger) = candidate {
            let latency_ns = arrival_ns - exposure_end_host_ns(trigger);
            let proven = trigger.sof_agrees(frame) == Some(true);
            if proven || latency_ns < config.period_ns as i64 - config.slack_ns as i64 {
                found.push((frame, trigger, latency_ns));
            }
        }
    }
    if found.len() < FRAMES_AGREED {
        return None;
    }

    let shift_ns =
        |f: &FrameStamp, t: &Trigger| f.timestamp_camera_ns.wrapping_sub(t.time_device_ns()) as i64;
    let mut shifts_ns: Vec<i64> = found.iter().map(|(f, t, _)| shift_ns(f, t)).collect();
    shifts_ns.sort_unstable();
    let median_ns = shifts_ns[shifts_ns.len() / 2];
    found.retain(|(f, t, _)| (shift_ns(f, t) - median_ns).unsigned_abs() <= config.tolerance_ns);

    let offset = |f: &FrameStamp, t: &Trigger| i64::from(t.label.sequence) - i64::from(f.sequence);
    let newest = found.last().map(|(f, t, _)| offset(f, t))?;
    found.retain(|(f, t, _)| offset(f, t) == newest);
    let proven = found.iter().all(|(f, t, _)| t.sof_agrees(f) == Some(true));
    let agreed = proven || config.counted_offset == Some(newest);
    let needed = if agreed { FRAMES_AGREED } else { FRAMES_ALONE };
    if found.len() < needed {
        return None;
    }
    let prompt = |f: &FrameStamp, t: &Trigger| {
        let latency_ns = f.arrival_host_ns as i64 - exposure_end_host_ns(t);
        let slack_ns = config.slack_ns as i64;
        (-slack_ns..config.period_ns as i64 - slack_ns).contains(&latency_ns)
    };
    // The newest frames' own arrivals must say the same, whatever the timestamps of others were.
    if !proven && !found.iter().rev().take(FRAMES_AGREED).all(|(f, t, _)| prompt(f, t)) {
        return None;
    }
    let latency_ns = found.iter().map(|&(_, _, latency_ns)| latency_ns).min()?;
    let points_ns =
        found.iter().map(|(f, t, _)| (t.time_device_ns(), f.timestamp_camera_ns)).collect();
    let latencies_ns = found
        .iter()
        .map(|(f, t, _)| (f.sequence, f.arrival_host_ns as i64 - exposure_end_host_ns(t)))
        .collect();
    Some(Lock { offset: newest, latency_ns, points_ns, latencies_ns, proven })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SlotLabel;
    use crate::sync::Side;

    const PERIOD_NS: u64 = 33_333_000;
    const CONFIG: LockConfig = LockConfig {
        period_ns: PERIOD_NS,
        tolerance_ns: 4_000_000,
        slack_ns: 4_000_000,
        counted_offset: Some(0),
    };

    fn trigger(sequence: u32) -> Trigger {
        let time_ns = 5_000_000_000 + u64::from(sequence) * PERIOD_NS;
        Trigger {
            label: SlotLabel {
                sequence,
                slot: (sequence % 10) as u16,
                projector_mask: 1,
                floodlight: false,
                trigger_time_us: time_ns / 1000,
                exposure_us: 32_000,
            },
            timing_generation: 0,
            arrival_host_ns: time_ns - 4_000_000_000 + 32_000_000 + 700_000,
            usb_sof: Some((time_ns / 1_000_000 % 2048) as u16),
        }
    }

    /// The frame of trigger `of`, counted `sequence`, that reached the host `delay_ns` late.
    fn frame(sequence: u32, of: u32, delay_ns: u64) -> FrameStamp {
        let start_ns = trigger(of).time_device_ns();
        FrameStamp {
            side: Side::Left,
            sequence,
            timestamp_camera_ns: start_ns + 123_456_789_000,
            arrival_host_ns: start_ns - 4_000_000_000 + 32_000_000 + 8_000_000 + delay_ns,
            fingerprint: None,
            usb_sof: None,
        }
    }

    #[test]
    fn four_undelayed_frames_lock() {
        let triggers: Vec<_> = (0..5).map(trigger).collect();
        let frames: Vec<_> = (0..4).map(|k| frame(k, k, 0)).collect();
        let lock = find(&triggers, &frames, &CONFIG).unwrap();
        assert_eq!(lock.offset, 0);
        assert_eq!(lock.latency_ns, 8_000_000 - 700_000);
        assert!(find(&triggers, &frames[..3], &CONFIG).is_none());
    }

    #[test]
    fn a_lost_first_frame_needs_more_frames_and_still_locks_right() {
        let triggers: Vec<_> = (0..14).map(trigger).collect();
        let frames: Vec<_> = (0..12).map(|k| frame(k, k + 1, 0)).collect();
        assert!(find(&triggers, &frames[..11], &CONFIG).is_none());
        assert_eq!(find(&triggers, &frames, &CONFIG).unwrap().offset, 1);
    }

    #[test]
    fn frames_all_a_period_late_wait_for_one_that_is_not() {
        let triggers: Vec<_> = (0..13).map(trigger).collect();
        let mut frames: Vec<_> = (0..8).map(|k| frame(k, k, PERIOD_NS)).collect();
        assert!(find(&triggers, &frames, &CONFIG).is_none());
        frames.extend((8..12).map(|k| frame(k, k, 0)));
        assert_eq!(find(&triggers, &frames, &CONFIG).map(|lock| lock.offset), Some(0));
    }

    #[test]
    fn frame_numbers_of_the_bus_lock_frames_however_late_they_are() {
        let triggers: Vec<_> = (0..13).map(trigger).collect();
        let with_sof = |k: u32| {
            let usb_sof = trigger(k + 1).usb_sof.map(|sof| (sof + 1) % 2048);
            FrameStamp { usb_sof, ..frame(k, k + 1, 3 * PERIOD_NS) }
        };
        // The first exposure was missed and every frame is three periods late: only the bus knows.
        let frames: Vec<_> = (0..4).map(with_sof).collect();
        assert_eq!(find(&triggers, &frames, &CONFIG).map(|lock| lock.offset), Some(1));
    }

    #[test]
    fn frame_numbers_of_the_bus_lock_frames_of_a_host_that_gets_slower() {
        // Each slot takes half a second of the host's time more than of the device's.
        let slower = |of: u32| u64::from(of) * 500_000_000;
        let triggers: Vec<_> = (0..13)
            .map(|k| Trigger {
                arrival_host_ns: trigger(k).arrival_host_ns + slower(k),
                ..trigger(k)
            })
            .collect();
        let frames: Vec<_> = (0..10)
            .map(|k| FrameStamp { usb_sof: trigger(k).usb_sof, ..frame(k, k, slower(k + 2)) })
            .collect();
        assert_eq!(find(&triggers, &frames, &CONFIG).map(|lock| lock.offset), Some(0));
    }

    #[test]
    fn lost_events_do_not_shift_the_lock() {
        let triggers: Vec<_> = [0, 1, 3, 4, 6, 7].map(trigger).into();
        let frames: Vec<_> = (0..8).map(|k| frame(k, k, 0)).collect();
        assert_eq!(find(&triggers, &frames, &CONFIG).map(|lock| lock.offset), Some(0));
    }
}
