//! The dependency arrows between our crates: data flows one way, and the compiler would not mind if
//! it did not.

use crate::workspace::items;
use serde_json::Value;

/// Each crate of ours and those of ours that it may depend on (ARCHITECTURE.md draws it). Tests may
/// join what the product keeps apart, so dev-dependencies are not arrows, except in the two crates
/// at the bottom.
const ALLOWED: &[(&str, &[&str])] = &[
    ("stspp-protocol", &[]),
    ("stspp-matcher", &[]),
    ("stspp-firmware-logic", &["stspp-protocol"]),
    ("stspp-hil-sim", &["stspp-protocol", "stspp-firmware-logic"]),
    ("stspp-hil-mcu", &["stspp-protocol", "stspp-firmware-logic", "stspp-hil-sim"]),
    ("stspp", &["stspp-protocol", "stspp-matcher", "stspp-hil-sim", "stspp-hil-mcu"]),
    ("stspp-hil-serve", &["stspp-protocol", "stspp-hil-sim", "stspp-hil-mcu"]),
    ("stspp-e2e-guest", &[]),
    ("xtask", &[]),
];

/// Checks every crate of the workspace against [`ALLOWED`].
///
/// # Errors
/// Names each arrow that should not be there, and each crate that the table does not know.
pub fn check(metadata: &Value) -> Result<String, String> {
    let ours: Vec<&Value> =
        items(metadata, "packages").filter(|package| package["source"].is_null()).collect();
    let names: Vec<&str> = ours.iter().filter_map(|package| package["name"].as_str()).collect();
    let mut wrong = Vec::new();
    let mut arrows = 0;
    for package in &ours {
        let name = package["name"].as_str().unwrap_or_default();
        let Some((_, allowed)) = ALLOWED.iter().find(|(known, _)| *known == name) else {
            wrong.push(format!("{name} is not in the table of xtask/src/arrows.rs"));
            continue;
        };
        for dependency in items(package, "dependencies") {
            let to = dependency["name"].as_str().unwrap_or_default();
            let dev = dependency["kind"] == "dev" && !allowed.is_empty();
            if !names.contains(&to) || dev || to == name {
                continue;
            }
            arrows += 1;
            if !allowed.contains(&to) {
                wrong.push(format!("{name} must not depend on {to}"));
            }
            if name == "stspp" && to.starts_with("stspp-hil") && dependency["optional"] != true {
                wrong.push(format!("{name} takes {to} by a feature only"));
            }
        }
    }
    if wrong.is_empty() {
        Ok(format!("{arrows} arrows between {} crates, all as drawn", names.len()))
    } else {
        Err(wrong.join("\n"))
    }
}

#[cfg(test)]
mod tests {
    use super::check;
    use serde_json::json;

    fn package(name: &str, dependencies: &[(&str, Option<&str>, bool)]) -> serde_json::Value {
        let dependencies: Vec<_> = dependencies
            .iter()
            .map(|(to, kind, optional)| json!({"name": to, "kind": kind, "optional": optional}))
            .collect();
        json!({"name": name, "source": null, "dependencies": dependencies})
    }

    #[test]
    fn drawn_arrows_pass_and_others_are_named() {
        let protocol = package("stspp-protocol", &[]);
        let host =
            package("stspp", &[("stspp-protocol", None, false), ("stspp-hil-sim", None, true)]);
        let sim = package("stspp-hil-sim", &[("stspp-protocol", None, false)]);
        let good = json!({"packages": [protocol, host, sim]});
        assert!(check(&good).is_ok());

        let upward = package("stspp-hil-sim", &[("stspp", None, false)]);
        let error = check(&json!({"packages": [host, upward]})).unwrap_err();
        assert!(error.contains("stspp-hil-sim must not depend on stspp"), "{error}");

        let always = package("stspp", &[("stspp-hil-sim", None, false)]);
        let error = check(&json!({"packages": [always, sim]})).unwrap_err();
        assert!(error.contains("by a feature only"), "{error}");

        let error = check(&json!({"packages": [package("stray", &[])]})).unwrap_err();
        assert!(error.contains("stray is not in the table"), "{error}");
    }
}
