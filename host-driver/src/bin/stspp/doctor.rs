//! `stspp doctor`: why a sensor does not work here, and what to do about each thing that is wrong.
//!
//! [`system`] looks at the machine, [`device`] at the sensor that is plugged in. Nothing is lit and no
//! setting is changed.

mod device;
mod system;

use serde::Serialize;
use serde_json::json;
use stspp::SourceUri;

use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Check this machine and the sensor: permissions, udev rule, kernel modules, USB speed and bandwidth,
/// firmware and protocol, cameras, calibration, faults.
#[derive(clap::Args)]
pub struct Args {
    /// The sensor to check: usb:, usb:SERIAL or serial:PORT, with options.
    #[arg(long = "source", short = 's', default_value = "usb:", value_name = "URI")]
    uri: String,
    /// Clear latched faults first; those whose cause is still there stay.
    #[arg(long)]
    clear_faults: bool,
}

/// How a check came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// As it should be.
    Good,
    /// It works, though not as well as it could.
    Poor,
    /// No depth frame until this is mended.
    Bad,
}

/// One thing that was looked at.
#[derive(Debug, Clone, Serialize)]
pub struct Check {
    /// What.
    pub name: &'static str,
    /// How it came out.
    pub verdict: Verdict,
    /// What was found.
    pub found: String,
    /// What to do, unless it is good.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remedy: Option<String>,
}

impl Check {
    /// All is well.
    pub fn good(name: &'static str, found: impl Into<String>) -> Self {
        Self { name, verdict: Verdict::Good, found: found.into(), remedy: None }
    }

    /// It could be better.
    pub fn poor(name: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        let remedy = Some(remedy.into());
        Self { name, verdict: Verdict::Poor, found: found.into(), remedy }
    }

    /// It must be mended.
    pub fn bad(name: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        let remedy = Some(remedy.into());
        Self { name, verdict: Verdict::Bad, found: found.into(), remedy }
    }
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let uri: SourceUri =
        args.uri.parse().map_err(|e| crate::source::failure(&stspp::Error::Uri(e)))?;
    if !matches!(uri, SourceUri::Usb { .. } | SourceUri::Serial { .. }) {
        let what = format!("{uri}: doctor checks usb: and serial: sources");
        return Err(Failure::new(Kind::Usage, what));
    }
    if args.clear_faults {
        let cleared = stspp::Sensor::open_uri(&uri).and_then(|mut s| s.clear_faults());
        cleared.map_err(|e| crate::source::failure(&e))?;
    }
    let mut checks = system::checks();
    checks.extend(device::checks(&uri));
    let text: Vec<String> = checks.iter().map(line).collect();
    let bad = checks.iter().filter(|c| c.verdict == Verdict::Bad).count();
    let poor = checks.iter().filter(|c| c.verdict == Verdict::Poor).count();
    output.result(&text.join("\n"), &json!({ "source": args.uri, "bad": bad, "checks": checks }));
    if bad == 0 {
        if !output.json {
            println!("\n{uri} is fit to stream, {poor} things could be better");
        }
        return Ok(());
    }
    let first = checks.iter().find(|c| c.verdict == Verdict::Bad);
    let what = first.map_or(String::new(), |c| format!("{}: {}", c.name, c.found));
    let failure = Failure::new(
        Kind::Sensor,
        format!("{bad} of {} checks failed; first {what}", checks.len()),
    );
    Err(match first.and_then(|c| c.remedy.clone()) {
        Some(remedy) => failure.remedy(remedy),
        None => failure,
    })
}

fn line(check: &Check) -> String {
    let word = match check.verdict {
        Verdict::Good => "ok  ",
        Verdict::Poor => "POOR",
        Verdict::Bad => "BAD ",
    };
    let line = format!("{word}  {:<18} {}", check.name, check.found);
    match &check.remedy {
        Some(remedy) => format!("{line}\n{:24} -> {remedy}", ""),
        None => line,
    }
}
