//! Licences of everything that ships, against the list in deny.toml.

use crate::workspace::{items, root};
use serde_json::Value;
use std::collections::{BTreeSet, HashMap};

/// Test benches: they run here and never leave as part of the product. deny.toml names the crates of
/// theirs that are under other licences.
const NOT_SHIPPED: &[&str] = &["stspp-hil-mcu"];

/// Checks the licences of all crates that our crates link, build scripts included, tests not.
///
/// # Errors
/// Names each crate whose licence is not allowed or not stated, and what it states.
pub fn check(metadata: &Value) -> Result<String, String> {
    let allowed = allowed()?;
    let packages: HashMap<&str, &Value> = items(metadata, "packages")
        .filter_map(|package| Some((package["id"].as_str()?, package)))
        .collect();
    let mut wrong = Vec::new();
    let shipped = shipped(metadata);
    for id in &shipped {
        let package = packages.get(id).ok_or_else(|| format!("cargo metadata lacks {id}"))?;
        let (name, version) = (&package["name"], &package["version"]);
        let stated = package["license"].as_str().unwrap_or_default();
        // Old manifests write "MIT/Apache-2.0" for "MIT OR Apache-2.0".
        match spdx::Expression::parse_mode(stated, spdx::ParseMode::LAX) {
            Ok(expression) => {
                if !expression.evaluate(|licence| allowed.contains(&licence.to_string())) {
                    wrong.push(format!("{name} {version}: {stated} is not allowed by deny.toml"));
                }
            }
            Err(_) => wrong.push(format!("{name} {version}: unreadable licence \"{stated}\"")),
        }
    }
    if wrong.is_empty() {
        Ok(format!("{} crates, all under licences that deny.toml allows", shipped.len()))
    } else {
        Err(wrong.join("\n"))
    }
}

/// The allowed licences as SPDX expressions.
fn allowed() -> Result<BTreeSet<String>, String> {
    let path = root().join("deny.toml");
    let text = std::fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
    let table: toml::Table = text.parse().map_err(|e| format!("deny.toml: {e}"))?;
    let list =
        table["licenses"]["allow"].as_array().ok_or("deny.toml: licenses.allow is no list")?;
    Ok(list.iter().filter_map(|licence| licence.as_str().map(str::to_owned)).collect())
}

/// Ids of the crates reachable from ours over normal and build dependencies.
fn shipped(metadata: &Value) -> BTreeSet<&str> {
    let nodes: HashMap<&str, &Value> = items(&metadata["resolve"], "nodes")
        .filter_map(|node| Some((node["id"].as_str()?, node)))
        .collect();
    let bench = |id: &str| {
        items(metadata, "packages")
            .any(|p| p["id"] == id && NOT_SHIPPED.iter().any(|name| p["name"] == *name))
    };
    let mut pending: Vec<&str> = items(metadata, "workspace_members")
        .filter_map(Value::as_str)
        .filter(|id| !bench(id))
        .collect();
    let mut reached = BTreeSet::new();
    while let Some(id) = pending.pop() {
        if !reached.insert(id) {
            continue;
        }
        let Some(node) = nodes.get(id) else { continue };
        for dependency in items(node, "deps") {
            let ships = items(dependency, "dep_kinds").any(|kind| kind["kind"] != "dev");
            if let (true, Some(to)) = (ships, dependency["pkg"].as_str()) {
                pending.push(to);
            }
        }
    }
    reached
}
