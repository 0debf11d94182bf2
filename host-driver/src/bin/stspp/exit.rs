//! Exit codes, and the one line that a failing verb prints.

use std::fmt;
use std::process::ExitCode;

/// Shown below `stspp --help`.
pub const TABLE: &str = "\
Exit codes:
  0    done
  1    failed in a way that no other code names
  2    wrong usage of the command line
  3    an input (file, folder, calibration, parameter) is wrong
  4    an output could not be written; nothing was left behind
  5    the sensor: not found, busy, not permitted, silent or at fault
  6    done, but a stated limit was missed
  130  interrupted";

/// Class of a failure; its value is the exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// None of the others.
    Other = 1,
    /// Wrong usage that clap cannot see.
    Usage = 2,
    /// An input is wrong.
    Input = 3,
    /// An output could not be written.
    Output = 4,
    /// Something with the sensor.
    Sensor = 5,
    /// A stated limit was missed.
    Limit = 6,
    /// Ctrl-C.
    Interrupted = 130,
}

/// Why a verb failed and what the user can do.
#[derive(Debug)]
pub struct Failure {
    kind: Kind,
    message: String,
    remedy: Option<String>,
}

impl Failure {
    /// A failure of class `kind`; `message` says what was wrong with which file or field.
    pub fn new(kind: Kind, message: impl fmt::Display) -> Self {
        Self { kind, message: message.to_string(), remedy: None }
    }

    /// Adds what to do about it.
    pub fn remedy(mut self, remedy: impl fmt::Display) -> Self {
        self.remedy = Some(remedy.to_string());
        self
    }

    /// The process's exit code.
    pub fn code(&self) -> ExitCode {
        ExitCode::from(self.kind as u8)
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // One line, whatever an error text from below contains.
        let mut line = self.message.clone();
        if let Some(remedy) = &self.remedy {
            line = format!("{line}; {remedy}");
        }
        f.write_str(&line.split_whitespace().collect::<Vec<_>>().join(" "))
    }
}
