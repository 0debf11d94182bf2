//! Pairing under injected faults: whatever is lost, repeated, swapped, delayed or mis-stamped, no pair
//! and no window is wrong, and every frame is accounted for.

use std::collections::HashMap;

use proptest::prelude::*;
use stspp::SlotLabel;
use stspp::sync::pairer::{Outcome, Pairer, PairerConfig, Reject};
use stspp::sync::window::{SlotLight, Step, Window};
use stspp::sync::{FrameStamp, Side, Trigger};

const SLOTS: u32 = 10;

/// Number of the first trigger: the device goes on counting over streams.
const FIRST: u32 = 1230;

/// What happens to one frame on its way.
#[derive(Debug, Clone, Copy, PartialEq)]
enum FrameFault {
    None,
    /// The camera did not expose: its own count does not move.
    Missed,
    /// Lost between camera and host: the count moves.
    Lost,
    Duplicated,
    /// Arrives later by so many hundredths of a period: others overtake it.
    Delayed(u16),
    /// Stamped with the neighbouring exposure's time.
    MisStamped(i8),
    /// Stamped with any time.
    Garbled(u32),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum EventFault {
    None,
    Lost,
    Duplicated,
    Delayed(u16),
}

fn frame_fault() -> impl Strategy<Value = FrameFault> {
    prop_oneof![
        60 => Just(FrameFault::None),
        1 => Just(FrameFault::Missed),
        2 => Just(FrameFault::Lost),
        2 => Just(FrameFault::Duplicated),
        3 => (1u16..250).prop_map(FrameFault::Delayed),
        2 => prop_oneof![Just(-1i8), Just(1)].prop_map(FrameFault::MisStamped),
        1 => any::<u32>().prop_map(FrameFault::Garbled),
    ]
}

fn event_fault() -> impl Strategy<Value = EventFault> {
    prop_oneof![
        40 => Just(EventFault::None),
        1 => Just(EventFault::Lost),
        1 => Just(EventFault::Duplicated),
        1 => (1u16..250).prop_map(EventFault::Delayed),
    ]
}

enum Arrival {
    Event(Trigger),
    Frame(FrameStamp, u32),
}

struct Link {
    period_ns: u64,
    exposure_ns: u64,
    readout_ns: u64,
    drift_ppm: [i64; 2],
    sof: Sof,
}

/// What the cameras say of the USB bus's frame number.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Sof {
    /// Nothing.
    None,
    /// That of the device's bus, one off now and then.
    Shared,
    /// Something else.
    Wrong,
}

impl Link {
    fn trigger(&self, sequence: u32) -> Trigger {
        let device_ns = 90_000_000 + u64::from(sequence) * self.period_ns;
        Trigger {
            label: SlotLabel {
                sequence,
                slot: (sequence % SLOTS) as u16,
                projector_mask: 1 << (sequence % SLOTS),
                floodlight: false,
                trigger_time_us: device_ns / 1000,
                exposure_us: (self.exposure_ns / 1000) as u32,
            },
            timing_generation: 0,
            arrival_host_ns: 3_000_000_000
                + device_ns
                + self.exposure_ns
                + 300_000
                + u64::from(sequence * 7 % 5) * 90_000,
            usb_sof: Some((device_ns / 1_000_000 % 2048) as u16),
        }
    }

