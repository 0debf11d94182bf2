//! The `stspp` command line.

fn main() {}
