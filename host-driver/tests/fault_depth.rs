//! Every fault again, as often and at other moments, while depth is streamed: each depth frame is held
//! against the truth. A frame whose pictures are not what their labels say would be off; that it would
//! is shown first, with pictures whose label is wrong on purpose. Prints a table.
#![cfg(feature = "sim")]

mod faults;
mod live;

use faults::{Bench, FrameFault, Watch, frame_fault, run_all};
use live::Dice;
use stspp::accuracy::CanvasTruth;
use stspp::accuracy::score::score;
use stspp::{DepthFrame, DepthStream, Error, Sensor, StreamOptions, StreamStats};
use stspp_matcher::{Method, ShapeFunction};

/// What an undisturbed stream's frames are like. The RMS of these small frames varies, by a quarter in one
/// of ten thousand; that of a frame with one foreign picture is more than twice as large.
struct Judge {
    truth: CanvasTruth,
    rms_mm: f64,
    points: usize,
}

/// A frame is wrong whose RMS is larger by this than that of undisturbed ones, or which lacks more
/// points than this part.
const LARGER: f64 = 1.6;
const LACKS: f64 = 0.05;

fn options() -> StreamOptions {
    let mut options = StreamOptions::default();
    // Planes are matched by the first order, and there are thousands of frames to match.
    options.matching.method = Method::Dense;
    options.matching.shape = ShapeFunction::First;
    options.matching.threads = Some(1);
    options
}

impl Judge {
    /// Learns from an undisturbed stream.
    fn new() -> Self {
        let mut bench = Bench::new();
        let mut stream = bench.sensor.stream_with(&options()).unwrap();
        let first = stream.next().unwrap().unwrap();
        let mask = &stream.matching().left_mask;
        let truth = CanvasTruth::trace(&bench.world, &first.geometry, mask, 0);
        let mut judge = Self { truth, rms_mm: 0.0, points: 0 };
        let scores: Vec<_> =
            stream.take(20).map(|frame| score(&frame.unwrap(), &judge.truth)).collect();
        judge.rms_mm = scores.iter().map(|s| s.surface_rms_mm).sum::<f64>() / 20.0;
        judge.points = scores.iter().map(|s| s.points).sum::<usize>() / 20;
        assert!(judge.points > 4_000 && judge.rms_mm < 0.3, "{} {}", judge.points, judge.rms_mm);
        judge
    }

    fn is_wrong(&self, frame: &DepthFrame) -> bool {
        let score = score(frame, &self.truth);
        let lacks = 1.0 - score.points as f64 / self.points as f64;
        score.surface_rms_mm > LARGER * self.rms_mm || lacks > LACKS || score.outliers > 0.005
    }
}

impl Watch for Judge {
    type Item = DepthFrame;
    type Stream = DepthStream;
    const RESUMED: u64 = 2;

    fn start(&self, sensor: &mut Sensor) -> Result<DepthStream, Error> {
        sensor.stream_with(&options())
    }

    fn stats(stream: &DepthStream) -> StreamStats {
        stream.stats()
    }

    fn finish(stream: DepthStream) -> StreamStats {
        stream.finish()
    }

    fn look(&mut self, frame: &DepthFrame) -> bool {
        let first = frame.labels[0];
        let consecutive = (0..).zip(&frame.labels).all(|(k, label)| {
            let slot = (first.slot + k) % 10;
            label.sequence == first.sequence + u32::from(k)
                && (label.slot, label.projector_mask) == (slot, 1 << slot)
        });
        consecutive && !self.is_wrong(frame)
    }

    fn before(dice: &mut Dice) -> u64 {
        1 + dice.roll(9)
    }

    /// The window fills anew.
    fn after(_dice: &mut Dice) -> u64 {
        8
    }
}

#[test]
fn no_fault_leads_to_a_wrong_depth_frame() {
    run_all(&mut Judge::new(), "frames", 100);
}

#[test]
fn pictures_under_a_wrong_label_would_be_noticed() {
    let judge = Judge::new();
    for seed in 0..20 {
        let mut bench = Bench::new();
        let mut dice = Dice(seed);
        let mut stream = bench.sensor.stream_with(&options()).unwrap();
        for _ in 0..1 + dice.roll(9) {
            assert!(!judge.is_wrong(&stream.next().unwrap().unwrap()));
        }
        // A single picture of one camera, anywhere in the window of ten.
        frame_fault(&bench, &mut dice, FrameFault::Foreign(1));
        let wrong = (0..24).filter(|_| judge.is_wrong(&stream.next().unwrap().unwrap())).count();
        // It stays in the window for ten frames.
        assert_eq!(wrong, 10, "seed {seed}");
    }
}
