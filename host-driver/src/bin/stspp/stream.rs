//! `stspp stream` and `stspp play`: depth frames with live statistics.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use serde_json::json;
use stspp::error::{Missing, Timeout};
use stspp::pipeline::BudgetPolicy;
use stspp::report::Summary;
use stspp::{DepthStream, Error, Sensor, StreamStats, TriggerSource};

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;
use crate::reconstruct::Matching;
use crate::source::{Source, failure, stream_options};

/// Stream depth frames and show what happens.
///
/// With --json, one object a line for each frame, and one with the counters at the end.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    source: Source,
    /// Depth frames to stream [default: until Ctrl-C].
    #[arg(long, short = 'n', value_name = "N")]
    count: Option<u64>,
    /// Raw labelled pairs without matching: shows what cable, cameras and triggers do.
    #[arg(long)]
    pairs: bool,
    /// When the sensor is unplugged or restarts, wait so long for it and go on.
    #[arg(long, value_name = "SECONDS")]
    reconnect: Option<f64>,
    /// On a machine that makes fewer depth frames a second than this, quality is lowered (first-order
    /// subsets), and that is counted; 0 never lowers it.
    #[arg(long, value_name = "HZ", default_value_t = BudgetPolicy::default().rate_min_hz)]
    min_rate: f64,
    #[command(flatten)]
    matching: Matching,
}

/// Play a recording as a stream.
#[derive(clap::Args)]
pub struct PlayArgs {
    /// Recording folder.
    folder: PathBuf,
    /// Depth frames to play [default: to the recording's end].
    #[arg(long, short = 'n', value_name = "N")]
    count: Option<u64>,
    #[command(flatten)]
    matching: Matching,
}

/// Runs `stream`.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let mut sensor = args.source.open()?;
    let wait = match args.reconnect {
        Some(seconds) => Duration::try_from_secs_f64(seconds).ok(),
        None => Some(Duration::ZERO),
    };
    let Some(wait) = wait else {
        return Err(Failure::new(Kind::Usage, "--reconnect: expected a number of seconds"));
    };
    if !(args.min_rate >= 0.0 && args.min_rate.is_finite()) {
        return Err(Failure::new(Kind::Usage, "--min-rate: expected a number of frames a second"));
    }
    let mut options = stream_options(Some(&args.source), Some(&args.matching));
    options.budget.rate_min_hz = args.min_rate;
    let mut shown = 0;
    loop {
        let left = args.count.map(|count| count - shown);
        let outcome = if args.pairs {
            pairs(&mut sensor, &args.source, left, &mut shown, output)
        } else {
            show(&mut sensor, &options, left, &mut shown, output)
        };
        let Err(End::Lost(error)) = outcome else {
            outcome.map_err(End::into_failure)?;
            return edges(&sensor, &args.source, output);
        };
        if wait.is_zero() {
            return Err(failure(&error));
        }
        eprintln!("warning: {error}; waiting for the sensor");
        resume(&mut sensor, &args.source, wait)?;
    }
}

/// What came of the edges at trigger-in, where they started the slots.
fn edges(sensor: &Sensor, source: &Source, output: &Output) -> Result<(), Failure> {
    if !matches!(source.trigger, Some(TriggerSource::External(_))) {
        return Ok(());
    }
    let input = sensor.trigger_input().map_err(|e| failure(&e))?;
    if output.json {
        println!("{}", json!({ "trigger": input }));
    } else {
        print!("{}", crate::timing::describe_trigger(&input));
    }
    Ok(())
}

/// How a stream ended early.
enum End {
    /// It can be started again once the sensor is back.
    Lost(Error),
    Failed(Failure),
}

impl End {
    fn of(error: Error) -> Self {
        match error {
            Error::Transport(_) | Error::Camera(_) | Error::DeviceReset(_) => Self::Lost(error),
            Error::Timeout(Timeout { missing: Missing::Reply { .. }, .. }) => Self::Lost(error),
            other => Self::Failed(failure(&other)),
        }
    }

    fn into_failure(self) -> Failure {
        match self {
            Self::Lost(error) => failure(&error),
            Self::Failed(failure) => failure,
        }
    }
}

