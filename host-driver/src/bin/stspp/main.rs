//! The `stspp` command line: one file per verb.

mod bench;
mod calibrate;
mod capture;
mod check;
mod completions;
#[cfg(feature = "sim")]
mod demo;
#[cfg(target_os = "linux")]
mod doctor;
#[allow(dead_code, reason = "the table of exit codes is whole, whoever uses it")]
mod exit;
#[cfg(feature = "sim")]
mod experiment;
mod frame_report;
mod fuse;
mod info;
mod interrupt;
mod list;
mod measure;
mod output;
mod reconstruct;
mod record;
mod source;
mod stream;
mod timing;

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
#[command(rename_all = "kebab-case")]
enum Verb {
    List(list::Args),
    Info(info::Args),
    #[cfg(target_os = "linux")]
    Doctor(doctor::Args),
    #[cfg(feature = "sim")]
    Demo(demo::Args),
    Reconstruct(reconstruct::Args),
    Timing(timing::Args),
    Stream(stream::Args),
    Capture(capture::Args),
    Record(record::Args),
    Play(stream::PlayArgs),
    Calibrate(Box<calibrate::Args>),
    Check(check::Args),
    Measure(measure::Args),
    Fuse(fuse::Args),
    #[cfg(feature = "sim")]
    Experiment(experiment::Args),
    Bench(bench::Args),
    Completions(completions::Args),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let output = Output { json: cli.json, quiet: cli.quiet };
    interrupt::install();
    let result: Result<(), Failure> = match cli.verb {
        Verb::List(args) => list::run(&args, &output),
        Verb::Info(args) => info::run(&args, &output),
        #[cfg(target_os = "linux")]
        Verb::Doctor(args) => doctor::run(&args, &output),
        #[cfg(feature = "sim")]
        Verb::Demo(args) => demo::run(&args, &output),
        Verb::Reconstruct(args) => reconstruct::run(&args, &output),
        Verb::Timing(args) => timing::run(&args, &output),
        Verb::Stream(args) => stream::run(&args, &output),
        Verb::Capture(args) => capture::run(&args, &output),
        Verb::Record(args) => record::run(&args, &output),
        Verb::Play(args) => stream::play(&args, &output),
        Verb::Calibrate(args) => calibrate::run(&args, &output),
        Verb::Check(args) => check::run(&args, &output),
        Verb::Measure(args) => measure::run(&args, &output),
        Verb::Fuse(args) => fuse::run(&args, &output),
        #[cfg(feature = "sim")]
        Verb::Experiment(args) => experiment::run(&args, &output),
        Verb::Bench(args) => bench::run(&args, &output),
        Verb::Completions(args) => completions::run(&args),
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