    fn arrivals(&self, faults: &[(EventFault, [FrameFault; 2])]) -> Vec<(u64, Arrival)> {
        let mut arrivals = Vec::new();
        let mut counts = [0u32; 2];
        for (sequence, (event_fault, frame_faults)) in (FIRST..).zip(faults) {
            let trigger = self.trigger(sequence);
            let mut event = |delay_ns: u64| {
                let mut event = trigger;
                event.arrival_host_ns += delay_ns;
                arrivals.push((event.arrival_host_ns, Arrival::Event(event)));
            };
            match event_fault {
                EventFault::None => event(0),
                EventFault::Lost => {}
                EventFault::Duplicated => {
                    event(0);
                    event(self.period_ns / 2);
                }
                EventFault::Delayed(percent) => event(self.period_ns * u64::from(*percent) / 100),
            }
            for side in Side::BOTH {
                let fault = frame_faults[side.index()];
                if fault == FrameFault::Missed {
                    continue;
                }
                let count = &mut counts[side.index()];
                let device_ns = trigger.time_device_ns();
                let camera = |device_ns: u64| {
                    let drift_ns = device_ns as i64 * self.drift_ppm[side.index()] / 1_000_000;
                    (70_000_000_000 + device_ns).wrapping_add_signed(drift_ns)
                };
                let mut stamp = FrameStamp {
                    side,
                    sequence: *count,
                    timestamp_camera_ns: camera(device_ns) + u64::from(sequence * 13 % 7) * 10_000,
                    arrival_host_ns: 3_000_000_000 + device_ns + self.exposure_ns + self.readout_ns,
                    fingerprint: None,
                    usb_sof: match self.sof {
                        Sof::None => None,
                        Sof::Shared => {
                            let off = u64::from(sequence % 3);
                            Some(((device_ns / 1_000_000 + 2047 + off) % 2048) as u16)
                        }
                        Sof::Wrong => Some((sequence * 611 % 2048) as u16),
                    },
                };
                *count += 1;
                match fault {
                    FrameFault::None | FrameFault::Missed => {}
                    FrameFault::Lost => continue,
                    FrameFault::Duplicated => {
                        let again_ns = stamp.arrival_host_ns + self.period_ns / 3;
                        let again = FrameStamp { arrival_host_ns: again_ns, ..stamp };
                        arrivals.push((again_ns, Arrival::Frame(again, sequence)));
                    }
                    FrameFault::Delayed(percent) => {
                        stamp.arrival_host_ns += self.period_ns * u64::from(percent) / 100;
                    }
                    FrameFault::MisStamped(periods) => {
                        stamp.timestamp_camera_ns = stamp
                            .timestamp_camera_ns
                            .wrapping_add_signed(i64::from(periods) * self.period_ns as i64);
                    }
                    FrameFault::Garbled(ns) => stamp.timestamp_camera_ns ^= u64::from(ns) << 8,
                }
                arrivals.push((stamp.arrival_host_ns, Arrival::Frame(stamp, sequence)));
            }
        }
        arrivals.sort_by_key(|(at_ns, _)| *at_ns);
        arrivals
    }
}

/// Runs the arrivals through pairer and window; checks everything that must hold; returns the
/// sequence numbers of the pairs.
fn run(link: &Link, faults: &[(EventFault, [FrameFault; 2])]) -> Vec<u32> {
    let mut pairer = Pairer::new(PairerConfig::new((link.period_ns / 1000) as u32, FIRST));
    let slots = (0..SLOTS).map(|k| SlotLight { projector_mask: 1 << k, floodlight: false });
    let mut window = Window::new(slots.collect(), SLOTS as usize);
    let mut out = Vec::new();
    let mut given: HashMap<(Side, u32, u64), u32> = HashMap::new();
    let key = |s: &FrameStamp| (s.side, s.sequence, s.arrival_host_ns);
    let mut now_ns = 0;
    for (at_ns, arrival) in link.arrivals(faults) {
        now_ns = at_ns;
        match arrival {
            Arrival::Event(trigger) => pairer.push_trigger(trigger, &mut out),
            Arrival::Frame(stamp, truth) => {
                *given.entry(key(&stamp)).or_default() += 1;
                pairer.push_frame(stamp, truth, &mut out);
            }
        }
    }
    for _ in 0..40 {
        now_ns += link.period_ns;
        pairer.settle(now_ns, &mut out);
    }
    pairer.finish(&mut out);
    assert_eq!(pairer.waiting_frames(), 0);

    let mut pairs = Vec::new();
    let mut account = |stamp: &FrameStamp| {
        let count = given.get_mut(&key(stamp)).expect("a frame that was never given");
        *count = count.checked_sub(1).expect("a frame came out twice");
    };
    for outcome in out {
        match outcome {
            Outcome::Pair(pair) => {
                account(&pair.stamps[0]);
                account(&pair.stamps[1]);
                let label = pair.trigger.label;
                assert_eq!(
                    (pair.left, pair.right),
                    (label.sequence, label.sequence),
                    "wrong label"
                );
                assert!(pairs.last().is_none_or(|last| *last < label.sequence), "out of order");
                pairs.push(label.sequence);
                if window.push(label, pair.left) == Step::Complete {
                    let truths: Vec<u32> = window.pairs().map(|(_, truth)| *truth).collect();
                    let first = label.sequence + 1 - SLOTS;
                    assert_eq!(truths, (first..=label.sequence).collect::<Vec<_>>());
                }
            }
            Outcome::Rejected { stamp, .. } => account(&stamp),
            _ => {}
        }
    }
    assert!(given.values().all(|&count| count == 0), "frames unaccounted for");
    pairs
}

