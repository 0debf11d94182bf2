//! Board images live from a sensor, under its floodlight.

use std::path::PathBuf;
use std::time::Duration;

use stspp::calibrate::Board;
use stspp::calibrate::collect::{Collector, Offer};
use stspp::calibrate::images::Found;
use stspp::export::folder::OutputFolder;
use stspp::recording::StereoPair;
use stspp::{Error, ProjectionTiming, Sensor, Slot, StreamOptions, image_io};

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;
use crate::source::{Source, failure, output_failure};

/// How long nothing may be taken before it is given up.
const PATIENCE: Duration = Duration::from_secs(120);
/// The same where nobody brings a board: the simulator's is there, or never.
const PATIENCE_SIM: Duration = Duration::from_secs(10);

/// What live images take.
#[derive(clap::Args)]
#[group(skip)]
pub struct Args {
    /// Where images come from: usb:, usb:SERIAL, serial:PORT, or the simulated sensor with a board.
    #[arg(long = "source", short = 's', default_value = "sim:calibration", value_name = "URI")]
    uri: String,
    /// Image pairs to take.
    #[arg(long, short = 'n', default_value_t = 25, value_name = "N")]
    images: usize,
    /// Exposure under the floodlight in microseconds.
    #[arg(long, default_value_t = 30_000, value_name = "US")]
    exposure_us: u32,
    /// Keep the images in this folder, to calibrate from again.
    #[arg(long, value_name = "DIR")]
    save: Option<PathBuf>,
}

/// Takes images until there are enough; also tells the sensor's temperature.
pub fn collect(
    args: &Args,
    board: &Board,
    force: bool,
    output: &Output,
) -> Result<(Found, Option<f64>), Failure> {
    let mut sensor = Source::new(args.uri.clone(), None).open()?;
    // Every second slot is dark: the floodlight keeps within its duty.
    let timing = ProjectionTiming {
        slots: [Slot::floodlight(), Slot::dark()].into_iter().collect(),
        exposure_us: args.exposure_us,
        ..ProjectionTiming::default()
    };
    match sensor.set_timing(timing) {
        // A recording shows what it shows.
        Ok(()) | Err(Error::Unsupported { .. }) => {}
        Err(error) => return Err(failure(&error)),
    }
    let mut folder = match &args.save {
        Some(path) => Some(OutputFolder::create(path, force).map_err(|e| output_failure(&e))?),
        None => None,
    };
    let temperature_c = sensor.status().ok().map(|status| f64::from(status.temperature_dc) / 10.0);
    let found = stream(args, board, &mut sensor, folder.as_mut(), output)?;
    if let Some(folder) = folder {
        folder.commit().map_err(|e| output_failure(&e))?;
    }
    Ok((found, temperature_c))
}

fn stream(
    args: &Args,
    board: &Board,
    sensor: &mut Sensor,
    mut folder: Option<&mut OutputFolder>,
    output: &Output,
) -> Result<Found, Failure> {
    let mut pairs = sensor.pairs(&StreamOptions::default()).map_err(|e| failure(&e))?;
    interrupt::stops(pairs.stop_handle());
    let progress = output.progress(args.images as u64, "taking boards");
    let mut collector = Collector::new(board);
    let mut last_kept_s: Option<f64> = None;
    let mut last: Option<Offer> = None;
    let patience = if args.uri.starts_with("sim:") { PATIENCE_SIM } else { PATIENCE };
    while collector.len() < args.images {
        let Some(pair) = pairs.next() else { break };
        let pair = pair.map_err(|e| failure(&e))?;
        interrupt::check()?;
        if !pair.label.floodlight {
            continue;
        }
        let now_s = pair.label.exposure_centre_s();
        let since_s = now_s - *last_kept_s.get_or_insert(now_s);
        let pair = StereoPair { left: pair.left, right: pair.right };
        let offer = collector.offer(&pair);
        if offer == Offer::Kept {
            last_kept_s = Some(now_s);
            progress.inc(1);
            if let Some(folder) = &mut folder {
                for (side, image) in [("left", &pair.left), ("right", &pair.right)] {
                    let name = format!("{side}/{:02}.png", collector.len() - 1);
                    folder
                        .file(&name, |out| image_io::write_raw(out, image))
                        .map_err(|e| output_failure(&e))?;
                }
            }
        } else if since_s > patience.as_secs_f64() {
            break;
        }
        progress.set_message(match &offer {
            Offer::Kept => "taken: move the board",
            Offer::Moving => "hold still",
            Offer::Known => "move the board",
            _ => "show the board",
        });
        last = Some(offer);
    }
    interrupt::check()?;
    progress.finish_and_clear();
    match collector.found() {
        Some(found) => Ok(found.clone()),
        None => {
            let why = match last {
                Some(Offer::NotSeen([left, right])) => {
                    let text = |problem: &Option<stspp::calibrate::detect::Problem>| {
                        problem.as_ref().map_or("too few points".to_owned(), ToString::to_string)
                    };
                    format!("left: {}; right: {}", text(&left), text(&right))
                }
                Some(Offer::Moving) => "the board never rested".to_owned(),
                _ => "no floodlit frame came".to_owned(),
            };
            let what = format!("no image of {board} was taken: {why}");
            Err(Failure::new(Kind::Input, what)
                .remedy("check --board, the light and --exposure-us"))
        }
    }
}
