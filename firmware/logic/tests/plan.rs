//! A plan is the timing in ticks.

use stspp_firmware_logic::timing::{GateWord, SlotPlan};
use stspp_protocol::timing::{Limits, ProjectionTiming, Slot, TimingField};

#[test]
fn ticks_are_microseconds_times_the_rate() {
    let timing = ProjectionTiming {
        slots: [Slot::projector(9), Slot { projector_mask: 5, floodlight: true }, Slot::dark()]
            .into_iter()
            .collect(),
        ..ProjectionTiming::default()
    };
    for rate in [1, 7, 108] {
        let plan = SlotPlan::compile(&timing, &Limits::F350, rate, 42).unwrap();
        assert_eq!(plan.period_ticks(), 33_333 * rate);
        assert_eq!(plan.gate_on_ticks(), 50 * rate);
        assert_eq!(plan.trigger_on_ticks(), 100 * rate);
        assert_eq!(plan.trigger_off_ticks(), 32_100 * rate);
        assert_eq!(plan.gate_off_ticks(), 32_150 * rate);
        assert_eq!(plan.on_time_ticks(), 32_100 * rate);
        assert_eq!((plan.timing_generation(), plan.ticks_per_us()), (42, rate));
        let bits: Vec<u32> = plan.gates().iter().map(|word| word.bits()).collect();
        assert_eq!(bits, [1 << 9, 5 | 1 << 16, 0]);
    }
}

#[test]
fn a_word_says_what_its_slot_says() {
    for slot in [
        Slot::dark(),
        Slot::floodlight(),
        Slot::projector(15),
        Slot { projector_mask: 0xFFFF, floodlight: true },
    ] {
        let word = GateWord::from_slot(slot);
        assert_eq!(
            (word.projector_mask(), word.floodlight()),
            (slot.projector_mask, slot.floodlight)
        );
    }
    assert_eq!(GateWord::FLOODLIGHT_ONLY, GateWord::from_slot(Slot::floodlight()));
}

#[test]
fn no_plan_comes_of_a_timing_that_does_not_validate() {
    let timing = ProjectionTiming { exposure_us: 33_333, ..ProjectionTiming::default() };
    let error = SlotPlan::compile(&timing, &Limits::F330, 1, 1).unwrap_err();
    assert_eq!(error.field, TimingField::FramePeriodUs);
}
