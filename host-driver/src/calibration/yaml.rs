//! A small YAML tree with line numbers, so that errors can name file, line and field.
//!
//! Bounded against hostile files: size, nesting and the number of nodes, aliases expanded.

use std::path::Path;

use saphyr_parser::{Event, Parser};

use super::error::{CalibrationError, FieldError};

/// Largest file that is read, in bytes: real calibrations have a few kilobytes.
const FILE_MAX_BYTES: u64 = 1 << 20;
/// Deepest nesting.
const DEPTH_MAX: usize = 16;
/// Most nodes, after aliases are expanded.
const NODES_MAX: usize = 100_000;

/// A node and the line it starts on.
#[derive(Debug, Clone)]
pub(super) struct Node {
    pub line: usize,
    pub value: Value,
}

/// Content of a node. Scalars are text: only the reader knows what type a field has.
#[derive(Debug, Clone)]
pub(super) enum Value {
    Scalar(String),
    Sequence(Vec<Node>),
    Mapping(Vec<(String, Node)>),
}

impl Node {
    fn nodes(&self) -> usize {
        1 + match &self.value {
            Value::Scalar(_) => 0,
            Value::Sequence(items) => items.iter().map(Node::nodes).sum(),
            Value::Mapping(items) => items.iter().map(|(_, node)| node.nodes()).sum(),
        }
    }

    fn depth(&self) -> usize {
        1 + match &self.value {
            Value::Scalar(_) => 0,
            Value::Sequence(items) => items.iter().map(Node::depth).max().unwrap_or(0),
            Value::Mapping(items) => items.iter().map(|(_, node)| node.depth()).max().unwrap_or(0),
        }
    }

    fn describe(&self) -> String {
        match &self.value {
            Value::Scalar(text) => format!("`{}`", text.chars().take(60).collect::<String>()),
            Value::Sequence(items) => format!("a list of {}", items.len()),
            Value::Mapping(items) => format!("a mapping of {}", items.len()),
        }
    }
}

/// A document, or a field of it, that knows its file and its full name.
#[derive(Debug, Clone)]
pub(super) struct Field<'a> {
    path: &'a Path,
    name: String,
    node: &'a Node,
}

impl<'a> Field<'a> {
    /// The whole document.
    pub fn root(path: &'a Path, node: &'a Node) -> Self {
        Self { path, name: String::new(), node }
    }

    /// An error about this field.
    pub fn error(
        &self,
        expected: impl Into<String>,
        got: impl std::fmt::Display,
    ) -> CalibrationError {
        let name = if self.name.is_empty() { "the document" } else { &self.name };
        self.wrap(FieldError::new(name, expected, got))
    }

    /// Places an error in this file, at this field's line.
    pub fn wrap(&self, error: FieldError) -> CalibrationError {
        CalibrationError::Field { path: self.path.to_owned(), line: self.node.line, error }
    }

    fn mapping(&self) -> Result<&'a [(String, Node)], CalibrationError> {
        match &self.node.value {
            Value::Mapping(items) => Ok(items),
            _ => Err(self.error("a mapping", self.node.describe())),
        }
    }

    fn child(&self, key: &str) -> String {
        if self.name.is_empty() { key.to_owned() } else { format!("{}.{key}", self.name) }
    }

    /// The field `key`, if this is a mapping that has it.
    pub fn find(&self, key: &str) -> Option<Field<'a>> {
        let Value::Mapping(items) = &self.node.value else { return None };
        let (_, node) = items.iter().find(|(name, _)| name == key)?;
        Some(Field { path: self.path, name: self.child(key), node })
    }

    /// The field `key`; `expected` says what belongs there when it is missing.
    pub fn get(&self, key: &str, expected: &str) -> Result<Field<'a>, CalibrationError> {
        self.mapping()?;
        self.find(key).ok_or_else(|| {
            self.wrap(FieldError::new(self.child(key), expected, "nothing (missing)"))
        })
    }

    /// The scalar's text.
    pub fn text(&self, expected: &str) -> Result<&'a str, CalibrationError> {
        match &self.node.value {
            Value::Scalar(text) => Ok(text),
            _ => Err(self.error(expected, self.node.describe())),
        }
    }

    /// A finite number.
    pub fn number(&self, expected: &str) -> Result<f64, CalibrationError> {
        let text = self.text(expected)?.trim();
        match text.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(self.error(expected, self.node.describe())),
        }
    }

    /// A list's items.
    pub fn items(&self, expected: &str) -> Result<Vec<Field<'a>>, CalibrationError> {
        let Value::Sequence(items) = &self.node.value else {
            return Err(self.error(expected, self.node.describe()));
        };
        Ok(items
            .iter()
            .enumerate()
            .map(|(i, node)| Field { path: self.path, name: format!("{}[{i}]", self.name), node })
            .collect())
    }

    /// A list of finite numbers.
    pub fn numbers(&self, expected: &str) -> Result<Vec<f64>, CalibrationError> {
        self.items(expected)?.iter().map(|item| item.number("a finite number")).collect()
    }

    /// A list of exactly `N` finite numbers.
    pub fn array<const N: usize>(&self, expected: &str) -> Result<[f64; N], CalibrationError> {
        let numbers = self.numbers(expected)?;
        let got = format!("{} numbers", numbers.len());
        numbers.try_into().map_err(|_| self.error(expected, got))
    }

    /// An integer in 1..=65 536, such as a size in pixels.
    pub fn size(&self, expected: &str) -> Result<usize, CalibrationError> {
        let number = self.number(expected)?;
        if (1.0..=65_536.0).contains(&number) && number.fract() == 0.0 {
            Ok(number as usize)
        } else {
            Err(self.error(expected, number))
        }
    }
}

