//! Licences of everything that ships, against the list in deny.toml.

use crate::workspace::{self, items, root};
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
    let shipped = shipped(metadata)?;
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
///
/// By `cargo tree`, which unites the features of the crates that ship only: `cargo metadata` would
/// add what the test benches switch on.
fn shipped(metadata: &Value) -> Result<BTreeSet<&str>, String> {
    let by_name: HashMap<String, &str> = items(metadata, "packages")
        .filter_map(|package| {
            let (name, version) = (package["name"].as_str()?, package["version"].as_str()?);
            Some((format!("{name} v{version}"), package["id"].as_str()?))
        })
        .collect();
    let mut tree = workspace::cargo();
    if let Some(root) = metadata["workspace_root"].as_str() {
        tree.current_dir(root);
    }
    tree.args(["tree", "--locked", "--edges=normal,build", "--target=all"]);
    tree.args(["--prefix=none", "--no-dedupe", "--format={p}"]);
    let members: BTreeSet<&str> =
        items(metadata, "workspace_members").filter_map(Value::as_str).collect();
    for package in items(metadata, "packages") {
        let (id, name) = (package["id"].as_str(), package["name"].as_str());
        if let (Some(id), Some(name)) = (id, name)
            && members.contains(id)
            && !NOT_SHIPPED.contains(&name)
        {
            tree.arg(format!("--package={id}"));
        }
    }
    let output = tree.output().map_err(|e| format!("cargo tree could not be run: {e}"))?;
    if !output.status.success() {
        return Err(format!("cargo tree: {}", String::from_utf8_lossy(&output.stderr).trim()));
    }
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .filter(|line| !line.is_empty())
        .map(|line| {
            let name: Vec<&str> = line.split(' ').take(2).collect();
            let name = name.join(" ");
            by_name.get(&name).copied().ok_or_else(|| format!("cargo metadata lacks {name}"))
        })
        .collect()
}
