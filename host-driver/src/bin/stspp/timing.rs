//! `stspp timing`: what is projected when.

use std::fmt::Write;
use std::path::PathBuf;

use serde_json::json;
use stspp::{Error, ProjectionTiming, Sensor, Slot, TriggerInput};
use stspp_protocol::reply::RequestError;

use crate::exit::{Failure, Kind};
use crate::output::Output;
use crate::source::{Source, failure, read_timing};

/// Show or set the projection timing.
///
/// sim: keeps a timing as long as the command runs: store the printed JSON in a file and give it to
/// stream, capture, record or demo with --timing.
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(clap::Subcommand)]
enum Verb {
    /// Show the timing in force.
    Get {
        #[command(flatten)]
        source: Source,
    },
    /// Set the timing: the fields given, the others as they are.
    Set(Box<SetArgs>),
}

#[derive(clap::Args)]
struct SetArgs {
    #[command(flatten)]
    source: Source,
    /// Start from this timing (JSON) instead of the one in force.
    #[arg(long, value_name = "FILE")]
    from: Option<PathBuf>,
    /// Start from a new device's timing.
    #[arg(long, conflicts_with = "from")]
    defaults: bool,
    /// The slot cycle, separated by commas: a projector (3), several (3+7), a mask (0x88), flood, dark.
    #[arg(long, value_delimiter = ',', value_parser = parse_slot)]
    slots: Option<Vec<Slot>>,
    /// From slot to slot, microseconds.
    #[arg(long, value_name = "US")]
    period_us: Option<u32>,
    /// Exposure, microseconds.
    #[arg(long, value_name = "US")]
    exposure_us: Option<u32>,
    /// From slot start to exposure, microseconds.
    #[arg(long, value_name = "US")]
    delay_us: Option<u32>,
    /// Light on before the exposure, microseconds.
    #[arg(long, value_name = "US")]
    lead_us: Option<u32>,
    /// Light off after the exposure, microseconds.
    #[arg(long, value_name = "US")]
    lag_us: Option<u32>,
    /// Store it on the device for its next power-on.
    #[arg(long)]
    save: bool,
}

fn parse_slot(text: &str) -> Result<Slot, String> {
    let wrong = || format!("slot {text:?}: expected 0..15, 3+7, 0x88, flood or dark");
    let mut slot = Slot::dark();
    for part in text.trim().split('+') {
        match part.trim() {
            "flood" => slot.floodlight = true,
            "dark" if text.trim() == "dark" => {}
            part => match part.strip_prefix("0x") {
                Some(digits) => {
                    slot.projector_mask |= u16::from_str_radix(digits, 16).map_err(|_| wrong())?;
                }
                None => {
                    let index = part.parse::<u32>().ok().filter(|index| *index < 16);
                    slot.projector_mask |= 1 << index.ok_or_else(wrong)?;
                }
            },
        }
    }
    Ok(slot)
}

/// A slot as `--slots` takes it.
fn slot_text(slot: &Slot) -> String {
    let mut parts: Vec<String> =
        (0..16).filter(|k| slot.projector_mask >> k & 1 != 0).map(|k: u32| k.to_string()).collect();
    if slot.floodlight {
        parts.push("flood".into());
    }
    if parts.is_empty() { "dark".into() } else { parts.join("+") }
}

/// A timing for people.
pub fn describe(timing: &ProjectionTiming) -> String {
    let slots: Vec<String> = timing.slots.iter().map(slot_text).collect();
    let mut text = String::new();
    let _ = writeln!(text, "slots     {}", slots.join(","));
    let _ = writeln!(
        text,
        "timing    period {} us ({:.3} Hz), exposure {} us, delay {} us, lead {} us, lag {} us",
        timing.frame_period_us,
        1e6 / f64::from(timing.frame_period_us.max(1)),
        timing.exposure_us,
        timing.trigger_delay_us,
        timing.gate_lead_us,
        timing.gate_lag_us,
    );
    text
}

/// What starts slots; `None` where the device has no trigger-in.
pub fn trigger(sensor: &Sensor) -> Result<Option<TriggerInput>, Failure> {
    match sensor.trigger_input() {
        Ok(input) => Ok(Some(input)),
        Err(Error::Refused { source: RequestError::Unsupported, .. }) => Ok(None),
        Err(error) => Err(failure(&error)),
    }
}

/// The trigger for people.
pub fn describe_trigger(input: &TriggerInput) -> String {
    let mut text = format!("trigger   {}", input.source);
    if input.edges_taken > 0 || input.edges_ignored > 0 {
        let (taken, ignored) = (input.edges_taken, input.edges_ignored);
        let _ = write!(text, "; {taken} edges started a slot, {ignored} came too soon");
    }
    text + "\n"
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    match &args.verb {
        Verb::Get { source } => {
            let sensor = source.open()?;
            let timing = sensor.timing().map_err(|e| failure(&e))?;
            let trigger = trigger(&sensor)?;
            let text =
                describe(&timing) + &trigger.as_ref().map_or(String::new(), describe_trigger);
            output.result(&text, &json!({ "timing": timing, "trigger": trigger }));
            Ok(())
        }
        Verb::Set(args) => set(args, output),
    }
}

fn set(args: &SetArgs, output: &Output) -> Result<(), Failure> {
    let mut sensor = args.source.open()?;
    let mut timing = match &args.from {
        Some(path) => read_timing(path)?,
        None if args.defaults => ProjectionTiming::default(),
        None => sensor.timing().map_err(|e| failure(&e))?,
    };
    if let Some(slots) = &args.slots {
        timing.slots = slots.as_slice().try_into().map_err(|_| {
            let what = format!("timing: slots is {}; allowed is 1..=16", slots.len());
            Failure::new(Kind::Input, what)
        })?;
    }
    for (field, value) in [
        (&mut timing.frame_period_us, args.period_us),
        (&mut timing.exposure_us, args.exposure_us),
        (&mut timing.trigger_delay_us, args.delay_us),
        (&mut timing.gate_lead_us, args.lead_us),
        (&mut timing.gate_lag_us, args.lag_us),
    ] {
        *field = value.unwrap_or(*field);
    }
    sensor.set_timing(timing).map_err(|e| failure(&e))?;
    if args.save {
        sensor.save_settings().map_err(|e| failure(&e))?;
    }
    let timing = sensor.timing().map_err(|e| failure(&e))?;
    let mut text = describe(&timing);
    if args.source.uri.starts_with("sim:") {
        text += "accepted; sim: forgets it now: keep the output of --json and use --timing\n";
    } else if args.save {
        text += "accepted and stored\n";
    } else {
        text += "accepted until power-off; --save stores it\n";
    }
    output.result(&text, &json!({ "timing": timing, "saved": args.save }));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_are_read_as_they_are_printed() {
        for text in ["3", "3+7", "dark", "flood", "0+flood"] {
            assert_eq!(slot_text(&parse_slot(text).unwrap()), text);
        }
        assert_eq!(parse_slot("0x88").unwrap().projector_mask, 0x88);
        for wrong in ["16", "x", "0xzz", "", "dark+1"] {
            assert!(parse_slot(wrong).is_err(), "{wrong}");
        }
    }
}
