//! `stspp record`: raw stereo pairs into a recording folder.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::json;
use stspp::calibration::kalibr;
use stspp::export::folder::OutputFolder;
use stspp::recording::labels::{self, FramesInfo};
use stspp::{Sensor, SlotLabel, SourceUri, image_io};

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;
use crate::source::{Source, failure, output_failure, stream_options};

/// Record raw stereo pairs: camchain.yaml, left/, right/ and frames.json.
///
/// `stspp reconstruct` reads the folder, `stspp play` streams it.
#[derive(clap::Args)]
pub struct Args {
    /// Folder to write; made if missing.
    folder: PathBuf,
    #[command(flatten)]
    source: Source,
    /// Pairs to record [default: one slot cycle, begun anew where a pair is lost].
    #[arg(long, short = 'n', value_name = "N")]
    count: Option<usize>,
    /// Write the truth beside it (sim: only): truth/depth.tiff and truth/visible_to_both.png for the
    /// left raw image, truth/primitives.json.
    #[arg(long)]
    truth: bool,
    /// Replace a recording that is there.
    #[arg(long)]
    force: bool,
}

/// How often a slot cycle with a lost pair is begun anew before it is kept as it is.
const RESTARTS: u32 = 20;

/// Labels of the pairs that were recorded.
struct Taken {
    labels: Vec<SlotLabel>,
    /// Pairs lost in between.
    lost: u32,
    /// Times that a cycle was begun anew.
    restarts: u32,
    /// A cycle with a lost pair is begun anew.
    wants_whole_cycle: bool,
}

impl Taken {
    /// Takes the next pair; its place in the recording.
    fn place(&mut self, label: SlotLabel) -> usize {
        let next = self.labels.last().map_or(label.sequence, |last| last.sequence.wrapping_add(1));
        let lost = label.sequence.saturating_sub(next);
        if lost > 0 && self.wants_whole_cycle && self.restarts < RESTARTS {
            self.restarts += 1;
            self.labels.clear();
        } else {
            self.lost += lost;
        }
        self.labels.push(label);
        self.labels.len() - 1
    }
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let (mut sensor, world) = open(args)?;
    let cycle = match sensor.recording() {
        Some(recording) => recording.len(),
        None => sensor.timing().map_err(|e| failure(&e))?.slots.len(),
    };
    let count = args.count.unwrap_or(cycle);
    if count == 0 {
        return Err(Failure::new(Kind::Usage, "--count is 0: expected at least 1"));
    }
    let mut out = OutputFolder::create(&args.folder, args.force).map_err(|e| output_failure(&e))?;
    // Pairs for a first calibration are recorded without one.
    if let Ok(calibration) = sensor.calibration() {
        let text = kalibr::to_text(calibration);
        out.file("camchain.yaml", |w| w.write_all(text.as_bytes()))
            .map_err(|e| output_failure(&e))?;
    }
    let mut stream =
        sensor.pairs(&stream_options(Some(&args.source), None)).map_err(|e| failure(&e))?;
    interrupt::stops(stream.stop_handle());
    let digits = (count - 1).to_string().len().max(2);
    let progress = output.progress(count as u64, "recording");
    // What is asked for by number, or played from a recording, is taken as it comes.
    let wants_whole_cycle = args.count.is_none() && sensor.recording().is_none();
    let mut taken = Taken { labels: Vec::new(), lost: 0, restarts: 0, wants_whole_cycle };
    let mut bits = 8;
    while taken.labels.len() < count {
        let Some(pair) = stream.next() else {
            interrupt::check()?;
            let what = format!("the source ended after {} of {count} pairs", taken.labels.len());
            return Err(Failure::new(Kind::Input, what));
        };
        let pair = pair.map_err(|e| failure(&e))?;
        interrupt::check()?;
        let index = taken.place(pair.label);
        for (side, image) in [("left", &pair.left), ("right", &pair.right)] {
            let name = format!("{side}/{index:0digits$}.png");
            out.file(&name, |w| image_io::write_raw(w, image)).map_err(|e| output_failure(&e))?;
        }
        bits = pair.left.bits.max(8);
        progress.set_position(index as u64 + 1);
    }
    let stats = stream.finish();
    let Taken { labels: recorded, lost, restarts, .. } = taken;
    let text = labels::to_text(&FramesInfo { bits: Some(bits), labels: recorded.clone() });
    out.file("frames.json", |w| w.write_all(text.as_bytes())).map_err(|e| output_failure(&e))?;
    if args.truth {
        truth(&mut out, world.as_deref(), &recorded, &args.source.uri)?;
    }
    interrupt::check()?;
    out.commit().map_err(|e| output_failure(&e))?;
    progress.finish_and_clear();
    let folder: &Path = &args.folder;
    let text = format!(
        "{} pairs in {}{}\nnext: stspp reconstruct {} --out OUT",
        recorded.len(),
        folder.display(),
        if lost > 0 { format!("; {lost} were lost in between") } else { String::new() },
        folder.display()
    );
    output.result(&text, &json!({
        "folder": folder, "pairs": recorded.len(), "lost": lost, "restarts": restarts, "stream": stats,
    }));
    Ok(())
}

#[cfg(feature = "sim")]
type World = stspp_hil_sim::world::World;
#[cfg(not(feature = "sim"))]
enum World {}

