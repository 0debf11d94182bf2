//! Opening a source, and what its errors mean for the exit code.

use std::path::{Path, PathBuf};
use std::time::Duration;

use stspp::export::folder::OutputError;
use stspp::{
    Error, ExternalTrigger, ProjectionTiming, Sensor, StreamOptions, TriggerEdge, TriggerSource,
    timing,
};

use crate::exit::{Failure, Kind};
use crate::reconstruct::Matching;

/// The source of a verb.
#[derive(clap::Args, Clone)]
pub struct Source {
    /// Where frames come from: usb:, usb:SERIAL, serial:PORT, sim:, sim:SCENE?OPTION=VALUE&...,
    /// replay:FOLDER.
    #[arg(long = "source", short = 's', default_value = "sim:", value_name = "URI")]
    pub uri: String,
    /// Projection timing to set first: a JSON file as `timing get --json` prints it.
    #[arg(long, value_name = "FILE")]
    pub timing: Option<PathBuf>,
    /// What starts slots, as long as this command runs: `free` (the device's timer) or `external`,
    /// edges at its trigger-in: `external:rising` or `external:falling`, and the slot's delay after
    /// the edge in microseconds: `external:rising:200`.
    #[arg(long, value_name = "SOURCE", value_parser = parse_trigger)]
    pub trigger: Option<TriggerSource>,
    /// Without a result for so long, the part that is silent is named. A machine that is slow needs more;
    /// frames are waited for longer then, too.
    #[arg(long, value_name = "SECONDS", default_value_t = TIMEOUT_S)]
    pub timeout: f64,
}

/// Seconds after which silence is reported.
const TIMEOUT_S: f64 = 3.0;

impl Source {
    /// A source with the usual timeout.
    pub fn new(uri: String, timing: Option<PathBuf>) -> Self {
        Self { uri, timing, trigger: None, timeout: TIMEOUT_S }
    }

    /// Opens it and sets timing and trigger, where they are given.
    pub fn open(&self) -> Result<Sensor, Failure> {
        let mut sensor = Sensor::open(&self.uri).map_err(|e| failure(&e))?;
        self.set(&mut sensor)?;
        Ok(sensor)
    }

    /// What is to be set before all else. The device forgets the trigger with the session, so that each
    /// command names it anew.
    fn set(&self, sensor: &mut Sensor) -> Result<(), Failure> {
        if let Some(path) = &self.timing {
            sensor.set_timing(read_timing(path)?).map_err(|e| failure(&e))?;
        }
        match self.trigger {
            Some(trigger) => sensor.set_trigger_source(trigger).map_err(|e| failure(&e)),
            None => Ok(()),
        }
    }

    /// After the sensor restarted, or was plugged in again.
    pub fn set_again(&self, sensor: &mut Sensor) -> Result<(), stspp::Error> {
        match self.trigger {
            Some(trigger) => sensor.set_trigger_source(trigger),
            None => Ok(()),
        }
    }
}

/// `free`, `external`, `external:EDGE`, `external:EDGE:DELAY_US`.
fn parse_trigger(text: &str) -> Result<TriggerSource, String> {
    let wrong = || format!("{text:?}: expected free or external:rising:DELAY_US");
    let mut parts = text.split(':');
    let mut external = ExternalTrigger::default();
    match (parts.next(), text) {
        (_, "free") => return Ok(TriggerSource::FreeRunning),
        (Some("external"), _) => {}
        _ => return Err(wrong()),
    }
    external.edge = match parts.next() {
        None | Some("rising") => TriggerEdge::Rising,
        Some("falling") => TriggerEdge::Falling,
        Some(_) => return Err(wrong()),
    };
    if let Some(delay_us) = parts.next() {
        external.delay_us = delay_us.parse().map_err(|_| wrong())?;
    }
    if parts.next().is_some() {
        return Err(wrong());
    }
    let source = TriggerSource::External(external);
    source.validate().map(|()| source).map_err(|error| error.to_string())
}

