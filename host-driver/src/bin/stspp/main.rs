//! The `stspp` command line: one file per verb.

mod bench;
#[allow(dead_code)]
mod exit;
#[allow(dead_code)]
mod output;
mod reconstruct;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::exit::Failure;
use crate::output::Output;

/// 3D imaging by spatial-temporal speckle projection.
#[derive(Parser)]
#[command(name = "stspp", version, after_help = exit::TABLE)]
struct Cli {
    /// Print the result as one JSON object on standard output.
    #[arg(long, global = true)]
    json: bool,
    /// No progress on standard error.
    #[arg(long, short, global = true)]
    quiet: bool,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    Reconstruct(reconstruct::Args),
    Bench(bench::Args),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let output = Output { json: cli.json, quiet: cli.quiet };
    let result: Result<(), Failure> = match cli.verb {
        Verb::Reconstruct(args) => reconstruct::run(&args, &output),
        Verb::Bench(args) => bench::run(&args, &output),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("error: {failure}");
            failure.code()
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn arguments_do_not_contradict_each_other() {
        super::Cli::command().debug_assert();
    }
}
