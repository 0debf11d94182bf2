//! Every cause of darkness, on both boards: the table of docs/hardware.md, asserted.

mod common;

use stspp_hil_mcu::measure::faults::{Cause, measure};
use stspp_hil_mcu::soc::Variant;

fn every_cause(variant: Variant) {
    for cause in Cause::ALL.into_iter().filter(|cause| cause.applies_to(variant)) {
        let Some(mut session) = common::session(variant) else { return };
        let outcome = measure(&mut session, cause)
            .unwrap_or_else(|error| panic!("{variant:?}, {}: {error}", cause.describe()));
        let name = format!("{variant:?}, {}: {outcome:?}", cause.describe());
        println!("{name}");
        let dark_after_ns =
            outcome.dark_after_ns.unwrap_or_else(|| panic!("light went on: {name}"));
        assert!(dark_after_ns <= cause.bound_ns(variant), "too late: {name}");
        assert!(!outcome.light_again, "light came back by itself: {name}");
        let reasons = cause.reasons(variant);
        if !reasons.is_empty() {
            assert!(
                reasons.iter().any(|r| outcome.latched.contains(*r)),
                "no reason latched: {name}"
            );
            assert!(
                reasons.iter().any(|r| outcome.latched_after_reset.contains(*r)),
                "reason lost in a reset: {name}"
            );
            assert!(outcome.refused_to_arm, "armed with a latched fault: {name}");
        }
        assert!(outcome.recovered, "no light after clearing and arming: {name}");
        common::assert_all_modelled(&mut session);
    }
}

#[test]
fn every_cause_of_darkness_on_the_f330() {
    every_cause(Variant::F330);
}

#[test]
fn every_cause_of_darkness_on_the_f350() {
    every_cause(Variant::F350);
}
