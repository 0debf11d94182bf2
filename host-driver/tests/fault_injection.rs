//! Every fault that a link, a camera or a device can have, each at least twenty times at random moments
//! of simulated time, seeded: after each, no pair is under a wrong label (checked by what the pictures
//! show), the stream goes on or ends with a typed error and can be started again in the same process,
//! and every frame is accounted for. Prints a table.
#![cfg(feature = "sim")]

mod faults;
mod live;

use faults::{SCENE, Watch, accounted, run_all};
use live::{Dice, Witness};
use stspp::sync::Side;
use stspp::{Error, LabelledPair, PairStream, Sensor, StreamOptions, StreamStats};

/// Knows by what a picture shows which projector lit it.
struct Labels(Witness);

impl Watch for Labels {
    type Item = LabelledPair;
    type Stream = PairStream;
    const RESUMED: u64 = 5;

    fn start(&self, sensor: &mut Sensor) -> Result<PairStream, Error> {
        sensor.pairs(&StreamOptions::default())
    }

    fn stats(stream: &PairStream) -> StreamStats {
        stream.stats()
    }

    fn finish(stream: PairStream) -> StreamStats {
        stream.finish()
    }

    fn look(&mut self, pair: &LabelledPair) -> bool {
        let slot = usize::from(pair.label.slot);
        let shown = [(Side::Left, &pair.left), (Side::Right, &pair.right)];
        shown.iter().all(|(side, image)| self.0.projector(*side, image) == slot)
    }

    fn before(dice: &mut Dice) -> u64 {
        4 + dice.roll(9)
    }

    fn after(dice: &mut Dice) -> u64 {
        6 + dice.roll(6)
    }
}

#[test]
fn every_fault_is_survived_without_a_wrong_label() {
    run_all(&mut Labels(Witness::learn(SCENE)), "pairs", 1);
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