impl From<Failure> for End {
    fn from(failure: Failure) -> Self {
        Self::Failed(failure)
    }
}

/// Waits up to `wait` until the sensor and its cameras are there again.
fn resume(sensor: &mut Sensor, source: &Source, wait: Duration) -> Result<(), Failure> {
    let deadline = Instant::now() + wait;
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        // A camera that is still missing shows when the stream is started.
        let back = sensor
            .reconnect(left)
            .and_then(|()| source.set_again(sensor))
            .and_then(|()| sensor.try_start());
        interrupt::check()?;
        match back {
            Ok(()) => return Ok(()),
            Err(error) if left.is_zero() => return Err(failure(&error)),
            Err(_) => std::thread::sleep(Duration::from_millis(200)),
        }
    }
}

/// Shows raw pairs.
fn pairs(
    sensor: &mut Sensor,
    source: &Source,
    count: Option<u64>,
    shown: &mut u64,
    output: &Output,
) -> Result<(), End> {
    let mut stream = sensor.pairs(&stream_options(Some(source), None)).map_err(End::of)?;
    interrupt::stops(stream.stop_handle());
    let live = output.spinner();
    let begun = Instant::now();
    let mut result = Ok(());
    let mut here = 0;
    while count.is_none_or(|count| here < count) {
        let Some(pair) = stream.next() else { break };
        if interrupt::check().is_err() {
            break;
        }
        let pair = match pair {
            Ok(pair) => pair,
            Err(error @ Error::Timeout(Timeout { missing: Missing::Reply { .. }, .. })) => {
                result = Err(End::of(error));
                break;
            }
            Err(error @ Error::Timeout(_)) if count.is_none() => {
                live.println(format!("warning: {error}"));
                continue;
            }
            Err(error) => {
                result = Err(End::of(error));
                break;
            }
        };
        here += 1;
        *shown += 1;
        if output.json {
            let delay_ms = pair.arrival_delay.as_secs_f64() * 1e3;
            let line = json!({
                "label": pair.label,
                "arrival_delay_ms": delay_ms,
                "mean_grey": [pair.left.mean_grey(), pair.right.mean_grey()],
            });
            println!("{line}");
        } else {
            let stats = stream.stats();
            live.set_message(format!(
                "pair {}: slot {}, {:.1} pairs/s, {:.1} ms after its exposure, lost {}",
                pair.label.sequence,
                pair.label.slot,
                here as f64 / begun.elapsed().as_secs_f64(),
                pair.arrival_delay.as_secs_f64() * 1e3,
                lost(&stats),
            ));
        }
    }
    live.finish_and_clear();
    let stats = stream.finish();
    summary(&stats, begun.elapsed().as_secs_f64(), output);
    result?;
    interrupt::check().or_else(|e| if count.is_none() { Ok(()) } else { Err(e) })?;
    Ok(())
}

/// Runs `play`.
pub fn play(args: &PlayArgs, output: &Output) -> Result<(), Failure> {
    let source = stspp::SourceUri::Replay { folder: args.folder.clone(), options: Vec::new() };
    let mut sensor = Sensor::open_uri(&source).map_err(|e| failure(&e))?;
    show(&mut sensor, &stream_options(None, Some(&args.matching)), args.count, &mut 0, output)
        .map_err(End::into_failure)
}

fn show(
    sensor: &mut Sensor,
    options: &stspp::StreamOptions,
    count: Option<u64>,
    shown: &mut u64,
    output: &Output,
) -> Result<(), End> {
    let mut stream = sensor.stream_with(options).map_err(End::of)?;
    interrupt::stops(stream.stop_handle());
    let live = output.spinner();
    let begun = Instant::now();
    let mut frames = 0;
    let result = follow(&mut stream, count, &mut frames, output, &live);
    live.finish_and_clear();
    // The light is off before anything else is said, and frames that were on their way are counted.
    let stats = stream.finish();
    summary(&stats, begun.elapsed().as_secs_f64(), output);
    *shown += frames;
    result?;
    if frames == 0 {
        let what = format!(
            "no depth frame: {} pairs, {} gaps, {} mislabelled; a window needs consecutive slots",
            stats.pairs, stats.window_gaps, stats.pairs_mislabelled
        );
        return Err(Failure::new(Kind::Input, what).into());
    }
    Ok(())
}

