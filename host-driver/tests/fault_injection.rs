//! Every fault that a link, a camera or a device can have, each at least twenty times at random moments
//! of simulated time, seeded: after each, no pair is under a wrong label (checked by what the pictures
//! show), the stream goes on or ends with a typed error and can be started again in the same process,
//! and every frame is accounted for. Prints a table.
#![cfg(feature = "sim")]

mod faults;
mod live;

use faults::{Bench, Fault, SCENE, TIMES, accounted, faults};
use live::{Dice, Witness};
use stspp::sync::Side;
use stspp::{Error, PairStream, Sensor, StreamOptions};

/// Pairs that were looked at, and how many of them were under a wrong label.
struct Judge {
    witness: Witness,
    pairs: u64,
    wrong: u64,
}

impl Judge {
    fn look(&mut self, pair: &stspp::LabelledPair) {
        let slot = usize::from(pair.label.slot);
        let shown = [(Side::Left, &pair.left), (Side::Right, &pair.right)];
        let right = shown.iter().all(|(side, image)| self.witness.projector(*side, image) == slot);
        self.pairs += 1;
        self.wrong += u64::from(!right);
    }

    /// Takes `count` pairs; the error that ended the stream before that, if one did.
    fn take(&mut self, stream: &mut PairStream, count: u64) -> Option<Error> {
        for _ in 0..count {
            match stream.next()? {
                Ok(pair) => self.look(&pair),
                Err(error) => return Some(error),
            }
        }
        None
    }
}

/// Injects one fault twenty times; how often the stream went on, or ended rightly and came back.
fn run(fault: &Fault, judge: &mut Judge, seed: u64) -> (u64, u64) {
    let mut bench = Bench::new();
    let mut dice = Dice(seed);
    let (mut injected, mut survived) = (0, 0);
    let options = StreamOptions::default();
    let mut stream = bench.sensor.pairs(&options).unwrap();
    while injected < TIMES {
        let before = 4 + dice.roll(9);
        let early = judge.take(&mut stream, before);
        assert!(early.is_none(), "{}: {}", fault.name, early.unwrap());
        (fault.inject)(&bench, &mut dice);
        injected += 1;
        match fault.error {
            None => {
                let error = judge.take(&mut stream, 6 + dice.roll(6));
                assert!(error.is_none(), "{}: {}", fault.name, error.unwrap());
                survived += 1;
            }
            Some(is_right) => {
                let error = judge.take(&mut stream, 200);
                let error = error.unwrap_or_else(|| panic!("{}: nothing noticed", fault.name));
                assert!(is_right(&error), "{}: {error}", fault.name);
                let stats = stream.finish();
                assert!(accounted(&stats), "{}: {stats:?}", fault.name);
                (fault.mend)(&mut bench);
                stream = bench
                    .sensor
                    .pairs(&options)
                    .unwrap_or_else(|error| panic!("{}, started again: {error}", fault.name));
                let error = judge.take(&mut stream, 5);
                assert!(error.is_none(), "{}, resumed: {}", fault.name, error.unwrap());
                survived += 1;
            }
        }
    }
    let stats = stream.finish();
    assert!(accounted(&stats), "{}: {stats:?}", fault.name);
    (injected, survived)
}

#[test]
fn every_fault_is_survived_without_a_wrong_label() {
    let mut judge = Judge { witness: Witness::learn(SCENE), pairs: 0, wrong: 0 };
    println!("{:<26} {:>8} {:>8} {:>8} {:>6}", "fault", "injected", "survived", "pairs", "wrong");
    for (number, fault) in faults().iter().enumerate() {
        let (pairs, wrong) = (judge.pairs, judge.wrong);
        let (injected, survived) = run(fault, &mut judge, 1 + number as u64);
        let (pairs, wrong) = (judge.pairs - pairs, judge.wrong - wrong);
        println!("{:<26} {injected:>8} {survived:>8} {pairs:>8} {wrong:>6}", fault.name);
        assert_eq!((survived, wrong), (injected, 0), "{}", fault.name);
    }
}

/// Resident memory in MiB.
fn resident_mib() -> f64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages: f64 = statm.split_whitespace().nth(1).and_then(|n| n.parse().ok()).unwrap_or(0.0);
    pages * 4096.0 / f64::from(1 << 20)
}

#[test]
fn ten_simulated_minutes_lose_nothing_and_keep_memory_flat() {
    const PAIRS: u64 = 10 * 60 * 30;
    let mut sensor = Sensor::open(SCENE).unwrap();
    let mut stream = sensor.pairs(&StreamOptions::default()).unwrap();
    let mut next = None;
    let mut early_mib = 0.0;
    for k in 0..PAIRS {
        let label = stream.next().unwrap().unwrap().label;
        assert!(next.is_none_or(|next| next == label.sequence), "{label:?}");
        assert_eq!(label.slot, (label.sequence % 10) as u16);
        next = Some(label.sequence + 1);
        if k == PAIRS / 10 {
            early_mib = resident_mib();
        }
    }
    let grown_mib = resident_mib() - early_mib;
    let stats = stream.finish();
    println!(
        "{PAIRS} pairs, memory grew by {grown_mib:.1} MiB, {} rejected",
        stats.rejected.total()
    );
    assert!(accounted(&stats), "{stats:?}");
    assert_eq!(stats.events_lost + stats.missing_left + stats.missing_right, 0, "{stats:?}");
    assert!(stats.rejected.total() == stats.rejected.discarded, "{stats:?}");
    assert!(grown_mib < 16.0, "memory grew by {grown_mib:.1} MiB");
}
