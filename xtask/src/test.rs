//! `cargo xtask test`: everything that is proven, in stages, each of which runs even when an earlier
//! one failed, so that one run shows all that is wrong.

use crate::stage::{self, Outcome, Stage};
use crate::{arrows, book, e2e, firmware, kernels, licences, workspace};
use std::process::{Command, ExitCode};

/// How much to test.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Depth {
    /// Only what needs nothing but Rust and a C compiler.
    Quick,
    /// Also the stages that need Debian packages.
    Full,
}

fn cargo(arguments: &[&str]) -> Command {
    let mut command = workspace::cargo();
    command.args(arguments);
    command
}

/// Runs all stages and prints the closing table; fails when a stage did.
pub fn run(depth: Depth) -> ExitCode {
    let metadata = workspace::metadata();
    let with_metadata = |check: fn(&serde_json::Value) -> Result<String, String>| {
        stage::check(metadata.as_ref().map_err(String::clone).and_then(check))
    };
    let stages: Vec<Stage> = vec![
        stage::run("formatting", || stage::command(cargo(&["fmt", "--all", "--check"]))),
        stage::run("dependency arrows", || with_metadata(arrows::check)),
        stage::run("licences", || with_metadata(licences::check)),
        stage::run("book", || stage::check(book::run())),
        stage::run("lints", || {
            stage::command(cargo(&[
                "clippy",
                "--locked",
                "--workspace",
                "--all-targets",
                "--",
                "-D",
                "warnings",
            ]))
        }),
        stage::run("documentation", || {
            let mut doc = cargo(&["doc", "--locked", "--workspace", "--no-deps"]);
            doc.env("RUSTDOCFLAGS", "-D warnings");
            stage::command(doc)
        }),
        stage::run("firmware arithmetic", || stage::check(firmware::run(&["--test"]))),
        // Before the tests: those of the emulated chip run its ELFs.
        stage::run("firmware", || match depth {
            Depth::Quick => Outcome::Skipped("left out by --quick".into()),
            Depth::Full => firmware::stage(),
        }),
        stage::run("emulated sensor", || match depth {
            Depth::Quick => Outcome::Skipped("left out by --quick".into()),
            Depth::Full if !firmware::images_are_there() => {
                Outcome::Skipped("there is no firmware to run: see the stage before".into())
            }
            Depth::Full => stage::command(cargo(&[
                "test",
                "--locked",
                "--package=stspp",
                "--features=mcu",
                "--test=emulated_chip",
                "--",
                "--nocapture",
            ])),
        }),
        stage::run("tests", || {
            stage::command(cargo(&["test", "--locked", "--workspace", "--no-fail-fast"]))
        }),
    ];
    let deeper: Vec<Stage> =
        DEEPER.map(|(name, work)| stage::run(name, || full(depth, work))).into();
    summarise(&[stages, deeper].concat())
}

/// A stage's name and work.
type Named = (&'static str, fn() -> Outcome);

/// What needs Debian packages beyond the firmware's.
const DEEPER: [Named; 4] = [("Linux guest", e2e::stage), KERNELS[0], KERNELS[1], KERNELS[2]];

/// The kernels beyond their tests.
const KERNELS: [Named; 3] = [
    ("memory check", kernels::memory_check),
    ("instruction counts", kernels::instruction_counts),
    ("NEON kernels", kernels::aarch64),
];

/// Runs those stages alone.
pub fn kernels() -> ExitCode {
    summarise(&KERNELS.map(|(name, work)| stage::run(name, work)))
}

/// A stage that needs Debian packages.
fn full(depth: Depth, stage: fn() -> Outcome) -> Outcome {
    match depth {
        Depth::Quick => Outcome::Skipped("left out by --quick".into()),
        Depth::Full => stage(),
    }
}

fn summarise(stages: &[Stage]) -> ExitCode {
    println!("\n=== summary");
    for stage in stages {
        println!("{}", stage::line(stage));
    }
    let count = |wanted: fn(&Outcome) -> bool| stages.iter().filter(|s| wanted(&s.outcome)).count();
    let failed = count(|o| matches!(o, Outcome::Failed(_)));
    println!(
        "{} passed, {failed} failed, {} skipped",
        count(|o| matches!(o, Outcome::Passed(_))),
        count(|o| matches!(o, Outcome::Skipped(_))),
    );
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
