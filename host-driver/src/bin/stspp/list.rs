//! `stspp list`: sources that can be opened.

use serde_json::{Value, json};

use crate::exit::Failure;
use crate::output::Output;

/// List the sensors that are there, and the simulated one.
///
/// Each sensor on USB is asked who it is; one that another program uses is listed without its versions.
#[derive(clap::Args)]
pub struct Args {
    /// List the scenes of sim: with their options instead.
    #[arg(long)]
    scenes: bool,
    /// Ask at every USB serial port whether a sensor is there, which sends a few bytes to whatever is.
    #[arg(long)]
    probe_serial: bool,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    if args.scenes {
        return scenes(output);
    }
    let mut sensors = usb();
    if args.probe_serial {
        sensors.extend(serial());
    }
    if cfg!(feature = "sim") {
        sensors.push(json!({
            "source": "sim:",
            "kind": "simulated",
            "description": "simulated sensor, always there; `stspp list --scenes` shows its scenes",
        }));
    }
    let text: Vec<String> = sensors
        .iter()
        .map(|s| {
            let field = |name: &str| s[name].as_str().unwrap_or_default().to_owned();
            format!("{:<30} {}", field("source"), field("description"))
        })
        .collect();
    output.result(&text.join("\n"), &json!({ "sensors": sensors }));
    Ok(())
}

/// A sensor that was asked who it is.
fn described(source: String, kind: &str, asked: Result<Identity, String>) -> Value {
    match asked {
        Ok(Identity { serial, board, firmware, protocol }) => json!({
            "source": source,
            "kind": kind,
            "serial": serial,
            "board": board,
            "firmware": firmware,
            "protocol": protocol,
            "description": format!("board {board}, firmware {firmware}, protocol {protocol}"),
        }),
        Err(problem) => json!({
            "source": source,
            "kind": kind,
            "problem": problem,
            "description": problem,
        }),
    }
}

/// What a device says of itself.
struct Identity {
    serial: String,
    board: String,
    firmware: String,
    protocol: String,
}

impl Identity {
    fn of(info: &stspp_protocol::version::DeviceInfo) -> Self {
        Self {
            serial: info.serial.to_string(),
            board: format!("{:?}", info.board),
            firmware: info.firmware.to_string(),
            protocol: info.protocol.to_string(),
        }
    }
}

#[cfg(feature = "usb")]
fn usb() -> Vec<Value> {
    use std::sync::Arc;
    use stspp::clock::MonotonicClock;
    use stspp::transport::{Link, usb::device};
    use stspp_protocol::request::GetInfo;

    // Without USB there is nothing to list; `doctor` says why.
    let sensors = device::sensors().unwrap_or_default();
    let ask = |serial: &str| -> Result<Identity, String> {
        let (transport, _) = device::open(Some(serial)).map_err(|e| e.to_string())?;
        let mut link = Link::new(Box::new(transport), Arc::new(MonotonicClock::new()));
        let info = link.identify(&GetInfo).map_err(|e| e.to_string())?;
        Ok(Identity::of(&info))
    };
    sensors
        .iter()
        .map(|sensor| {
            let mut entry = described(format!("usb:{}", sensor.serial), "usb", ask(&sensor.serial));
            entry["serial"] = json!(sensor.serial);
            entry["usb_path"] = json!(sensor.usb_path);
            entry["speed_mbit_s"] = json!(sensor.speed_mbit_s);
            entry
        })
        .collect()
}

#[cfg(not(feature = "usb"))]
fn usb() -> Vec<Value> {
    Vec::new()
}

fn serial() -> Vec<Value> {
    use stspp::transport::serial;
    serial::ports()
        .iter()
        .filter_map(|port| {
            // Other things at serial ports are none of ours; one that may not be opened may be.
            let asked = match serial::probe(port) {
                Ok(info) => Ok(Identity::of(&info)),
                Err(stspp::Error::Transport(
                    error @ (stspp::transport::TransportError::Permission { .. }
                    | stspp::transport::TransportError::Busy { .. }),
                )) => Err(error.to_string()),
                Err(_) => return None,
            };
            Some(described(format!("serial:{}", port.display()), "serial", asked))
        })
        .collect()
}

#[cfg(feature = "sim")]
fn scenes(output: &Output) -> Result<(), Failure> {
    let scenes = stspp::sim::boards::scenes();
    let mut text = String::new();
    for scene in &scenes {
        text += &format!("sim:{}  {}\n", scene.name, scene.summary);
        for option in scene.options {
            text += &format!("    {}={}  {}\n", option.name, option.default, option.summary);
        }
    }
    text += "\nOf the sensor, with any scene:\n";
    for (name, default, summary) in stspp::sim::options::SENSOR_OPTIONS {
        text += &format!("    {name}={default}  {summary}\n");
    }
    let option = |name: &str, default: &str, summary: &str| json!({ "name": name, "default": default, "summary": summary });
    let json = json!({
        "scenes": scenes.iter().map(|scene| json!({
            "name": scene.name,
            "summary": scene.summary,
            "options": scene.options.iter()
                .map(|o| option(o.name, o.default, o.summary)).collect::<Vec<_>>(),
        })).collect::<Vec<_>>(),
        "sensor_options": stspp::sim::options::SENSOR_OPTIONS.iter()
            .map(|(name, default, summary)| option(name, default, summary)).collect::<Vec<_>>(),
    });
    output.result(&text, &json);
    Ok(())
}

#[cfg(not(feature = "sim"))]
fn scenes(_output: &Output) -> Result<(), Failure> {
    Err(Failure::new(crate::exit::Kind::Sensor, "sim: is not built into this version of stspp"))
}
