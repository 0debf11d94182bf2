//! The whole way from light to depth on a small simulated sensor.
#![cfg(feature = "sim")]

use std::time::Duration;

use stspp::{DepthFrame, Error, ProjectionTiming, Sensor, Slot, StreamOptions};
use stspp::{ExternalTrigger, TriggerInput, TriggerSource};

fn median_depth_m(frame: &DepthFrame) -> f32 {
    let mut depths: Vec<f32> =
        frame.depth_m.as_slice().iter().copied().filter(|z| z.is_finite()).collect();
    depths.sort_by(f32::total_cmp);
    depths[depths.len() / 2]
}

#[test]
fn depth_frames_of_a_plane_come_with_their_labels() {
    let mut sensor = Sensor::open("sim:plane?distance_m=1.2&scale=4").unwrap();
    let mut stream = sensor.stream().unwrap();
    for k in 0..3u32 {
        let frame = stream.next().unwrap().unwrap();
        assert_eq!(frame.sequence, u64::from(k));
        let labels: Vec<_> = frame.labels.iter().map(|l| (l.sequence, l.slot)).collect();
        let expected: Vec<_> = (k..k + 10).map(|s| (s, (s % 10) as u16)).collect();
        assert_eq!(labels, expected);
        assert!(frame.labels.iter().all(|l| l.projector_mask == 1 << l.slot));
        let depth_m = median_depth_m(&frame);
        assert!((depth_m - 1.2).abs() < 0.08, "median {depth_m} m");
    }
    let stats = stream.stats();
    assert_eq!(stats.rejected.total(), 0, "{stats:?}");
    assert_eq!(stats.events_lost + stats.window_gaps + stats.dropped_pairs, 0);
}

#[test]
fn a_stream_stops_and_starts_again() {
    let mut sensor = Sensor::open("sim:plane?scale=8").unwrap();
    for _ in 0..3 {
        let mut stream = sensor.stream().unwrap();
        assert!(matches!(sensor.stream(), Err(Error::Streaming)));
        stream.next().unwrap().unwrap();
        drop(stream);
        let status = sensor.status().unwrap();
        assert_eq!(status.state.to_string(), "idle");
    }
}

#[test]
fn the_api_types_can_be_sent_to_threads() {
    fn is_send<T: Send>() {}
    is_send::<Sensor>();
    is_send::<stspp::DepthStream>();
    is_send::<stspp::PairStream>();
    is_send::<DepthFrame>();
    is_send::<Error>();
}

#[test]
fn an_impossible_timing_names_every_rule() {
    let mut sensor = Sensor::open("sim:plane?scale=8").unwrap();
    let mut timing = ProjectionTiming { exposure_us: 60_000, ..Default::default() };
    timing.slots[2] = Slot { projector_mask: 1 << 12, floodlight: false };
    let Err(Error::Timing(violations)) = sensor.set_timing(timing) else { panic!() };
    assert!(violations.len() >= 2, "{violations:?}");
    assert_eq!(sensor.timing().unwrap(), ProjectionTiming::default());
}

#[test]
fn next_timeout_runs_on_simulated_time() {
    let mut sensor = Sensor::open("sim:plane?scale=8").unwrap();
    let mut stream = sensor.stream().unwrap();
    // Ten frames of 33 ms are needed.
    let error = stream.next_timeout(Duration::from_millis(50)).unwrap_err();
    assert!(matches!(error, Error::Timeout(_)), "{error}");
    assert!(stream.next_timeout(Duration::from_secs(2)).is_ok());
}

#[test]
fn a_replay_equals_the_reconstruction_of_the_same_folder() {
    let folder = std::env::temp_dir().join(format!("stspp-replay-{}", std::process::id()));
    let mut sensor = Sensor::open("sim:sphere?scale=8").unwrap();
    let pairs: Vec<_> = sensor
        .pairs(&stspp::StreamOptions::default())
        .unwrap()
        .take(12)
        .map(Result::unwrap)
        .collect();
    let labels: Vec<_> = pairs.iter().map(|pair| pair.label).collect();
    let images: Vec<_> = pairs
        .into_iter()
        .map(|pair| stspp::recording::StereoPair { left: pair.left, right: pair.right })
        .collect();
    stspp::recording::write(&folder, sensor.calibration().unwrap(), &images, &labels, true)
        .unwrap();

    let recording = stspp::Recording::open(&folder).unwrap();
    let mut silent = |_: &'static str| {};
    let reconstructed =
        stspp::reconstruct::reconstruct(&recording, &Default::default(), &mut silent).unwrap();
    let mut replayed = Sensor::open(&format!("replay:{}", folder.display())).unwrap();
    assert!(matches!(replayed.timing(), Err(Error::Unsupported { .. })));
    let frames: Vec<_> = replayed.stream().unwrap().map(Result::unwrap).collect();
    std::fs::remove_dir_all(&folder).unwrap();

    assert_eq!(frames.len(), 3, "12 pairs hold 3 windows of 10");
    let bits = |frame: &DepthFrame| -> Vec<u32> {
        frame.disparity_px.as_slice().iter().map(|d| d.to_bits()).collect()
    };
    assert_eq!(bits(&frames[0]), bits(&reconstructed.frame));
    assert_eq!(frames[0].labels, reconstructed.frame.labels);
    assert_ne!(bits(&frames[1]), bits(&frames[0]));
}

