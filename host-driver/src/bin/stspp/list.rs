//! `stspp list`: sources that can be opened.

use serde_json::json;

use crate::exit::Failure;
use crate::output::Output;

/// List the sensors that are there, and the simulated one.
#[derive(clap::Args)]
pub struct Args {
    /// List the scenes of sim: with their options instead.
    #[arg(long)]
    scenes: bool,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    if args.scenes {
        return scenes(output);
    }
    let mut sensors = Vec::new();
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
            format!("{:<12} {}", field("source"), field("description"))
        })
        .collect();
    output.result(&text.join("\n"), &json!({ "sensors": sensors }));
    Ok(())
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
