//! `frames.json`: what lit each pair of a recording, and when.
//!
//! ```json
//! {
//!   "version": 1,
//!   "bits": 8,
//!   "frames": [
//!     { "sequence": 0, "slot": 0, "projector_mask": 1, "floodlight": false,
//!       "trigger_time_us": 1000000, "exposure_us": 32000 }
//!   ]
//! }
//! ```
//!
//! One entry a pair, in order; where `sequence` jumps, pairs were lost while it was recorded. Fields that are left out take the pair's number (`sequence`, `slot`),
//! 0 or false; other fields are ignored, so that programs can add their own.

use std::path::Path;

use serde_json::{Map, Value, json};

use super::RecordingError;
use crate::SlotLabel;

/// Largest file that is read, in bytes: 100 000 frames.
const FILE_MAX_BYTES: u64 = 32 << 20;

/// Content of `frames.json`.
#[derive(Debug, Clone, PartialEq)]
pub struct FramesInfo {
    /// Significant bits of a pixel, where stated.
    pub bits: Option<u8>,
    /// One label a pair.
    pub labels: Vec<SlotLabel>,
}

/// Reads `frames.json` for a recording of `pairs`; `None` when there is no such file.
///
/// # Errors
/// Names the field and what was expected.
pub fn read(path: &Path, pairs: usize) -> Result<Option<FramesInfo>, RecordingError> {
    let size = match std::fs::metadata(path) {
        Ok(metadata) => metadata.len(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(source) => {
            return Err(RecordingError::Folder {
                path: path.to_owned(),
                expected: "a readable file",
                source,
            });
        }
    };
    if size > FILE_MAX_BYTES {
        return Err(error(path, "the file", format!("at most {FILE_MAX_BYTES} bytes"), size));
    }
    let text = std::fs::read(path).map_err(|source| RecordingError::Folder {
        path: path.to_owned(),
        expected: "a readable file",
        source,
    })?;
    parse(path, &text, pairs).map(Some)
}

fn error(
    path: &Path,
    field: impl Into<String>,
    expected: impl Into<String>,
    got: impl ToString,
) -> RecordingError {
    RecordingError::Labels {
        path: path.to_owned(),
        field: field.into(),
        expected: expected.into(),
        got: got.to_string(),
    }
}

/// Parses the text of a `frames.json`; `path` is for error messages.
///
/// # Errors
/// Names the field and what was expected.
pub fn parse(path: &Path, text: &[u8], pairs: usize) -> Result<FramesInfo, RecordingError> {
    let root: Value =
        serde_json::from_slice(text).map_err(|e| error(path, "the file", "JSON", e))?;
    let Value::Object(root) = &root else {
        return Err(error(path, "the file", "an object with `frames`", kind(&root)));
    };
    if let Some(version) = root.get("version").filter(|v| v.as_u64() != Some(1)) {
        return Err(error(path, "version", "1", version));
    }
    let bits = match root.get("bits") {
        None => None,
        Some(value) => match value.as_u64().and_then(|bits| u8::try_from(bits).ok()) {
            Some(bits @ 8..=16) => Some(bits),
            _ => return Err(error(path, "bits", "8 to 16", value)),
        },
    };
    let Some(Value::Array(frames)) = root.get("frames") else {
        let got = root.get("frames").map_or("nothing (missing)", kind);
        return Err(error(path, "frames", "a list with one entry per pair", got));
    };
    if frames.len() != pairs {
        let expected = format!("one entry per pair of images ({pairs})");
        return Err(error(path, "frames", expected, format!("{} entries", frames.len())));
    }
    let labels: Vec<SlotLabel> = frames
        .iter()
        .enumerate()
        .map(|(index, frame)| label(path, index, frame))
        .collect::<Result<_, _>>()?;
    for (index, pair) in labels.windows(2).enumerate() {
        let field = |name: &str| format!("frames[{}].{name}", index + 1);
        // Pairs may have been lost while it was recorded, but none comes twice or too early.
        if pair[0].sequence >= pair[1].sequence {
            let expected = format!("more than {}", pair[0].sequence);
            return Err(error(path, field("sequence"), expected, pair[1].sequence));
        }
        if pair[1].trigger_time_us < pair[0].trigger_time_us {
            let expected = format!("a time not before {} us", pair[0].trigger_time_us);
            return Err(error(path, field("trigger_time_us"), expected, pair[1].trigger_time_us));
        }
    }
    Ok(FramesInfo { bits, labels })
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "true or false",
        Value::Number(_) => "a number",
        Value::String(_) => "text",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}

fn label(path: &Path, index: usize, frame: &Value) -> Result<SlotLabel, RecordingError> {
    let Value::Object(frame) = frame else {
        return Err(error(path, format!("frames[{index}]"), "an object", kind(frame)));
    };
    let integer =
        |frame: &Map<String, Value>, name: &str, default: u64, max: u64| match frame.get(name) {
            None => Ok(default),
            Some(value) => value.as_u64().filter(|v| *v <= max).ok_or_else(|| {
                let field = format!("frames[{index}].{name}");
                error(path, field, format!("an integer of 0 to {max}"), value)
            }),
        };
    let floodlight = match frame.get("floodlight") {
        None => false,
        Some(Value::Bool(on)) => *on,
        Some(value) => {
            let field = format!("frames[{index}].floodlight");
            return Err(error(path, field, "true or false", value));
        }
    };
    let (number, u16_max, u32_max) = (index as u64, u64::from(u16::MAX), u64::from(u32::MAX));
    Ok(SlotLabel {
        sequence: integer(frame, "sequence", number, u32_max)? as u32,
        slot: integer(frame, "slot", number.min(u16_max), u16_max)? as u16,
        projector_mask: integer(frame, "projector_mask", 0, u16_max)? as u16,
        floodlight,
        trigger_time_us: integer(frame, "trigger_time_us", 0, u64::MAX)?,
        exposure_us: integer(frame, "exposure_us", 0, u32_max)? as u32,
    })
}

/// Text of a `frames.json`.
pub fn to_text(info: &FramesInfo) -> String {
    let mut root = json!({ "version": 1, "frames": info.labels });
    if let Some(bits) = info.bits {
        root["bits"] = json!(bits);
    }
    format!("{root:#}\n")
}
