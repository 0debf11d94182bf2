//! Projection timings on the host: all rules a timing breaks, and timings as JSON.

use stspp_protocol::timing::{Limits, ProjectionTiming, TimingError, TimingField};

/// Every rule that `timing` breaks on a board with these limits, in the validator's order; empty when
/// it can be met. The device applies the same validator, and names the first only.
pub fn violations(timing: &ProjectionTiming, limits: &Limits) -> Vec<TimingError> {
    // The validator stops at the first rule; each found violation is mended in a copy to see the next.
    let mut mended = timing.clone();
    let mut found: Vec<TimingError> = Vec::new();
    while let Err(error) = mended.validate(limits) {
        let known = found.iter().any(|f| f.field == error.field && f.index == error.index);
        if known || found.len() == 64 {
            break;
        }
        found.push(error);
        if !mend(&mut mended, &error, limits) {
            break;
        }
    }
    found
}

/// Makes the field at fault legal; `false` when that is not possible by itself.
fn mend(timing: &mut ProjectionTiming, error: &TimingError, limits: &Limits) -> bool {
    let index = usize::from(error.index.unwrap_or(0));
    let legal = (error.min <= error.max).then(|| error.value.clamp(error.min, error.max));
    match (error.field, legal) {
        (TimingField::ProjectorMask, _) => match timing.slots.get_mut(index) {
            Some(slot) => slot.projector_mask &= limits.projector_mask(),
            None => return false,
        },
        (TimingField::SimultaneousProjectors, _) => match timing.slots.get_mut(index) {
            Some(slot) => {
                while slot.projector_mask.count_ones() > error.max {
                    slot.projector_mask &= slot.projector_mask - 1;
                }
            }
            None => return false,
        },
        (TimingField::Floodlight, _) => match timing.slots.get_mut(index) {
            Some(slot) => slot.floodlight = false,
            None => return false,
        },
        (TimingField::FramePeriodUs, Some(value)) => timing.frame_period_us = value,
        (TimingField::GateLeadUs, Some(value)) => timing.gate_lead_us = value,
        (TimingField::GateLagUs, Some(value)) => timing.gate_lag_us = value,
        (TimingField::ExposureUs, Some(value)) => timing.exposure_us = value,
        (TimingField::TriggerDelayUs, Some(value)) => timing.trigger_delay_us = value,
        // A cycle that is empty or too bright has no single field to mend.
        _ => return false,
    }
    true
}

/// Why a text is not a timing.
#[derive(Debug, thiserror::Error)]
#[error("timing: {0}")]
pub struct TimingTextError(serde_json::Error);

/// Reads a timing from JSON as [`to_json`] writes it.
///
/// # Errors
/// Names the field, or line and column.
pub fn from_json(text: &str) -> Result<ProjectionTiming, TimingTextError> {
    serde_json::from_str(text).map_err(TimingTextError)
}

/// A timing as JSON.
pub fn to_json(timing: &ProjectionTiming) -> serde_json::Value {
    serde_json::to_value(timing).expect("a timing is plain numbers")
}

#[cfg(test)]
mod tests {
    use super::*;
    use stspp_protocol::timing::Slot;

    #[test]
    fn all_violations_are_found() {
        let mut timing = ProjectionTiming { exposure_us: 50_000, ..Default::default() };
        timing.gate_lead_us = 5_000;
        timing.slots[3] = Slot { projector_mask: 1 << 12, floodlight: false };
        let fields: Vec<_> =
            violations(&timing, &Limits::F350).into_iter().map(|v| v.field).collect();
        for field in [TimingField::ProjectorMask, TimingField::GateLeadUs, TimingField::ExposureUs]
        {
            assert!(fields.contains(&field), "{fields:?}");
        }
        assert!(violations(&ProjectionTiming::default(), &Limits::F350).is_empty());
    }

    #[test]
    fn an_empty_cycle_ends_the_search() {
        let timing = ProjectionTiming { slots: Default::default(), ..Default::default() };
        let found = violations(&timing, &Limits::F350);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].field, TimingField::SlotCount);
    }

    #[test]
    fn json_round_trips_and_names_what_is_wrong() {
        let timing = ProjectionTiming::default();
        assert_eq!(from_json(&to_json(&timing).to_string()).unwrap(), timing);
        let error = from_json("{\"slots\": []}").unwrap_err().to_string();
        assert!(error.contains("frame_period_us"), "{error}");
    }
}
