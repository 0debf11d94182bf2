//! What goes wrong between light and host is counted, named and never matched.
#![cfg(feature = "sim")]

mod live;

use std::sync::atomic::Ordering;
use std::time::Duration;

use live::{Bench, Dice, Witness};
use stspp::camera::CameraFrame;
use stspp::error::{Missing, Timeout};
use stspp::sync::Side;
use stspp::{Error, StreamOptions};
use stspp_protocol::fault::FaultReason;
use stspp_protocol::reply::DeviceState;

const SCENE: &str = "sim:plane?scale=16";
const PERIOD_NS: u64 = 33_333_000;

#[test]
fn disturbed_streams_deliver_no_wrong_pair_and_account_for_every_frame() {
    let witness = Witness::learn(SCENE);
    for seed in 0..3 {
        let mut dice = Dice(seed);
        let mut held: Option<CameraFrame> = None;
        let tamper = move |mut frame: CameraFrame| {
            let mut out: Vec<CameraFrame> = held.take().into_iter().collect();
            match dice.roll(40) {
                0 => return out,
                1 => out.push(frame.clone()),
                2 => frame.stamp.timestamp_camera_ns += PERIOD_NS,
                3 => frame.stamp.timestamp_camera_ns -= PERIOD_NS,
                4 => {
                    held = Some(frame);
                    return out;
                }
                5 => frame.stamp.timestamp_camera_ns ^= dice.roll(1 << 30),
                _ => {}
            }
            out.insert(0, frame);
            out
        };
        // Now and then a bit of what the device says is flipped: events and replies are lost.
        let mut noise = Dice(seed + 100);
        let garble = move |bytes: &mut Vec<u8>| {
            if !bytes.is_empty() && noise.roll(25) == 0 {
                let at = noise.roll(bytes.len() as u64) as usize;
                bytes[at] ^= 1 << noise.roll(8);
            }
        };
        let mut bench = Bench::new(SCENE, Box::new(tamper), Box::new(garble));
        let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
        let mut last = None;
        for _ in 0..120 {
            let pair = stream.next().unwrap().unwrap();
            let slot = usize::from(pair.label.slot);
            assert_eq!(witness.projector(Side::Left, &pair.left), slot, "{:?}", pair.label);
            assert_eq!(witness.projector(Side::Right, &pair.right), slot, "{:?}", pair.label);
            assert!(last.is_none_or(|last| last < pair.label.sequence));
            last = Some(pair.label.sequence);
        }
        let stats = stream.finish();
        assert_eq!(
            stats.frames_left + stats.frames_right,
            2 * stats.pairs + stats.rejected.total() + stats.dropped_capture,
            "{stats:?}"
        );
        assert!(stats.rejected.duplicate > 0 && stats.rejected.partner_missing > 0, "{stats:?}");
        assert!(stats.rejected.mislabelled + stats.rejected.no_trigger > 0, "{stats:?}");
        assert!(stats.link.frames_rejected > 0 && stats.events_lost > 0, "{stats:?}");
    }
}

#[test]
fn a_lost_frame_breaks_its_windows_and_no_others() {
    let drop_one = |frame: CameraFrame| {
        let lost = frame.stamp.side == Side::Right && frame.stamp.sequence == 14;
        if lost { Vec::new() } else { vec![frame] }
    };
    let uri = "sim:plane?scale=8";
    let mut bench = Bench::new(uri, Box::new(drop_one), Box::new(|_| {}));
    let mut stream = bench.sensor.stream().unwrap();
    let mut newest = Vec::new();
    for _ in 0..8 {
        let frame = stream.next().unwrap().unwrap();
        let sequences: Vec<u32> = frame.labels.iter().map(|l| l.sequence).collect();
        assert!(sequences.windows(2).all(|s| s[1] == s[0] + 1), "{sequences:?}");
        assert!(!sequences.contains(&14));
        newest.push(sequences[9]);
    }
    assert_eq!(newest, [9, 10, 11, 12, 13, 24, 25, 26]);
    let stats = stream.finish();
    assert_eq!((stats.missing_right, stats.rejected.partner_missing), (1, 1));
    assert_eq!(stats.window_gaps, 1);
}

fn timeout_of(tamper: fn(&CameraFrame) -> bool) -> Missing {
    let keep = move |frame: CameraFrame| if tamper(&frame) { vec![frame] } else { Vec::new() };
    let mut bench = Bench::new(SCENE, Box::new(keep), Box::new(|_| {}));
    let mut stream = bench.sensor.stream().unwrap();
    match stream.next() {
        Some(Err(Error::Timeout(Timeout { missing, .. }))) => missing,
        other => panic!("{:?}", other.map(|r| r.map(|f| f.sequence))),
    }
}

