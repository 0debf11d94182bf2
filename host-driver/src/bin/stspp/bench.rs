//! `stspp bench`: time per stage, and accuracy against truth.

#[cfg(feature = "sim")]
mod accuracy;
mod timing;

use clap::Subcommand;

use crate::exit::Failure;
use crate::output::Output;

/// Measure time per stage (the default), or accuracy.
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Args {
    #[command(subcommand)]
    what: Option<What>,
    #[command(flatten)]
    timing: timing::Args,
}

#[derive(Subcommand)]
enum What {
    #[cfg(feature = "sim")]
    Accuracy(accuracy::Args),
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    match &args.what {
        #[cfg(feature = "sim")]
        Some(What::Accuracy(args)) => accuracy::run(args, output),
        #[cfg(not(feature = "sim"))]
        Some(_) => Ok(()),
        None => timing::run(&args.timing, output),
    }
}