fn mean_intensity(frame: &DepthFrame) -> f64 {
    let sum: u64 = frame.intensity.as_slice().iter().map(|&v| u64::from(v)).sum();
    sum as f64 / frame.intensity.as_slice().len() as f64
}

#[test]
fn a_floodlight_slot_gives_the_brightness_and_is_not_matched() {
    let mut sensor = Sensor::open("sim:plane?scale=8").unwrap();
    let without = sensor.stream().unwrap().next().unwrap().unwrap();
    let slots = (0..10).map(Slot::projector).chain([Slot::floodlight()]).collect();
    sensor.set_timing(ProjectionTiming { slots, ..Default::default() }).unwrap();
    let mut stream = sensor.stream().unwrap();
    let frames: Vec<DepthFrame> = stream.by_ref().take(3).map(Result::unwrap).collect();
    for frame in &frames {
        assert_eq!(frame.labels.len(), 10);
        assert!(frame.labels.iter().all(|l| !l.floodlight && l.projector_mask != 0));
    }
    // The second window ends after the first floodlight frame, which lights the plane evenly.
    let spread = |frame: &DepthFrame| {
        let mean = mean_intensity(frame);
        let values = frame.intensity.as_slice().iter().filter(|v| **v > 0);
        let (sum, n) =
            values.fold((0.0, 0), |(sum, n), &v| (sum + (f64::from(v) - mean).abs(), n + 1));
        sum / f64::from(n) / mean
    };
    assert!(spread(&frames[1]) < spread(&without), "{} {}", spread(&frames[1]), spread(&without));
    assert_ne!(mean_intensity(&frames[0]).round(), mean_intensity(&frames[1]).round());
    assert_eq!(stream.stats().window_gaps, 0);
}

#[test]
fn a_window_may_be_shorter_than_the_cycle() {
    let mut sensor = Sensor::open("sim:plane?scale=8").unwrap();
    let mut options = stspp::StreamOptions::default();
    options.matching.frames = Some(3);
    let frames: Vec<DepthFrame> =
        sensor.stream_with(&options).unwrap().take(9).map(Result::unwrap).collect();
    for (k, frame) in (0u32..).zip(&frames) {
        let sequences: Vec<u32> = frame.labels.iter().map(|l| l.sequence).collect();
        assert_eq!(sequences, [k, k + 1, k + 2]);
    }
    options.matching.frames = Some(17);
    assert!(matches!(sensor.stream_with(&options), Err(Error::Match(_))));
}

#[test]
fn at_wall_pace_a_slow_machine_skips_windows_and_says_so() {
    let mut sensor = Sensor::open("sim:plane?scale=8&pace=real").unwrap();
    let mut stream = sensor.stream().unwrap();
    for result in stream.by_ref().take(4) {
        let frame = match result {
            Ok(frame) => frame,
            // On a very slow machine too many images are lost; that is said, and nothing is made up.
            Err(Error::Timeout(_)) => continue,
            Err(error) => panic!("{error}"),
        };
        let sequences: Vec<u32> = frame.labels.iter().map(|l| l.sequence).collect();
        assert_eq!(sequences.len(), 10);
        assert!(sequences.windows(2).all(|s| s[1] == s[0] + 1), "{sequences:?}");
        let depth_m = median_depth_m(&frame);
        assert!((depth_m - 1.0).abs() < 0.08, "median {depth_m} m");
        assert!(frame.arrived.is_some());
    }
    let stats = stream.finish();
    assert!(stats.windows >= stats.depth_frames + stats.skipped_windows, "{stats:?}");
    assert_eq!(
        stats.frames_left + stats.frames_right,
        2 * stats.pairs + stats.rejected.total() + stats.dropped_capture,
        "{stats:?}"
    );
}

#[test]
fn an_external_trigger_is_waited_for() {
    let mut sensor = Sensor::open("sim:plane?scale=16").unwrap();
    assert_eq!(sensor.trigger_input().unwrap(), TriggerInput::default());
    let late = ExternalTrigger { delay_us: 5_000, ..ExternalTrigger::default() };
    let refused = sensor.set_trigger_source(TriggerSource::External(late)).unwrap_err();
    assert!(refused.to_string().contains("delay_us is 5000; allowed is 60..=900"), "{refused}");
    let source = TriggerSource::External(ExternalTrigger::default());
    sensor.set_trigger_source(source).unwrap();
    assert_eq!(sensor.trigger_input().unwrap().source, source);
    // Nothing is wired to the simulated input: no trigger, no frame.
    let mut stream = sensor.pairs(&StreamOptions::default()).unwrap();
    let error = stream.next_timeout(Duration::from_millis(300)).unwrap_err();
    assert!(matches!(error, Error::Timeout { .. }), "{error:?}");
    drop(stream);
    sensor.set_trigger_source(TriggerSource::FreeRunning).unwrap();
    let mut stream = sensor.pairs(&StreamOptions::default()).unwrap();
    stream.next_timeout(Duration::from_secs(5)).unwrap();
}
