//! `stspp completions`: completions for a shell.

use clap::CommandFactory;

use crate::exit::Failure;

/// Print completions for a shell, to be put where it looks for them.
#[derive(clap::Args)]
pub struct Args {
    /// The shell.
    shell: clap_complete::Shell,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result<(), Failure> {
    let mut text = Vec::new();
    clap_complete::generate(args.shell, &mut crate::Cli::command(), "stspp", &mut text);
    print!("{}", String::from_utf8_lossy(&text));
    Ok(())
}