/// The sensor and, when it is simulated, its world.
fn open(args: &Args) -> Result<(Sensor, Option<Arc<World>>), Failure> {
    let uri: SourceUri = args.source.uri.parse().map_err(|e| failure(&stspp::Error::Uri(e)))?;
    #[cfg(feature = "sim")]
    if let SourceUri::Sim { .. } = &uri {
        let (sensor, world) = args.source.open_sim()?;
        return Ok((sensor, Some(world)));
    }
    if args.truth {
        let what = format!("--truth: {uri} knows no truth; only sim: does");
        return Err(Failure::new(Kind::Usage, what));
    }
    Ok((args.source.open()?, None))
}

#[cfg(feature = "sim")]
fn truth(
    out: &mut OutputFolder,
    world: Option<&World>,
    recorded: &[SlotLabel],
    source: &str,
) -> Result<(), Failure> {
    use stspp_hil_sim::world::PrimitiveShape;
    use stspp_matcher::Image;

    let Some(world) = world else { return Ok(()) };
    let centres = recorded.iter().map(SlotLabel::exposure_centre_s);
    let time_s = centres.sum::<f64>() / recorded.len().max(1) as f64;
    // The device's clock starts with the scene's; crystals differ by millionths.
    let time_ns = (time_s * 1e9) as u64;
    let truth = world.truth();
    let (width, height) = (world.model().left.width, world.model().left.height);
    let depth_m = Image::from_vec(width, height, truth.depth_m(time_ns));
    let depth_m = depth_m.unwrap_or_else(|| Image::new(width, height, f32::NAN));
    let visible = truth.visible_to_both(time_ns).into_iter().map(|seen| u8::from(seen) * 255);
    let visible = Image::from_vec(width, height, visible.collect());
    let visible = stspp::RawImage::gray8(visible.unwrap_or_else(|| Image::new(width, height, 0)));
    let primitives: Vec<_> = truth
        .primitives(time_ns)
        .iter()
        .map(|primitive| {
            let object = world.object_name(primitive.object);
            let vector = |v: [f64; 3]| json!(v);
            match &primitive.shape {
                PrimitiveShape::Plane { point_left_m, normal_left } => json!({
                    "object": object, "shape": "plane",
                    "point_left_m": vector((*point_left_m).into()),
                    "normal_left": vector((*normal_left).into()),
                }),
                PrimitiveShape::Sphere { centre_left_m, radius_m } => json!({
                    "object": object, "shape": "sphere",
                    "centre_left_m": vector((*centre_left_m).into()), "radius_m": radius_m,
                }),
                PrimitiveShape::Circle { centre_left_m, normal_left, radius_m } => json!({
                    "object": object, "shape": "circle",
                    "centre_left_m": vector((*centre_left_m).into()),
                    "normal_left": vector((*normal_left).into()), "radius_m": radius_m,
                }),
                other => json!({ "object": object, "shape": format!("{other:?}") }),
            }
        })
        .collect();
    let text = json!({
        "source": source,
        "frame": "left camera (cam0), metres; truth images are for the raw left image",
        "time_device_s": time_s,
        "primitives": primitives,
    });
    out.file("truth/depth.tiff", |w| stspp::export::images::write_disparity_tiff(w, &depth_m))
        .and_then(|()| out.file("truth/visible_to_both.png", |w| image_io::write_raw(w, &visible)))
        .and_then(|()| out.file("truth/primitives.json", |w| writeln!(w, "{text:#}")))
        .map_err(|e| output_failure(&e))
}

#[cfg(not(feature = "sim"))]
fn truth(
    _out: &mut OutputFolder,
    _world: Option<&World>,
    _recorded: &[SlotLabel],
    _source: &str,
) -> Result<(), Failure> {
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(sequences: &[u32], wants_whole_cycle: bool) -> (Vec<usize>, Taken) {
        let mut taken = Taken { labels: Vec::new(), lost: 0, restarts: 0, wants_whole_cycle };
        let label = |sequence| SlotLabel {
            sequence,
            slot: 0,
            projector_mask: 1,
            floodlight: false,
            trigger_time_us: 0,
            exposure_us: 0,
        };
        (sequences.iter().map(|&sequence| taken.place(label(sequence))).collect(), taken)
    }

    #[test]
    fn a_cycle_begins_anew_where_a_pair_was_lost() {
        let (places, taken) = places(&[4, 5, 7, 8, 9], true);
        assert_eq!(places, [0, 1, 0, 1, 2]);
        assert_eq!((taken.labels[0].sequence, taken.restarts, taken.lost), (7, 1, 0));
    }

    #[test]
    fn a_number_of_pairs_is_recorded_as_they_come() {
        let (places, taken) = places(&[4, 5, 7, 10], false);
        assert_eq!(places, [0, 1, 2, 3]);
        assert_eq!((taken.restarts, taken.lost), (0, 3));
    }

    #[test]
    fn a_source_that_never_delivers_a_whole_cycle_is_recorded_all_the_same() {
        let every_second: Vec<u32> = (0..60).map(|k| 2 * k).collect();
        let (_, taken) = places(&every_second, true);
        assert_eq!((taken.restarts, taken.labels.len()), (RESTARTS, 60 - RESTARTS as usize));
    }
}
