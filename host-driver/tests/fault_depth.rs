//! Every fault again, as often and at other moments, while depth is streamed: each depth frame is held
//! against the truth. A frame whose pictures are not what their labels say would be off; that it would
//! is shown first, with pictures whose label is wrong on purpose. Prints a table.
#![cfg(feature = "sim")]

mod faults;
mod live;

use faults::{Bench, Fault, FrameFault, TIMES, accounted, faults, frame_fault};
use live::Dice;
use stspp::accuracy::CanvasTruth;
use stspp::accuracy::score::score;
use stspp::{DepthFrame, DepthStream, Error, StreamOptions};
use stspp_matcher::{Method, ShapeFunction};

/// What an undisturbed stream's frames are like. The RMS of these small frames varies, by a quarter in one
/// of ten thousand; that of a frame with one foreign picture is more than twice as large.
struct Judge {
    truth: CanvasTruth,
    rms_mm: f64,
    points: usize,
    frames: u64,
    wrong: u64,
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
        let mut judge = Self { truth, rms_mm: 0.0, points: 0, frames: 0, wrong: 0 };
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

    fn look(&mut self, frame: &DepthFrame) {
        let first = frame.labels[0];
        let consecutive = (0..).zip(&frame.labels).all(|(k, label)| {
            let slot = (first.slot + k) % 10;
            label.sequence == first.sequence + u32::from(k)
                && (label.slot, label.projector_mask) == (slot, 1 << slot)
        });
        self.frames += 1;
        self.wrong += u64::from(self.is_wrong(frame) || !consecutive);
    }

    /// Takes `count` depth frames; the error that ended the stream before that, if one did.
    fn take(&mut self, stream: &mut DepthStream, count: u64) -> Option<Error> {
        for _ in 0..count {
            match stream.next()? {
                Ok(frame) => self.look(&frame),
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
    let mut stream = bench.sensor.stream_with(&options()).unwrap();
    while injected < TIMES {
        let early = judge.take(&mut stream, 1 + dice.roll(9));
        assert!(early.is_none(), "{}: {}", fault.name, early.unwrap());
        (fault.inject)(&bench, &mut dice);
        injected += 1;
        // What is on its way still comes; then the window fills anew.
        let error = judge.take(&mut stream, if fault.error.is_some() { 200 } else { 8 });
        match fault.error {
            None => {
                let stats = stream.stats();
                assert!(error.is_none(), "{}: {}, {stats:?}", fault.name, error.unwrap());
            }
            Some(is_right) => {
                let error = error.unwrap_or_else(|| panic!("{}: nothing noticed", fault.name));
                assert!(is_right(&error), "{}: {error}", fault.name);
                let stats = stream.finish();
                assert!(accounted(&stats), "{}: {stats:?}", fault.name);
                (fault.mend)(&mut bench);
                stream = bench
                    .sensor
                    .stream_with(&options())
                    .unwrap_or_else(|error| panic!("{}, started again: {error}", fault.name));
                let error = judge.take(&mut stream, 2);
                assert!(error.is_none(), "{}, resumed: {}", fault.name, error.unwrap());
            }
        }
        survived += 1;
    }
    let stats = stream.finish();
    assert!(accounted(&stats), "{}: {stats:?}", fault.name);
    (injected, survived)
}

#[test]
fn no_fault_leads_to_a_wrong_depth_frame() {
    let mut judge = Judge::new();
    println!("{:<26} {:>8} {:>8} {:>8} {:>6}", "fault", "injected", "survived", "frames", "wrong");
    for (number, fault) in faults().iter().enumerate() {
        let (frames, wrong) = (judge.frames, judge.wrong);
        let (injected, survived) = run(fault, &mut judge, 100 + number as u64);
        let (frames, wrong) = (judge.frames - frames, judge.wrong - wrong);
        println!("{:<26} {injected:>8} {survived:>8} {frames:>8} {wrong:>6}", fault.name);
        assert_eq!((survived, wrong), (injected, 0), "{}", fault.name);
        assert!(frames >= TIMES, "{}: {frames} depth frames", fault.name);
    }
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
