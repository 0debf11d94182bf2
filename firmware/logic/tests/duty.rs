//! The buckets against sums over every stretch of time.

use proptest::prelude::*;
use stspp_firmware_logic::duty::DutyBudget;
use stspp_firmware_logic::timing::GateWord;
use stspp_protocol::timing::{Limits, Slot};

const LIMITS: Limits = Limits::F350;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// While no charge is refused, no stretch of time has more light than `duty * (t + window)`.
    #[test]
    fn the_bound_holds_over_every_stretch(
        pulses in prop::collection::vec((0u64..120_000, 1u32..40_000), 1..120),
        projector in 0u8..10,
    ) {
        let gates = GateWord::from_slot(Slot::projector(projector));
        let mut budget = DutyBudget::new(&LIMITS, true);
        let mut now_us = 0;
        let mut lit: Vec<(u64, u64)> = Vec::new();
        for (rest_us, on_us) in pulses {
            let on = now_us + rest_us;
            now_us = on + u64::from(on_us);
            budget.advance(now_us);
            let charged = budget.charge(gates, on_us);
            lit.push((on, now_us));
            let duty = f64::from(LIMITS.max_projector_duty_permille) / 1_000.0;
            let worst_us = lit
                .iter()
                .map(|&(start, _)| {
                    let on_us: u64 =
                        lit.iter().filter(|&&(on, _)| on >= start).map(|&(on, off)| off - on).sum();
                    on_us as f64 - duty * (now_us - start) as f64
                })
                .fold(0.0, f64::max);
            let capacity_us = duty * f64::from(LIMITS.duty_window_us);
            if charged.is_ok() {
                prop_assert!(worst_us <= capacity_us, "{worst_us} of {capacity_us} us");
            } else {
                // It is not refused early either: charging at a pulse's end instead of all along is
                // off by less than what leaks in one pulse.
                prop_assert!(worst_us > capacity_us - 40_000.0, "{worst_us} of {capacity_us} us");
                return Ok(());
            }
        }
    }

    /// The rest that a refusal asks for is what it takes.
    #[test]
    fn the_rest_asked_for_is_enough_and_needed(on_us in 430_000u32..800_000) {
        let gates = GateWord::from_slot(Slot::projector(2));
        let mut budget = DutyBudget::new(&LIMITS, true);
        budget.charge(gates, on_us).unwrap();
        let refused = budget.admit(gates).unwrap_err();
        prop_assert_eq!(refused.emitter, 2);
        let rest_us = u64::from(refused.retry_after_us);
        budget.advance(rest_us - 1);
        prop_assert!(budget.admit(gates).is_err());
        budget.advance(rest_us);
        prop_assert!(budget.admit(gates).is_ok());
    }
}

#[test]
fn emitters_are_charged_apart() {
    let mut budget = DutyBudget::new(&LIMITS, true);
    budget.charge(GateWord::FLOODLIGHT_ONLY, 600_000).unwrap();
    let refused = budget.admit(GateWord::FLOODLIGHT_ONLY).unwrap_err();
    assert_eq!(refused.emitter, LIMITS.projector_count);
    for projector in 0..10 {
        budget.admit(GateWord::from_slot(Slot::projector(projector))).unwrap();
    }
    budget.admit(GateWord::DARK).unwrap();
}

#[test]
fn only_the_rested_start_empty() {
    let gates = GateWord::from_slot(Slot::projector(0));
    assert!(DutyBudget::new(&LIMITS, true).admit(gates).is_ok());
    let mut budget = DutyBudget::new(&LIMITS, false);
    let rest_us = budget.admit(gates).unwrap_err().retry_after_us;
    assert_eq!(rest_us, LIMITS.duty_window_us / 2);
    budget.advance(u64::from(rest_us));
    assert!(budget.admit(gates).is_ok());
}
