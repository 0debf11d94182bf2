//! The whole way from light to depth on a small simulated sensor.
#![cfg(feature = "sim")]

use std::time::Duration;

use stspp::{DepthFrame, Error, ProjectionTiming, Sensor, Slot};

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
    stspp::recording::write(&folder, sensor.calibration(), &images, &labels, true).unwrap();

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
