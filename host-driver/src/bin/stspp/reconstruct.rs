//! `stspp reconstruct`: depth from a recording folder.
use std::path::PathBuf;

use crate::exit::{Failure, Kind};
use crate::output::Output;

/// Compute depth image and point cloud of a recording folder.
#[derive(clap::Args)]
pub struct Args {
    /// Recording: camchain.yaml, left/00.png ..., right/00.png ...
    folder: PathBuf,
}

/// Runs the verb.
pub fn run(args: &Args, _output: &Output) -> Result<(), Failure> {
    if !args.folder.is_dir() {
        return Err(Failure::new(
            Kind::Input,
            format!("{}: no such folder", args.folder.display()),
        )
        .remedy("give a recording folder"));
    }
    Err(Failure::new(Kind::Other, "reconstruct is not in this build"))
}
