//! `stspp bench`: time per stage, and accuracy and calibration against truth.

#[cfg(feature = "sim")]
mod accuracy;
#[cfg(feature = "sim")]
mod calibration;
#[cfg(feature = "sim")]
mod check;
#[cfg(feature = "sim")]
mod compare;
mod icp;
#[cfg(feature = "sim")]
mod resampling;
mod timing;

use clap::Subcommand;

use crate::exit::Failure;
use crate::output::Output;

/// Measure time per stage (the default), accuracy, or calibration.
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
    Icp(icp::Args),
    #[cfg(feature = "sim")]
    Accuracy(accuracy::Args),
    #[cfg(feature = "sim")]
    Calibration(calibration::Args),
    #[cfg(feature = "sim")]
    Check(check::Args),
    #[cfg(feature = "sim")]
    Compare(compare::Args),
    #[cfg(feature = "sim")]
    Resampling(resampling::Args),
}

/// Runs the verb.
pub fn run(args: &Args, output: &Output) -> Result<(), Failure> {
    match &args.what {
        Some(What::Icp(args)) => icp::run(args, output),
        #[cfg(feature = "sim")]
        Some(What::Accuracy(args)) => accuracy::run(args, output),
        #[cfg(feature = "sim")]
        Some(What::Calibration(args)) => calibration::run(args, output),
        #[cfg(feature = "sim")]
        Some(What::Check(args)) => check::run(args, output),
        #[cfg(feature = "sim")]
        Some(What::Compare(args)) => compare::run(args, output),
        #[cfg(feature = "sim")]
        Some(What::Resampling(args)) => resampling::run(args, output),
        None => timing::run(&args.timing, output),
    }
}