fn paper_link() -> Link {
    Link {
        period_ns: 33_333_000,
        exposure_ns: 32_000_000,
        readout_ns: 9_000_000,
        drift_ppm: [37, -52],
        sof: Sof::None,
    }
}

#[test]
fn an_undisturbed_stream_loses_nothing() {
    let faults = vec![(EventFault::None, [FrameFault::None; 2]); 200];
    assert_eq!(run(&paper_link(), &faults), (FIRST..FIRST + 200).collect::<Vec<_>>());
}

#[test]
fn a_thousand_triggers_a_second_pair_too() {
    let link = Link {
        period_ns: 1_000_000,
        exposure_ns: 800_000,
        readout_ns: 700_000,
        drift_ppm: [80, -80],
        sof: Sof::None,
    };
    let faults = vec![(EventFault::None, [FrameFault::None; 2]); 500];
    assert_eq!(run(&link, &faults), (FIRST..FIRST + 500).collect::<Vec<_>>());
}

#[test]
fn each_fault_costs_its_own_frame_and_no_other() {
    let clean = (EventFault::None, [FrameFault::None; 2]);
    for (fault, lost) in [
        ((EventFault::Lost, [FrameFault::None; 2]), 1),
        ((EventFault::Duplicated, [FrameFault::None; 2]), 0),
        ((EventFault::Delayed(150), [FrameFault::None; 2]), 0),
        ((EventFault::None, [FrameFault::Lost, FrameFault::None]), 1),
        ((EventFault::None, [FrameFault::None, FrameFault::Duplicated]), 0),
        ((EventFault::None, [FrameFault::Delayed(150), FrameFault::None]), 0),
        ((EventFault::None, [FrameFault::MisStamped(1), FrameFault::None]), 1),
        ((EventFault::None, [FrameFault::None, FrameFault::MisStamped(-1)]), 1),
        ((EventFault::None, [FrameFault::Garbled(0xffff_ffff), FrameFault::None]), 1),
        // The camera's count shifts for good; two more frames pass before that is believed.
        ((EventFault::None, [FrameFault::Missed, FrameFault::None]), 3),
    ] {
        let mut faults = vec![clean; 60];
        faults[30] = fault;
        let pairs = run(&paper_link(), &faults);
        assert_eq!(pairs.len(), 60 - lost, "{fault:?}: {pairs:?}");
    }
}

#[test]
fn two_frames_with_exchanged_times_are_both_rejected() {
    let mut faults = vec![(EventFault::None, [FrameFault::None; 2]); 60];
    faults[30].1[0] = FrameFault::MisStamped(1);
    faults[31].1[0] = FrameFault::MisStamped(-1);
    let pairs = run(&paper_link(), &faults);
    assert_eq!(pairs.len(), 58);
    assert!(!pairs.contains(&(FIRST + 30)) && !pairs.contains(&(FIRST + 31)));
}

#[test]
fn a_camera_clock_that_jumps_by_a_period_is_tied_again() {
    let mut faults = vec![(EventFault::None, [FrameFault::None; 2]); 120];
    for fault in &mut faults[40..] {
        fault.1[1] = FrameFault::MisStamped(1);
    }
    let pairs = run(&paper_link(), &faults);
    assert!(pairs.len() >= 100, "{pairs:?}");
}

