//! The validator against the edges themselves: a second opinion that lays out two slot cycles on a
//! microsecond grid and looks at what is lit when.

use proptest::prelude::*;
use stspp_protocol::timing::{
    Limits, MAX_SLOTS, ProjectionTiming, SLOT_GUARD_US, Slot, TimingError, TimingField,
};

const LIMITS: Limits = Limits::F350;

/// Timings on both sides of the rules, most of them near.
fn timing() -> impl Strategy<Value = ProjectionTiming> {
    let slot = prop_oneof![
        8 => (0u8..10).prop_map(Slot::projector),
        2 => (0u16..1 << 11, any::<bool>())
            .prop_map(|(projector_mask, floodlight)| Slot { projector_mask, floodlight }),
        1 => Just(Slot::dark()),
        1 => Just(Slot::floodlight()),
    ];
    let times = (
        prop_oneof![900u32..1_200, 1_000u32..66_000],
        0u32..1_100,
        0u32..1_050,
        0u32..1_050,
        -30i64..30,
    );
    (prop::collection::vec(slot, 0..=MAX_SLOTS), times).prop_map(
        |(slots, (period, delay, lead, lag, slack))| {
            // Exposures that nearly fill the slot find the edges of the rules.
            let exposure = i64::from(period) - i64::from(delay.max(lead)) - i64::from(lag) + slack;
            ProjectionTiming {
                slots: slots.into_iter().collect(),
                frame_period_us: period,
                exposure_us: exposure.clamp(0, 45_000) as u32,
                trigger_delay_us: delay,
                gate_lead_us: lead,
                gate_lag_us: lag,
            }
        },
    )
}

/// What is wrong with a timing, found by laying out its edges.
fn faults_by_layout(timing: &ProjectionTiming) -> Vec<&'static str> {
    let mut faults = Vec::new();
    let t = |us: u32| i64::from(us);
    let period = t(timing.frame_period_us);
    if timing.slots.is_empty() {
        return vec!["no slots"];
    }
    let (lead, lag) = (t(timing.gate_lead_us), t(timing.gate_lag_us));
    let trigger_on = t(timing.trigger_delay_us);
    let trigger_off = trigger_on + t(timing.exposure_us);
    let (gate_on, gate_off) = (trigger_on - lead, trigger_off + lag);
    if !(1_000..=65_535).contains(&period) {
        faults.push("period");
    }
    if lead > 1_000 || lag > 1_000 {
        faults.push("margin");
    }
    if trigger_off - trigger_on < 10 {
        faults.push("exposure");
    }
    if gate_off - gate_on > 40_000 {
        faults.push("on-time");
    }
    if gate_on < t(SLOT_GUARD_US) || gate_off > period - t(SLOT_GUARD_US) {
        faults.push("outside of the slot");
    }
    if gate_on + period - gate_off < 2 {
        faults.push("dead time");
    }
    for slot in &timing.slots {
        let lit = (0..16).filter(|bit| slot.projector_mask >> bit & 1 == 1);
        if lit.clone().any(|bit| bit >= 10) {
            faults.push("unknown projector");
        }
        if lit.count() > 3 {
            faults.push("too many at once");
        }
    }
    let cycle = period * timing.slots.len() as i64;
    let mut lit_us = [0; 17];
    for slot in &timing.slots {
        for (emitter, lit_us) in lit_us.iter_mut().enumerate() {
            let on = if emitter == 16 {
                slot.floodlight
            } else {
                slot.projector_mask >> emitter & 1 == 1
            };
            *lit_us += if on { gate_off - gate_on } else { 0 };
        }
    }
    if lit_us[..16].iter().any(|&lit| lit * 1_000 > 400 * cycle) || lit_us[16] * 1_000 > 500 * cycle
    {
        faults.push("duty");
    }
    faults
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4_000))]

    #[test]
    fn a_timing_is_valid_where_its_edges_are(timing in timing()) {
        let faults = faults_by_layout(&timing);
        let result = timing.validate(&LIMITS);
        prop_assert_eq!(result.is_ok(), faults.is_empty(), "{:?} but {:?}", result, faults);
    }

    /// The range that an error names is the truth: a value inside it is not refused for that field.
    #[test]
    fn the_range_in_the_error_is_right(timing in timing(), pick in 0.0..=1.0f64) {
        let Err(TimingError { field, value, min, max, .. }) = timing.validate(&LIMITS) else {
            return Ok(());
        };
        prop_assert!(!(min..=max).contains(&value));
        let mut better = timing.clone();
        let place = match field {
            TimingField::FramePeriodUs => &mut better.frame_period_us,
            TimingField::ExposureUs => &mut better.exposure_us,
            TimingField::TriggerDelayUs => &mut better.trigger_delay_us,
            TimingField::GateLeadUs => &mut better.gate_lead_us,
            TimingField::GateLagUs => &mut better.gate_lag_us,
            _ => return Ok(()),
        };
        if min <= max {
            *place = min + (f64::from(max - min) * pick) as u32;
            if let Err(error) = better.validate(&LIMITS) {
                let is_period = field == TimingField::FramePeriodUs;
                // The period is held against the board first and against the other fields later.
                prop_assert!(error.field != field || is_period, "{error} after {field:?}");
            }
        }
    }

    #[test]
    fn no_numbers_upset_the_validator(
        slots in prop::collection::vec(any::<(u16, bool)>(), 0..=MAX_SLOTS),
        [a, b, c, d, e] in any::<[u32; 5]>(),
    ) {
        let slots = slots
            .into_iter()
            .map(|(projector_mask, floodlight)| Slot { projector_mask, floodlight })
            .collect();
        let timing = ProjectionTiming {
            slots, frame_period_us: a, exposure_us: b, trigger_delay_us: c, gate_lead_us: d,
            gate_lag_us: e,
        };
        let lax = Limits {
            max_frame_period_us: u32::MAX,
            max_on_time_us: u32::MAX,
            max_gate_margin_us: u32::MAX,
            min_dead_time_us: u32::MAX,
            ..LIMITS
        };
        let _ = (timing.validate(&LIMITS), timing.validate(&lax));
    }
}