/// Reads a timing from a file, bare or as the `timing` of an object.
pub fn read_timing(path: &Path) -> Result<ProjectionTiming, Failure> {
    let wrong = |what: String| Failure::new(Kind::Input, format!("{}: {what}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    let value: serde_json::Value =
        serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))?;
    let bare = value.get("timing").unwrap_or(&value).to_string();
    timing::from_json(&bare).map_err(|error| wrong(error.to_string()))
}

/// Stream options of the flags; a recording needs no source's.
pub fn stream_options(source: Option<&Source>, matching: Option<&Matching>) -> StreamOptions {
    let defaults = StreamOptions::default();
    let timeout = source.and_then(|s| Duration::try_from_secs_f64(s.timeout).ok());
    StreamOptions {
        matching: matching.map_or(defaults.matching, Matching::options),
        timeout: timeout.filter(|timeout| !timeout.is_zero()).unwrap_or(defaults.timeout),
        budget: defaults.budget,
    }
}

/// The failure that an error of the library is.
pub fn failure(error: &Error) -> Failure {
    let kind = match error {
        Error::Uri(_)
        | Error::Simulation(_)
        | Error::Recording(_)
        | Error::Calibration(_)
        | Error::NoCalibration(_)
        | Error::Rectify(_)
        | Error::Match(_)
        | Error::Timing(_)
        | Error::NoSpeckleSlot => Kind::Input,
        Error::Transport(_)
        | Error::Camera(_)
        | Error::Timeout(_)
        | Error::Refused { .. }
        | Error::Faulted(_)
        | Error::DeviceReset(_)
        | Error::OtherSensor { .. }
        | Error::NotBuiltIn { .. }
        | Error::Unsupported { .. }
        | Error::Streaming => Kind::Sensor,
        _ => Kind::Other,
    };
    let failure = Failure::new(kind, error);
    match error {
        Error::Uri(_) => failure.remedy("see `stspp list`"),
        Error::Simulation(_) => failure.remedy("see `stspp list --scenes`"),
        Error::Timing(_) => failure.remedy("nothing has changed; `stspp info` shows the limits"),
        _ => failure,
    }
}

/// The failure that an output error is.
pub fn output_failure(error: &OutputError) -> Failure {
    crate::reconstruct::output_failure(error)
}

#[cfg(feature = "sim")]
impl Source {
    /// Opens a `sim:` source and keeps its world, for truth.
    ///
    /// # Errors
    /// As [`Source::open`]; for any other source.
    pub fn open_sim(
        &self,
    ) -> Result<(Sensor, std::sync::Arc<stspp_hil_sim::world::World>), Failure> {
        let uri: stspp::SourceUri = self.uri.parse().map_err(|e| failure(&Error::Uri(e)))?;
        let stspp::SourceUri::Sim { scene, options } = &uri else {
            return Err(Failure::new(Kind::Usage, format!("{uri}: expected a sim: source")));
        };
        let options =
            stspp::sim::SimOptions::parse(scene.as_deref(), options).map_err(|e| failure(&e))?;
        let sim = stspp::sim::SimSensor::new(&options).map_err(|e| failure(&e))?;
        let world = std::sync::Arc::clone(&sim.world);
        let mut sensor = Sensor::from_parts(sim.into_parts(uri)).map_err(|e| failure(&e))?;
        self.set(&mut sensor)?;
        Ok((sensor, world))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triggers_are_named_by_edge_and_delay() {
        let external = |edge, delay_us| TriggerSource::External(ExternalTrigger { edge, delay_us });
        let parse = |text| parse_trigger(text).unwrap();
        assert_eq!(parse("free"), TriggerSource::FreeRunning);
        assert_eq!(parse("external"), TriggerSource::External(ExternalTrigger::default()));
        let shortest = ExternalTrigger::MIN_DELAY_US;
        assert_eq!(parse("external:falling"), external(TriggerEdge::Falling, shortest));
        assert_eq!(parse("external:rising:200"), external(TriggerEdge::Rising, 200));
        for wrong in ["", "frei", "external:up", "external:rising:x", "external:rising:200:1"] {
            assert!(parse_trigger(wrong).is_err(), "{wrong}");
        }
        // A delay that no device keeps is refused before the device is asked.
        assert!(parse_trigger("external:rising:5").is_err());
    }
}
