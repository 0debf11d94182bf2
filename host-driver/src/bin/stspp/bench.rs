//! `stspp bench`: time per stage, and accuracy against truth.
use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Measure time per stage, or accuracy.
#[derive(clap::Args)]
pub struct Args {}

/// Runs the verb.
pub fn run(_args: &Args, _output: &Output) -> Result<(), Failure> {
    Err(Failure::new(Kind::Other, "bench is not in this build"))
}
