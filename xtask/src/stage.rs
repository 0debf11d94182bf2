//! One stage of the test command: a command or a check, timed, with its outcome.

use std::process::Command;
use std::time::{Duration, Instant};

/// How a stage ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// It held; what it said, if anything.
    Passed(String),
    /// It did not; why.
    Failed(String),
    /// It was not run; why, and what to do about it.
    Skipped(String),
}

/// A stage that has ended.
#[derive(Debug, Clone)]
pub struct Stage {
    /// Its name.
    pub name: &'static str,
    /// How it ended.
    pub outcome: Outcome,
    /// How long it took.
    pub took: Duration,
}

/// Runs `work` as the stage `name`.
pub fn run(name: &'static str, work: impl FnOnce() -> Outcome) -> Stage {
    println!("\n=== {name}");
    let start = Instant::now();
    let outcome = work();
    let stage = Stage { name, outcome, took: start.elapsed() };
    println!("--- {}", line(&stage));
    stage
}

/// Runs a command with its output shown; the stage holds when it exits with 0.
pub fn command(mut command: Command) -> Outcome {
    match command.status() {
        Ok(status) if status.success() => Outcome::Passed(String::new()),
        Ok(status) => Outcome::Failed(format!("{command:?} ended with {status}")),
        Err(e) => Outcome::Failed(format!("{command:?} could not be run: {e}")),
    }
}

/// The outcome of a check that is a function.
pub fn check(result: Result<String, String>) -> Outcome {
    match result {
        Ok(said) => Outcome::Passed(said),
        Err(why) => Outcome::Failed(why),
    }
}

/// One line for the closing table.
pub fn line(stage: &Stage) -> String {
    let (word, text) = match &stage.outcome {
        Outcome::Passed(text) => ("passed", text),
        Outcome::Failed(text) => ("FAILED", text),
        Outcome::Skipped(text) => ("skipped", text),
    };
    let seconds = stage.took.as_secs_f64();
    format!("{:<24} {word:<8} {seconds:>7.1} s  {text}", stage.name).trim_end().to_owned()
}
