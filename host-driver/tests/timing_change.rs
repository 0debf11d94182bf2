//! Another slot order, mask or period changes what the cameras see and how frames are labelled.
#![cfg(feature = "sim")]

mod live;

use live::{Bench, Witness, brightness};
use stspp::sync::Side;
use stspp::{LabelledPair, ProjectionTiming, Slot, StreamOptions};

const SCENE: &str = "sim:plane?scale=16";

fn record(timing: ProjectionTiming, count: usize) -> Vec<LabelledPair> {
    let mut bench = Bench::honest(SCENE);
    bench.sensor.set_timing(timing).unwrap();
    let stream = bench.sensor.pairs(&StreamOptions::default()).unwrap();
    stream.take(count).map(Result::unwrap).collect()
}

#[test]
fn another_slot_order_is_seen_and_labelled() {
    let witness = Witness::learn(SCENE);
    let order = [4u8, 9, 0, 7, 2];
    let slots = order.iter().map(|&p| Slot::projector(p)).collect();
    let pairs = record(ProjectionTiming { slots, ..Default::default() }, 10);
    for (k, pair) in pairs.iter().enumerate() {
        let projector = order[k % order.len()];
        assert_eq!(usize::from(pair.label.slot), k % order.len());
        assert_eq!(pair.label.projector_mask, 1 << projector);
        assert_eq!(witness.projector(Side::Left, &pair.left), usize::from(projector));
        assert_eq!(witness.projector(Side::Right, &pair.right), usize::from(projector));
    }
}

#[test]
fn masks_brighten_and_darken_the_images() {
    let slots =
        [Slot::dark(), Slot::projector(3), Slot { projector_mask: 0b11_0000, floodlight: false }];
    let pairs = record(
        ProjectionTiming {
            slots: slots.iter().copied().chain([Slot::floodlight()]).collect(),
            ..Default::default()
        },
        8,
    );
    let of = |slot: u16| {
        let images = pairs.iter().filter(|p| p.label.slot == slot).map(|p| brightness(&p.left));
        images.sum::<f64>() / pairs.iter().filter(|p| p.label.slot == slot).count() as f64
    };
    let [dark, one, two, flood] = [of(0), of(1), of(2), of(3)];
    assert!(
        one > 2.0 * dark && two > 1.5 * one && flood > 2.0 * dark,
        "{dark} {one} {two} {flood}"
    );
    let label = |k: usize| (pairs[k].label.projector_mask, pairs[k].label.floodlight);
    assert_eq!([label(0), label(1)], [(0, false), (8, false)]);
    assert_eq!([label(2), label(3)], [(0b11_0000, false), (0, true)]);
}

#[test]
fn another_period_and_exposure_are_labelled_and_seen() {
    let timing = |period_us, exposure_us| ProjectionTiming {
        frame_period_us: period_us,
        exposure_us,
        ..Default::default()
    };
    let slow = record(timing(40_000, 32_000), 4);
    let fast = record(timing(20_000, 8_000), 4);
    for (pairs, period_us) in [(&slow, 40_000), (&fast, 20_000)] {
        for two in pairs.windows(2) {
            let apart_us = two[1].label.trigger_time_us - two[0].label.trigger_time_us;
            assert_eq!(apart_us, period_us);
        }
    }
    assert_eq!([slow[0].label.exposure_us, fast[0].label.exposure_us], [32_000, 8_000]);
    let ratio = brightness(&slow[0].left) / brightness(&fast[0].left);
    assert!((2.5..5.0).contains(&ratio), "a quarter of the exposure: {ratio}");
}

#[test]
fn a_thousand_patterns_a_second_are_paired() {
    let timing = ProjectionTiming {
        frame_period_us: 1_000,
        exposure_us: 800,
        trigger_delay_us: 60,
        gate_lead_us: 20,
        gate_lag_us: 20,
        ..Default::default()
    };
    let pairs = record(timing, 60);
    for two in pairs.windows(2) {
        assert_eq!(two[1].label.sequence, two[0].label.sequence + 1);
    }
}

#[test]
fn a_timing_set_while_streaming_never_mixes_with_the_old_one() {
    let mut bench = Bench::honest(SCENE);
    let witness = Witness::learn(SCENE);
    let options = StreamOptions::default();
    let mut stream = bench.sensor.pairs(&options).unwrap();
    for _ in 0..7 {
        stream.next().unwrap().unwrap();
    }
    let slots = (0..10).rev().map(Slot::projector).collect();
    let reversed = ProjectionTiming { slots, frame_period_us: 35_000, ..Default::default() };
    bench.sensor.set_timing(reversed).unwrap();
    let mut generations = Vec::new();
    for _ in 0..35 {
        let pair = stream.next().unwrap().unwrap();
        let slot = usize::from(pair.label.slot);
        let projector = witness.projector(Side::Left, &pair.left);
        let (old, new) = (slot, 9 - slot);
        let is_new = !generations.is_empty() && pair.timing_generation != generations[0];
        assert_eq!(projector, if is_new { new } else { old });
        assert_eq!(pair.label.projector_mask, 1 << projector);
        generations.push(pair.timing_generation);
    }
    generations.dedup();
    assert_eq!(generations.len(), 2, "the old timing, then the new one: {generations:?}");

    // Depth comes of both, and of no window with frames of both.
    drop(stream);
    bench.sensor.set_timing(ProjectionTiming::default()).unwrap();
    let mut stream = bench.sensor.stream().unwrap();
    stream.next().unwrap().unwrap();
    let slots = (0..10).rev().map(Slot::projector).collect();
    bench.sensor.set_timing(ProjectionTiming { slots, ..Default::default() }).unwrap();
    let mut seen = [0; 2];
    while seen[1] < 2 {
        let frame = stream.next().unwrap().unwrap();
        let old = frame.labels.iter().filter(|l| l.projector_mask == 1 << l.slot).count();
        let new = frame.labels.iter().filter(|l| l.projector_mask == 1 << (9 - l.slot)).count();
        assert!([old, new].contains(&10) && old + new == 10, "{:?}", frame.labels);
        seen[usize::from(new == 10)] += 1;
    }
    assert!(seen[0] > 0);
}