/// Reads and parses a file.
pub(super) fn read(path: &Path) -> Result<Node, CalibrationError> {
    let failed = |source| CalibrationError::Read { path: path.to_owned(), source };
    let size = std::fs::metadata(path).map_err(failed)?.len();
    if size > FILE_MAX_BYTES {
        return Err(syntax(path, 1, 1, format!("{size} bytes, at most {FILE_MAX_BYTES} are read")));
    }
    let bytes = std::fs::read(path).map_err(failed)?;
    let text = String::from_utf8(bytes).map_err(|e| {
        let before = &e.as_bytes()[..e.utf8_error().valid_up_to()];
        let line = 1 + before.iter().filter(|&&b| b == b'\n').count();
        syntax(path, line, 1, "not UTF-8 text".into())
    })?;
    parse(path, &text)
}

fn syntax(path: &Path, line: usize, column: usize, message: String) -> CalibrationError {
    CalibrationError::Syntax { path: path.to_owned(), line, column, message }
}

/// A mapping or sequence that is being read.
struct Open {
    line: usize,
    anchor: usize,
    /// Keys and values of a mapping alternate in `items`.
    is_mapping: bool,
    items: Vec<Node>,
}

/// Parses the first document of `text`; `path` is for error messages.
pub(super) fn parse(path: &Path, text: &str) -> Result<Node, CalibrationError> {
    // OpenCV's writer heads its files with `%YAML:1.0`, which is no YAML directive.
    let text = match text.strip_prefix("%YAML:") {
        Some(rest) => rest.find('\n').map_or("", |end| &rest[end..]),
        None => text,
    };
    let mut anchors: Vec<(usize, Node)> = Vec::new();
    let mut open: Vec<Open> = Vec::new();
    let mut nodes = 0_usize;
    for event in Parser::new_from_str(text) {
        let (event, span) = event.map_err(|e| {
            syntax(path, e.marker().line(), e.marker().col() + 1, e.info().to_owned())
        })?;
        let (line, column) = (span.start.line(), span.start.col() + 1);
        let (node, anchor) = match event {
            Event::Scalar(text, _, anchor, _) => {
                (Node { line, value: Value::Scalar(text.into_owned()) }, anchor)
            }
            Event::Alias(id) => {
                let target = anchors.iter().find(|(anchor, _)| *anchor == id);
                let Some((_, node)) = target else {
                    return Err(syntax(path, line, column, "an alias without an anchor".into()));
                };
                nodes += node.nodes();
                if nodes > NODES_MAX || open.len() + node.depth() > DEPTH_MAX {
                    return Err(syntax(path, line, column, "too many or too deep nodes".into()));
                }
                (node.clone(), 0)
            }
            Event::SequenceStart(anchor, _) | Event::MappingStart(anchor, _) => {
                if open.len() >= DEPTH_MAX {
                    return Err(syntax(path, line, column, "nested too deeply".into()));
                }
                let is_mapping = matches!(event, Event::MappingStart(..));
                open.push(Open { line, anchor, is_mapping, items: Vec::new() });
                continue;
            }
            Event::SequenceEnd | Event::MappingEnd => {
                let Some(done) = open.pop() else { continue };
                let anchor = done.anchor;
                (close(path, done)?, anchor)
            }
            Event::DocumentEnd | Event::StreamEnd => break,
            Event::Nothing | Event::StreamStart | Event::DocumentStart(_) => continue,
        };
        nodes += 1;
        if nodes > NODES_MAX {
            return Err(syntax(path, line, column, "too many nodes".into()));
        }
        if anchor != 0 {
            anchors.push((anchor, node.clone()));
        }
        match open.last_mut() {
            Some(parent) => parent.items.push(node),
            None => return Ok(node),
        }
    }
    Err(syntax(path, 1, 1, "the file is empty".into()))
}

fn close(path: &Path, open: Open) -> Result<Node, CalibrationError> {
    let line = open.line;
    if !open.is_mapping {
        return Ok(Node { line, value: Value::Sequence(open.items) });
    }
    let mut items: Vec<(String, Node)> = Vec::with_capacity(open.items.len() / 2);
    let mut nodes = open.items.into_iter();
    while let (Some(key), Some(value)) = (nodes.next(), nodes.next()) {
        let Value::Scalar(name) = key.value else {
            return Err(syntax(path, key.line, 1, "a mapping's key is not text".into()));
        };
        if items.iter().any(|(other, _)| *other == name) {
            return Err(syntax(path, key.line, 1, format!("`{name}` is given twice")));
        }
        items.push((name, value));
    }
    Ok(Node { line, value: Value::Mapping(items) })
}