#[test]
fn a_bus_that_all_share_makes_up_for_slow_transfers() {
    // Every frame takes four periods, more than the pairer waits for: only the bus's frame numbers say
    // which trigger it belongs to.
    let slow = FrameFault::Delayed(400);
    let faults = vec![(EventFault::None, [slow; 2]); 80];
    let shared = Link { sof: Sof::Shared, ..paper_link() };
    assert!(run(&shared, &faults).len() >= 70);
    // Nor does it matter that a busy host fetches one camera's pictures long after the other's.
    let faults = vec![(EventFault::None, [FrameFault::None, slow]); 80];
    assert!(run(&shared, &faults).len() >= 70);
    // Numbers of another bus are found out, and done without.
    let clean = vec![(EventFault::None, [FrameFault::None; 2]); 120];
    let wrong = Link { sof: Sof::Wrong, ..paper_link() };
    assert!(run(&wrong, &clean).len() >= 80);
}

#[test]
fn a_lost_first_frame_delays_the_lock_but_shifts_nothing() {
    let mut faults = vec![(EventFault::None, [FrameFault::None; 2]); 60];
    faults[0].1[0] = FrameFault::Missed;
    assert!(run(&paper_link(), &faults).len() >= 58);
}

#[test]
fn faults_that_hide_each_other_do_not_shift_labels() {
    use FrameFault::{Lost, MisStamped, Missed};
    for right in [
        // A wrong timestamp that makes up for an exposure missed before it.
        &[(12, Missed), (13, Lost), (16, MisStamped(-1))][..],
        &[(0, Missed), (1, MisStamped(1)), (2, MisStamped(1))],
        &[(0, MisStamped(1)), (1, MisStamped(1)), (2, MisStamped(1)), (3, Missed)],
        &[(22, Missed), (23, MisStamped(-1)), (25, MisStamped(-1)), (26, MisStamped(-1))],
    ] {
        let mut faults = vec![(EventFault::None, [FrameFault::None; 2]); 90];
        for &(at, fault) in right {
            faults[at].1[1] = fault;
        }
        assert!(run(&paper_link(), &faults).len() >= 75, "{right:?}");
    }
}

#[test]
fn a_repeated_image_is_a_duplicate() {
    let mut pairer: Pairer<()> = Pairer::new(PairerConfig::new(33_333, 0));
    let mut out = Vec::new();
    let stamp = |sequence| FrameStamp {
        side: Side::Left,
        sequence,
        timestamp_camera_ns: 33_333_000 * u64::from(sequence),
        arrival_host_ns: 33_333_000 * u64::from(sequence),
        fingerprint: Some(42),
        usb_sof: None,
    };
    pairer.push_frame(stamp(0), (), &mut out);
    pairer.push_frame(stamp(1), (), &mut out);
    assert!(matches!(out[..], [Outcome::Rejected { cause: Reject::Duplicate, .. }]), "{out:?}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..Default::default() })]

    #[test]
    fn no_wrong_pair_and_every_frame_accounted_for(
        faults in proptest::collection::vec(
            (event_fault(), [frame_fault(), frame_fault()]), 30..160),
        drift_ppm in [-100i64..100, -100i64..100],
        readout_us in 200u64..20_000,
        period_us in 5_000u64..40_000,
        sof in prop_oneof![Just(Sof::None), Just(Sof::Shared), Just(Sof::Wrong)],
    ) {
        let link = Link {
            period_ns: period_us * 1000,
            exposure_ns: period_us * 960,
            readout_ns: (readout_us * 1000).min(period_us * 700),
            drift_ppm,
            sof,
        };
        let total = faults.len() as u32;
        let mut faults = faults;
        faults.extend(vec![(EventFault::None, [FrameFault::None; 2]); 60]);
        let pairs = run(&link, &faults);
        // Undisturbed again, the stream recovers.
        let recovered = pairs.iter().filter(|&&sequence| sequence >= FIRST + total + 40).count();
        prop_assert!(recovered >= 18, "only {} of the last 20", recovered);
    }
}
