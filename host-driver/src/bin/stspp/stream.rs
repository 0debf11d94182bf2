//! `stspp stream` and `stspp play`: depth frames with live statistics.

use std::path::PathBuf;
use std::time::Instant;

use serde_json::json;
use stspp::report::Summary;
use stspp::{DepthStream, Error, Sensor, StreamStats};

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
    let sensor = args.source.open()?;
    show(sensor, &args.matching, args.count, output)
}

/// Runs `play`.
pub fn play(args: &PlayArgs, output: &Output) -> Result<(), Failure> {
    let source = stspp::SourceUri::Replay { folder: args.folder.clone(), options: Vec::new() };
    let sensor = Sensor::open_uri(&source).map_err(|e| failure(&e))?;
    show(sensor, &args.matching, args.count, output)
}

fn show(
    mut sensor: Sensor,
    matching: &Matching,
    count: Option<u64>,
    output: &Output,
) -> Result<(), Failure> {
    let options = stream_options(matching);
    let mut stream = sensor.stream_with(&options).map_err(|e| failure(&e))?;
    interrupt::stops(stream.stop_handle());
    let live = output.spinner();
    let begun = Instant::now();
    let mut frames = 0;
    let result = follow(&mut stream, count, &mut frames, output, &live);
    live.finish_and_clear();
    let stats = stream.stats();
    // The light is off before anything else is said.
    drop(stream);
    summary(&stats, begun.elapsed().as_secs_f64(), output);
    result?;
    if frames == 0 {
        let what = format!(
            "no depth frame: {} pairs, {} gaps, {} mislabelled; a window needs consecutive slots",
            stats.pairs, stats.window_gaps, stats.pairs_mislabelled
        );
        return Err(Failure::new(Kind::Input, what));
    }
    Ok(())
}

fn follow(
    stream: &mut DepthStream,
    count: Option<u64>,
    frames: &mut u64,
    output: &Output,
    live: &indicatif::ProgressBar,
) -> Result<(), Failure> {
    while count.is_none_or(|count| *frames < count) {
        let Some(frame) = stream.next() else { break };
        // Ctrl-C is the way to end a stream without a count.
        if interrupt::check().is_err() {
            return if count.is_none() { Ok(()) } else { interrupt::check() };
        }
        let frame = match frame {
            Ok(frame) => frame,
            Err(error @ Error::Timeout(_)) if count.is_none() => {
                live.println(format!("warning: {error}"));
                continue;
            }
            Err(error) => return Err(failure(&error)),
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
    interrupt::check().or_else(|failure| if count.is_none() { Ok(()) } else { Err(failure) })
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
         frames    left {}, right {}; pairs {}, windows {}, gaps {}\n\
         rejected  {} duplicate, {} late, {} without trigger, {} mislabelled, {} without partner, \
         {} unsynchronised, {} on their way at the end\n\
         dropped   {} frames, {} pairs, {} windows skipped, {} depth frames not fetched",
        stats.depth_frames,
        stats.fps,
        stats.latency_ms,
        stats.triggers,
        stats.events_lost,
        stats.events_ignored,
        stats.frames_left,
        stats.frames_right,
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
    );
}
