//! `stspp bench`: time per stage, and accuracy against truth.

mod accuracy;

use clap::Subcommand;

use crate::exit::Failure;
use crate::output::Output;

/// Measure time per stage, or accuracy.
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Accuracy(accuracy::Args),
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    match &args.what {
        What::Accuracy(args) => accuracy::run(args, output),
    }
}
