//! The book under docs/: every chapter listed, every link going somewhere, the generated reference
//! current, and mdBook content with it where it is installed.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::{protocol_reference, workspace};

/// Checks the book, and builds it into target/book when mdBook is there.
///
/// # Errors
/// Names every chapter that is missing or not listed, and every link that goes nowhere.
pub fn run() -> Result<String, String> {
    let docs = workspace::root().join("docs");
    let summary = read(&docs.join("SUMMARY.md"))?;
    let mut wrong = Vec::new();
    let listed: BTreeSet<String> = links(&summary).into_iter().map(|l| l.target).collect();
    for chapter in listed.iter().filter(|chapter| !docs.join(chapter).is_file()) {
        wrong.push(format!("docs/SUMMARY.md lists {chapter}, which is not there"));
    }
    let chapters = chapters(&docs)?;
    for chapter in chapters.iter().filter(|chapter| !listed.contains(*chapter)) {
        wrong.push(format!("docs/{chapter} is in no line of docs/SUMMARY.md"));
    }
    let mut count = 0;
    for chapter in &chapters {
        let text = read(&docs.join(chapter))?;
        for link in links(&text) {
            count += 1;
            if let Err(why) = resolves(&docs, chapter, &text, &link.target) {
                wrong.push(format!("docs/{chapter}:{}: {why}", link.line));
            }
        }
    }
    if let Err(why) = protocol_reference::check() {
        wrong.push(why);
    }
    if !wrong.is_empty() {
        return Err(wrong.join("\n"));
    }
    let built = build(&docs)?;
    Ok(format!("{} chapters, {count} links; {built}", chapters.len()))
}

fn build(docs: &Path) -> Result<String, String> {
    let out = workspace::root().join("target/book");
    match Command::new("mdbook").arg("build").arg(docs).arg("-d").arg(&out).status() {
        Ok(status) if status.success() => Ok("built into target/book".into()),
        Ok(status) => Err(format!("mdbook build ended with {status}")),
        Err(_) => Ok("not built: no mdbook here (cargo install mdbook)".into()),
    }
}

fn read(path: &Path) -> Result<String, String> {
    fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))
}

/// All Markdown files of the folder but the table of contents.
fn chapters(docs: &Path) -> Result<Vec<String>, String> {
    let entries = fs::read_dir(docs).map_err(|e| format!("{}: {e}", docs.display()))?;
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| name.ends_with(".md") && name != "SUMMARY.md")
        .collect();
    names.sort();
    Ok(names)
}

struct Link {
    line: usize,
    target: String,
}

/// The targets of `[text](target)` outside of code.
fn links(text: &str) -> Vec<Link> {
    let mut found = Vec::new();
    let mut in_fence = false;
    for (number, line) in text.lines().enumerate() {
        if line.trim_start().starts_with("```") {
            in_fence = !in_fence;
        }
        if in_fence {
            continue;
        }
        // Code within a line: every second part between back-quotes.
        let prose: String = line
            .split('`')
            .enumerate()
            .map(|(k, part)| if k % 2 == 0 { part } else { "x" })
            .collect();
        for part in prose.split("](").skip(1) {
            if let Some((target, _)) = part.split_once(')') {
                let target = target.split_whitespace().next().unwrap_or("").to_owned();
                found.push(Link { line: number + 1, target });
            }
        }
    }
    found
}

fn resolves(docs: &Path, chapter: &str, own: &str, target: &str) -> Result<(), String> {
    if ["http://", "https://", "mailto:"].iter().any(|scheme| target.starts_with(scheme)) {
        return Ok(());
    }
    let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
    let path: PathBuf = docs.join(if file.is_empty() { chapter } else { file });
    if !path.exists() {
        return Err(format!("the link to {target} goes nowhere"));
    }
    if anchor.is_empty() || path.extension().is_none_or(|e| e != "md") {
        return Ok(());
    }
    let text = if file.is_empty() { own.to_owned() } else { read(&path)? };
    let has = text.lines().filter(|l| l.starts_with('#')).any(|l| slug(l) == anchor);
    if has { Ok(()) } else { Err(format!("{target}: there is no such heading")) }
}

/// A heading's anchor, as mdBook makes it.
fn slug(heading: &str) -> String {
    heading
        .trim_start_matches('#')
        .trim()
        .to_lowercase()
        .chars()
        .filter_map(|c| match c {
            c if c.is_alphanumeric() || c == '_' || c == '-' => Some(c),
            c if c.is_whitespace() => Some('-'),
            _ => None,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_in_code_are_none() {
        let text = "[a](b.md) `[c](d.md)`\n```\n[e](f.md)\n```\n![g](h.png \"title\") [i](#j)";
        let targets: Vec<_> = links(text).into_iter().map(|l| (l.line, l.target)).collect();
        let expected = [(1, "b.md"), (5, "h.png"), (5, "#j")];
        assert_eq!(targets, expected.map(|(line, target)| (line, target.to_owned())));
    }

    #[test]
    fn links_that_go_nowhere_are_told() {
        let docs = workspace::root().join("docs");
        let text = "# A heading: `code`, more\n";
        let to = |target| resolves(&docs, "cli.md", text, target);
        assert!(to("cli.md").is_ok() && to("../Cargo.toml").is_ok() && to("https://x.y").is_ok());
        assert!(to("#a-heading-code-more").is_ok());
        assert!(to("nowhere.md").is_err() && to("#nowhere").is_err());
    }
}
