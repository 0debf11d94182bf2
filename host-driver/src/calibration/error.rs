//! What can be wrong with a calibration.

use std::path::PathBuf;

/// A value that a calibration cannot have.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field}: expected {expected}, got {got}")]
pub struct FieldError {
    /// The field, as it is called in Kalibr's camchain.yaml.
    pub field: String,
    /// What it has to be.
    pub expected: String,
    /// What it is.
    pub got: String,
}

impl FieldError {
    /// A wrong value of `field`.
    pub fn new(
        field: impl Into<String>,
        expected: impl Into<String>,
        got: impl std::fmt::Display,
    ) -> Self {
        Self { field: field.into(), expected: expected.into(), got: got.to_string() }
    }
}

/// Why a calibration file could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is not YAML.
    #[error("{}:{line}:{column}: not valid YAML: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// What the parser says.
        message: String,
    },
    /// A field is missing, of another type, or physically impossible.
    #[error("{}:{line}: {error}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// Line of the field (of its parent where it is missing), from 1.
        line: usize,
        /// Field, expectation and value.
        error: FieldError,
    },
}