fn follow(
    stream: &mut DepthStream,
    count: Option<u64>,
    frames: &mut u64,
    output: &Output,
    live: &indicatif::ProgressBar,
) -> Result<(), End> {
    while count.is_none_or(|count| *frames < count) {
        let Some(frame) = stream.next() else { break };
        // Ctrl-C is the way to end a stream without a count.
        if interrupt::check().is_err() {
            return if count.is_none() { Ok(()) } else { Ok(interrupt::check()?) };
        }
        let frame = match frame {
            Ok(frame) => frame,
            Err(error @ Error::Timeout(timeout))
                if count.is_none() && !matches!(timeout.missing, Missing::Reply { .. }) =>
            {
                live.println(format!("warning: {error}"));
                continue;
            }
            Err(error) => return Err(End::of(error)),
        };
        *frames += 1;
        let stats = stream.stats();
        let summary = Summary::of(&frame, stream.matching().seen_pixels);
        if output.json {
            let line = json!({
                "frame": frame.sequence,
                "labels": frame.labels,
                "time_device_s": frame.time_device_s,
                "result": summary,
                "fps": stats.fps,
                "latency_ms": stats.latency_ms,
            });
            println!("{line}");
        } else {
            live.set_message(live_line(&frame, &summary, &stats));
        }
    }
    interrupt::check().or_else(|e| if count.is_none() { Ok(()) } else { Err(e) })?;
    Ok(())
}

fn live_line(frame: &stspp::DepthFrame, summary: &Summary, stats: &StreamStats) -> String {
    format!(
        "frame {}: {} points ({:.1} %), depth {} m, {:.2} frames/s, latency {:.0} ms, lost {}",
        frame.sequence,
        summary.points,
        100.0 * summary.completeness,
        summary.depth_median_m.map_or("-".into(), |z| format!("{z:.4}")),
        stats.fps,
        stats.latency_ms,
        lost(stats),
    )
}

/// Frames that did not become depth, in one number.
fn lost(stats: &StreamStats) -> u64 {
    stats.rejected.total()
        + stats.dropped_capture
        + 2 * (stats.dropped_pairs + stats.pairs_mislabelled)
}

fn summary(stats: &StreamStats, wall_s: f64, output: &Output) {
    if output.json {
        println!("{}", json!({ "stats": stats, "wall_s": wall_s }));
        return;
    }
    let r = &stats.rejected;
    println!(
        "{} depth frames in {wall_s:.1} s ({:.2} frames/s), latency {:.0} ms from the last exposure's end\n\
         triggers  {}, events lost {}, ignored {}\n\
         frames    left {}, right {}, damaged {}; pairs {}, windows {}, gaps {}\n\
         rejected  {} duplicate, {} late, {} without trigger, {} mislabelled, {} without partner, \
         {} unsynchronised, {} on their way at the end\n\
         dropped   {} frames, {} pairs, {} windows skipped, {} depth frames not fetched\n\
         budget    {} matches took longer than the camera's period, {} were made at first order; one \
         window of {} is matched",
        stats.depth_frames - stats.dropped_depth,
        stats.fps,
        stats.latency_ms,
        stats.triggers,
        stats.events_lost,
        stats.events_ignored,
        stats.frames_left,
        stats.frames_right,
        stats.damaged_left + stats.damaged_right,
        stats.pairs,
        stats.windows,
        stats.window_gaps,
        r.duplicate,
        r.late,
        r.no_trigger,
        r.mislabelled + 2 * stats.pairs_mislabelled,
        r.partner_missing,
        r.unsynchronised,
        r.discarded,
        stats.dropped_capture,
        stats.dropped_pairs,
        stats.skipped_windows,
        stats.dropped_depth,
        stats.over_budget,
        stats.reduced_frames,
        stats.match_every,
    );
}