#[test]
fn the_default_is_the_papers() {
    let timing = ProjectionTiming::default();
    timing.validate(&Limits::F330).unwrap();
    timing.validate(&Limits::F350).unwrap();
    assert_eq!(timing.slots.len(), 10);
    assert!((1e6 / f64::from(timing.frame_period_us) - 30.0).abs() < 0.001, "30 Hz");
    assert_eq!(timing.exposure_us, 32_000);
    for (index, slot) in timing.slots.iter().enumerate() {
        assert_eq!((slot.projector_mask, slot.floodlight), (1 << index, false));
    }
}

/// 1 ms slots, and ten microseconds and less from gate off to gate on.
#[test]
fn a_kilohertz_with_short_switching_is_possible() {
    for dead_us in [2, 5, 10] {
        let timing = ProjectionTiming {
            frame_period_us: 1_000,
            exposure_us: 1_000 - dead_us,
            trigger_delay_us: 1,
            gate_lead_us: 0,
            gate_lag_us: 0,
            ..ProjectionTiming::default()
        };
        timing.validate(&Limits::F330).unwrap();
        assert_eq!(timing.dead_time_us(), dead_us);
    }
}

#[test]
fn errors_name_field_value_and_range() {
    let base = ProjectionTiming::default();
    let cases: [(ProjectionTiming, &str); 9] = [
        (
            ProjectionTiming { slots: heapless::Vec::new(), ..base.clone() },
            "timing: slots is 0; allowed is 1..=16",
        ),
        (
            ProjectionTiming { exposure_us: 34_000, ..base.clone() },
            "timing: frame_period_us is 33333; allowed is 34151..=65535",
        ),
        (
            ProjectionTiming { exposure_us: 41_000, ..base.clone() },
            "timing: exposure_us is 41000; allowed is 10..=39900",
        ),
        (
            ProjectionTiming { frame_period_us: 999, ..base.clone() },
            "timing: frame_period_us is 999; allowed is 1000..=65535",
        ),
        (
            ProjectionTiming { trigger_delay_us: 50, ..base.clone() },
            "timing: trigger_delay_us is 50; allowed is 51..=33333",
        ),
        (
            ProjectionTiming { gate_lag_us: 1_001, ..base.clone() },
            "timing: gate_lag_us is 1001; allowed is 0..=1000",
        ),
        (
            with_slots(&[Slot { projector_mask: 0x400, floodlight: false }]),
            "timing: slot 0: projector_mask is 0x0400; allowed bits are 0x03ff",
        ),
        (
            with_slots(&[Slot::dark(), Slot { projector_mask: 0xF, floodlight: false }]),
            "timing: slot 1: projectors lit at once is 4; allowed is 0..=3",
        ),
        (
            with_slots(&[Slot::projector(7), Slot::projector(7)]),
            "timing: projector 7: duty_permille is 964; allowed is 0..=400",
        ),
    ];
    for (timing, message) in cases {
        assert_eq!(timing.validate(&LIMITS).unwrap_err().to_string(), message);
    }
}

#[test]
fn a_board_without_floodlight_refuses_it() {
    let dark = Limits { has_floodlight: false, ..LIMITS };
    let timing = with_slots(&[Slot::projector(0), Slot::floodlight(), Slot::projector(1)]);
    timing.validate(&LIMITS).unwrap();
    let error = timing.validate(&dark).unwrap_err();
    assert_eq!((error.field, error.index), (TimingField::Floodlight, Some(1)));
}

fn with_slots(slots: &[Slot]) -> ProjectionTiming {
    ProjectionTiming { slots: slots.iter().copied().collect(), ..ProjectionTiming::default() }
}