#[test]
fn a_timeout_names_the_part_that_is_silent() {
    assert_eq!(timeout_of(|_| false), Missing::Exposure);
    assert_eq!(timeout_of(|f| f.stamp.side == Side::Left), Missing::Camera(Side::Right));
    assert_eq!(timeout_of(|f| f.stamp.side == Side::Right), Missing::Camera(Side::Left));
    // Every seventh frame lost: pairs, but never ten in a row.
    assert_eq!(timeout_of(|f| f.stamp.sequence % 7 != 0), Missing::Window);
}

#[test]
fn a_lost_heartbeat_latches_and_is_told() {
    let mut bench = Bench::honest(SCENE);
    let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    stream.next().unwrap().unwrap();
    bench.muted.store(true, Ordering::Release);
    let error = stream.find_map(Result::err).expect("the stream ends with an error");
    let Error::Faulted(fault) = &error else { panic!("{error}") };
    assert!(fault.latched.contains(FaultReason::HeartbeatLost));
    assert!(error.to_string().contains("heartbeat"), "{error}");
    assert!(bench.rig().lit().is_empty(), "light is off");
    assert!(stream.next().is_none(), "the stream has ended");
    drop(stream);

    // It stays latched, and says so, until it is cleared.
    bench.muted.store(false, Ordering::Release);
    let Err(Error::Faulted(_)) = bench.sensor.stream() else { panic!("light despite a fault") };
    assert!(bench.sensor.clear_faults().unwrap().latched.is_empty());
    let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    stream.next().unwrap().unwrap();
}

#[test]
fn an_open_interlock_ends_the_stream() {
    let mut bench = Bench::honest(SCENE);
    let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    stream.next().unwrap().unwrap();
    bench.rig().controller().set_interlock_closed(false);
    let error = stream.find_map(Result::err).unwrap();
    let Error::Faulted(fault) = &error else { panic!("{error}") };
    assert!(fault.latched.contains(FaultReason::Interlock), "{error}");
    assert!(bench.rig().lit().is_empty());
}

#[test]
fn a_pulled_cable_is_named_and_the_light_goes_off() {
    let mut bench = Bench::honest(SCENE);
    let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    stream.next().unwrap().unwrap();
    bench.rig().controller().set_link_connected(false);
    let error = stream.find_map(Result::err).unwrap();
    let Error::Timeout(timeout) = &error else { panic!("{error}") };
    assert!(matches!(timeout.missing, Missing::Reply { .. }), "{error}");
    assert!(bench.rig().lit().is_empty());
}

#[test]
fn dropping_the_stream_leaves_nothing_lit() {
    let mut bench = Bench::honest(SCENE);
    let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    stream.next().unwrap().unwrap();
    drop(stream);
    assert!(bench.rig().lit().is_empty());
    assert_eq!(bench.sensor.status().unwrap().state, DeviceState::Idle);
    bench.sensor.floodlight_on(Duration::from_millis(100)).unwrap();
    bench.sensor.status().unwrap();
    assert_eq!(bench.rig().lit().len(), 1, "the floodlight");
    let rig = std::sync::Arc::clone(&bench.rig);
    drop(bench);
    let mut nothing = Vec::new();
    rig.lock().unwrap().read(&mut nothing, Duration::from_millis(5));
    assert!(rig.lock().unwrap().lit().is_empty());
}

#[test]
fn a_stop_handle_stops_from_another_thread() {
    let mut bench = Bench::honest(SCENE);
    let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    stream.next().unwrap().unwrap();
    let stop = stream.stop_handle();
    std::thread::spawn(move || stop.stop()).join().unwrap();
    assert!(stream.by_ref().take(50).filter(Result::is_err).count() == 0);
    assert!(stream.next().is_none());
    stream.finish();
    assert!(bench.rig().lit().is_empty());
}

#[test]
fn at_wall_pace_frames_come_as_fast_as_the_wall_clock_says() {
    let mut bench = Bench::honest("sim:plane?scale=16&pace=real");
    let begun = std::time::Instant::now();
    let mut stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    for _ in 0..6 {
        stream.next().unwrap().unwrap();
    }
    assert!(begun.elapsed() >= Duration::from_millis(5 * 33));
    let stats = stream.finish();
    assert_eq!(
        stats.frames_left + stats.frames_right,
        2 * stats.pairs + stats.rejected.total() + stats.dropped_capture,
        "{stats:?}"
    );
}
