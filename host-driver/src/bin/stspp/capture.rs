//! `stspp capture`: depth frames into files.

use std::path::PathBuf;

use serde_json::json;
use stspp::export::{folder::OutputFolder, outputs};
use stspp::report::Summary;

use crate::exit::{Failure, Kind};
use crate::output::Output;
use crate::reconstruct::Matching;
use crate::source::{Source, failure, output_failure, stream_options};
use crate::{frame_report, interrupt};

/// Capture depth frames: point cloud, disparity, depth image and report of each.
///
/// One frame is written into the output folder itself, several into 0000, 0001, ... in it. A frame is
/// there with all its files or not at all.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    source: Source,
    /// Folder to write to; made if missing.
    #[arg(long, short)]
    out: PathBuf,
    /// Replace outputs that are there.
    #[arg(long)]
    force: bool,
    /// Depth frames to capture.
    #[arg(long, short = 'n', default_value_t = 1, value_name = "N")]
    count: u64,
    #[command(flatten)]
    matching: Matching,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    if args.count == 0 {
        return Err(Failure::new(Kind::Usage, "--count is 0: expected at least 1"));
    }
    let mut sensor = args.source.open()?;
    let folder = |k: u64| match args.count {
        1 => args.out.clone(),
        _ => args.out.join(format!("{k:04}")),
    };
    // Found out before there is light: whether the output can be written at all.
    let new_folder =
        |k| OutputFolder::create(&folder(k), args.force).map_err(|e| output_failure(&e));
    let mut next = Some(new_folder(0)?);
    let mut options = stream_options(Some(&args.source), Some(&args.matching));
    // Files are worth waiting for: a slow machine makes fewer of them a second, not poorer ones.
    options.budget.rate_min_hz = 0.0;
    let mut stream = sensor.stream_with(&options).map_err(|e| failure(&e))?;
    interrupt::stops(stream.stop_handle());
    let progress = output.progress(args.count, "capturing");
    let mut frames = Vec::new();
    let mut last = None;
    for k in 0..args.count {
        let mut out = match next.take() {
            Some(out) => out,
            None => new_folder(k)?,
        };
        let Some(frame) = stream.next() else {
            interrupt::check()?;
            let what = format!("the source ended after {k} of {} depth frames", args.count);
            return Err(Failure::new(Kind::Input, what));
        };
        let frame = frame.map_err(|e| failure(&e))?;
        interrupt::check()?;
        if k + 1 == args.count {
            // The light goes off before the files are written.
            stream.stop_handle().stop();
        }
        let stats = stream.stats();
        let report = frame_report::of(&args.source.uri, &frame, stream.matching(), &stats);
        outputs::write(&mut out, &frame, &report, outputs::Extras::default(), &mut |_| {})
            .and_then(|()| interrupt::check().map_or(Ok(()), |()| out.commit()))
            .map_err(|e| output_failure(&e))?;
        interrupt::check()?;
        let summary = Summary::of(&frame, stream.matching().seen_pixels);
        frames.push(json!({ "folder": folder(k), "frame": frame.sequence, "result": summary }));
        last = Some(summary);
        progress.inc(1);
    }
    progress.finish_and_clear();
    let text = format!(
        "{} depth frames, {} points in the last\nlook at {}",
        frames.len(),
        last.map_or(0, |summary| summary.points),
        folder(args.count - 1).join("depth_color.png").display()
    );
    output.result(&text, &json!({ "frames": frames, "stream": stream.stats() }));
    Ok(())
}
