//! docs/protocol-reference.md from the protocol's types: what each message carries, in the order of its
//! bytes, with the documentation that stands above each field.

use std::fs;

use syn::{Attribute, Expr, ExprLit, Fields, Item, Lit, Meta, Type};

use crate::workspace;

const PATH: &str = "docs/protocol-reference.md";
/// Files in the order of the reference, with their titles.
const FILES: [(&str, &str); 6] = [
    ("request", "Requests"),
    ("reply", "Replies"),
    ("event", "Events"),
    ("timing", "Timing"),
    ("fault", "Faults"),
    ("version", "Versions"),
];

/// Writes the reference.
///
/// # Errors
/// When a source cannot be parsed or the file not be written.
pub fn write() -> Result<String, String> {
    let text = generate()?;
    fs::write(workspace::root().join(PATH), text).map_err(|e| format!("{PATH}: {e}"))?;
    Ok(format!("{PATH} written"))
}

/// Whether the reference is what the types say now.
///
/// # Errors
/// When it is not.
pub fn check() -> Result<(), String> {
    let is = fs::read_to_string(workspace::root().join(PATH)).unwrap_or_default();
    if is == generate()? {
        return Ok(());
    }
    Err(format!("{PATH} is not what the types say: run cargo xtask protocol-reference"))
}

fn generate() -> Result<String, String> {
    let mut text = String::from(
        "# Protocol reference\n\nWhat every message carries, in the order of its bytes. This page is \
         generated from the types by `cargo xtask protocol-reference`; [Protocol](protocol.md) has the \
         framing, the message table and the rules. Integers wider than a byte are varints (signed ones \
         zig-zag), `Option` is a tag byte and the value, lists are a varint length and the items, an enum \
         is the varint of its variant's number.\n",
    );
    for (file, title) in FILES {
        let path = workspace::root().join(format!("protocol/src/{file}.rs"));
        let source = fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
        let parsed = syn::parse_file(&source).map_err(|e| format!("{}: {e}", path.display()))?;
        text += &format!("\n## {title}\n");
        for item in &parsed.items {
            match item {
                Item::Struct(item) if is_sent(&item.attrs) => {
                    text += &heading(&item.ident.to_string(), &item.attrs);
                    text += &fields(&item.fields);
                }
                Item::Enum(item) if is_sent(&item.attrs) => {
                    text += &heading(&item.ident.to_string(), &item.attrs);
                    text += "\n| Number | Variant | Meaning |\n|---:|---|---|\n";
                    for (number, variant) in item.variants.iter().enumerate() {
                        let name = format!("{}{}", variant.ident, carried(&variant.fields));
                        let meaning = cell(&doc(&variant.attrs));
                        text += &format!("| {number} | `{name}` | {meaning} |\n");
                    }
                }
                _ => {}
            }
        }
    }
    Ok(text)
}

/// Whether a type goes over the wire.
fn is_sent(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let Meta::List(list) = &attribute.meta else { return false };
        list.path.is_ident("derive") && list.tokens.to_string().contains("Serialize")
    })
}

fn heading(name: &str, attributes: &[Attribute]) -> String {
    format!("\n### {name}\n\n{}\n", paragraphs(&doc(attributes)))
}

fn fields(fields: &Fields) -> String {
    if fields.is_empty() {
        return "\nCarries nothing.\n".into();
    }
    let mut text = String::from("\n| Field | Type | Meaning |\n|---|---|---|\n");
    for (number, field) in fields.iter().enumerate() {
        let name = field.ident.as_ref().map_or_else(|| number.to_string(), ToString::to_string);
        let meaning = cell(&doc(&field.attrs));
        text += &format!("| `{name}` | `{}` | {meaning} |\n", shown(&field.ty));
    }
    text
}

/// What a variant carries, as in Rust.
fn carried(fields: &Fields) -> String {
    let one = |field: &syn::Field| {
        let name = field.ident.as_ref().map_or(String::new(), |name| format!("{name}: "));
        format!("{name}{}", shown(&field.ty))
    };
    let list: Vec<String> = fields.iter().map(one).collect();
    match fields {
        Fields::Unit => String::new(),
        Fields::Unnamed(_) => format!("({})", list.join(", ")),
        Fields::Named(_) => format!(" {{ {} }}", list.join(", ")),
    }
}

fn shown(kind: &Type) -> String {
    let tokens = quote::ToTokens::to_token_stream(kind).to_string();
    let mut text = tokens.replace(" , ", ", ");
    for (spaced, tight) in [(" < ", "<"), (" >", ">"), ("< ", "<"), (" :: ", "::"), (" ;", ";")] {
        text = text.replace(spaced, tight);
    }
    text
}

/// The documentation above an item, without links to other items.
fn doc(attributes: &[Attribute]) -> String {
    let lines: Vec<String> = attributes
        .iter()
        .filter_map(|attribute| match &attribute.meta {
            Meta::NameValue(pair) if pair.path.is_ident("doc") => match &pair.value {
                Expr::Lit(ExprLit { lit: Lit::Str(text), .. }) => Some(text.value()),
                _ => None,
            },
            _ => None,
        })
        .collect();
    unlinked(&lines.join("\n"))
}

/// `[text](target)` and `[text]` become the text: the targets are Rust's.
fn unlinked(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("[`") {
        let Some((name, tail)) = after.split_once("`]") else { break };
        out += before;
        out += &format!("`{name}`");
        rest = match tail.strip_prefix('(').and_then(|t| t.split_once(')')) {
            Some((_, tail)) => tail,
            None => tail,
        };
    }
    out + rest
}

fn paragraphs(text: &str) -> String {
    text.lines().map(str::trim).collect::<Vec<_>>().join("\n").trim().to_owned()
}

fn cell(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "\\|")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_and_links_are_shown_for_people() {
        let kind: Type = syn::parse_str("Option<heapless::Vec<u16, 32>>").unwrap();
        assert_eq!(shown(&kind), "Option<heapless::Vec<u16, 32>>");
        assert_eq!(
            unlinked("see [`A`](crate::A) and [`B`], a\n[`C`]."),
            "see `A` and `B`, a\n`C`."
        );
    }

    #[test]
    fn every_message_is_in_the_reference() {
        let text = generate().unwrap();
        for name in ["Hello", "SetTiming", "TriggerEvent", "ProjectionTiming", "FaultReason"] {
            assert!(text.contains(&format!("\n### {name}\n")), "{name}");
        }
        assert!(text.contains("| `host` | `ProtocolVersion` |"));
    }
}
