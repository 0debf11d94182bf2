//! Streams whose slots are started by another machine: a square wave at trigger-in.
#![cfg(feature = "sim")]

use std::time::Duration;

use stspp::error::{Missing, Timeout};
use stspp::{Error, ExternalTrigger, Sensor, StreamOptions, TriggerEdge, TriggerSource};

const DELAY_US: u32 = 300;

fn external(edge: TriggerEdge) -> TriggerSource {
    TriggerSource::External(ExternalTrigger { edge, delay_us: DELAY_US })
}

/// Times between the triggers of a stream of pairs, microseconds.
fn intervals_us(sensor: &mut Sensor, pairs: usize) -> Vec<u64> {
    let stream = sensor.pairs(&StreamOptions::default()).unwrap();
    let times: Vec<u64> =
        stream.take(pairs).map(|pair| pair.unwrap().label.trigger_time_us).collect();
    times.windows(2).map(|pair| pair[1] - pair[0]).collect()
}

#[test]
fn slots_follow_the_edges_and_the_timer_again_afterwards() {
    // The default timing has a slot each 33 ms; the machine asks for one each 50 ms.
    let mut sensor = Sensor::open("sim:plane?scale=16&trigger_hz=20").unwrap();
    assert_eq!(sensor.trigger_input().unwrap().source, TriggerSource::FreeRunning);
    sensor.set_trigger_source(external(TriggerEdge::Rising)).unwrap();
    let by_edges = intervals_us(&mut sensor, 12);
    // The device's clock runs at its own rate, some tens of millionths off.
    assert!(by_edges.iter().all(|us| us.abs_diff(50_000) <= 5), "{by_edges:?}");
    let input = sensor.trigger_input().unwrap();
    assert!(input.edges_taken >= 12 && input.edges_ignored == 0, "{input:?}");

    sensor.set_trigger_source(TriggerSource::FreeRunning).unwrap();
    let period_us = u64::from(sensor.timing().unwrap().frame_period_us);
    assert_eq!(intervals_us(&mut sensor, 4), [period_us; 3]);
}

#[test]
fn both_edges_serve_and_depth_comes_of_them() {
    let mut sensor = Sensor::open("sim:plane?scale=8&trigger_hz=25").unwrap();
    sensor.set_trigger_source(external(TriggerEdge::Falling)).unwrap();
    let mut stream = sensor.stream().unwrap();
    let frame = stream.next().unwrap().unwrap();
    assert_eq!(frame.labels.len(), 10);
    let (first, last) = (frame.labels[0].trigger_time_us, frame.labels[9].trigger_time_us);
    assert!((last - first).abs_diff(9 * 40_000) <= 40, "{first} {last}");
    let points = frame.point_cloud();
    assert!(points.len() > 5_000, "{}", points.len());
}

#[test]
fn edges_that_come_too_soon_are_counted_and_start_nothing() {
    // 50 edges a second, and a slot may start each 33 ms: every second edge serves.
    let mut sensor = Sensor::open("sim:plane?scale=16&trigger_hz=50").unwrap();
    sensor.set_trigger_source(external(TriggerEdge::Rising)).unwrap();
    let intervals = intervals_us(&mut sensor, 10);
    assert!(intervals.iter().all(|us| us.abs_diff(40_000) <= 5), "{intervals:?}");
    let input = sensor.trigger_input().unwrap();
    assert!(input.edges_ignored >= 8, "{input:?}");
}

#[test]
fn without_edges_the_silent_part_is_named_and_the_light_stays_off() {
    let mut sensor = Sensor::open("sim:plane?scale=16").unwrap();
    sensor.set_trigger_source(external(TriggerEdge::Rising)).unwrap();
    let options = StreamOptions { timeout: Duration::from_millis(500), ..Default::default() };
    let mut stream = sensor.pairs(&options).unwrap();
    let error = stream.next().unwrap().unwrap_err();
    assert!(matches!(error, Error::Timeout(Timeout { missing: Missing::Trigger, .. })), "{error}");
    assert_eq!(stream.finish().triggers, 0);
}

#[test]
fn a_delay_that_no_device_keeps_is_refused() {
    let mut sensor = Sensor::open("sim:plane?scale=16").unwrap();
    let late = ExternalTrigger { delay_us: 5_000, ..Default::default() };
    let refused = sensor.set_trigger_source(TriggerSource::External(late)).unwrap_err();
    assert!(matches!(refused, Error::Refused { .. }), "{refused}");
    assert_eq!(sensor.trigger_input().unwrap().source, TriggerSource::FreeRunning);
}
