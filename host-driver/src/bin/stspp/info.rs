//! `stspp info`: what a sensor is and how it is.

use serde_json::json;

use crate::exit::Failure;
use crate::output::Output;
use crate::source::{Source, failure};

/// Show versions, cameras, limits, state and faults of a sensor.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    source: Source,
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    let sensor = args.source.open()?;
    let info = sensor.info();
    let known = |value: &Option<String>| value.clone().unwrap_or_else(|| "-".into());
    let mut text = format!(
        "source    {}\nserial    {}\nboard     {}, firmware {}, protocol {} (host {})\n\
         cameras   {}\n",
        info.source,
        known(&info.serial),
        known(&info.board),
        known(&info.firmware),
        known(&info.protocol),
        info.host_protocol,
        match (info.width_px, info.height_px, info.baseline_m) {
            (Some(width), Some(height), Some(baseline_m)) => {
                format!("2 x {width}x{height} px, baseline {:.1} mm", baseline_m * 1e3)
            }
            _ => "not calibrated".into(),
        },
    );
    if let Some(recording) = sensor.recording() {
        text += &format!("recording {} pairs of {} bits\n", recording.len(), recording.bits());
        let json = json!({ "info": info, "pairs": recording.len(), "bits": recording.bits() });
        output.result(&text, &json);
        return Ok(());
    }
    let status = sensor.status().map_err(|e| failure(&e))?;
    let timing = sensor.timing().map_err(|e| failure(&e))?;
    let faults = sensor.faults().map_err(|e| failure(&e))?;
    text += &format!(
        "state     {}, faults: {}, interlock {}, {:.1} degrees C\n",
        status.state,
        faults.latched,
        if status.interlock_closed { "closed" } else { "open" },
        f32::from(status.temperature_dc) / 10.0,
    );
    if let Some(limits) = &info.limits {
        text += &format!(
            "limits    {} slots, {} projectors ({} at once), period {}..={} us, \
             on-time {} us, duty {} permille\n",
            limits.max_slots,
            limits.projector_count,
            limits.max_simultaneous_projectors,
            limits.min_frame_period_us,
            limits.max_frame_period_us,
            limits.max_on_time_us,
            limits.max_projector_duty_permille,
        );
    }
    text += &super::timing::describe(&timing);
    let trigger = super::timing::trigger(&sensor)?;
    text += &trigger.as_ref().map_or(String::new(), super::timing::describe_trigger);
    let json = json!({
        "info": info, "status": status, "faults": faults, "timing": timing, "trigger": trigger,
    });
    output.result(&text, &json);
    Ok(())
}
