//! Build and test tasks: `cargo xtask help`.

mod arrows;
mod book;
mod debian;
mod e2e;
mod firmware;
mod kernels;
mod licences;
mod peers;
mod protocol_reference;
mod stage;
mod test;
mod workspace;

use std::process::ExitCode;

const HELP: &str = "\
cargo xtask test [--quick]   everything that is proven: formatting, lints, dependency arrows,
                             licences, tests. --quick leaves out the stages that need Debian packages
cargo xtask book             check the book under docs/; builds it into target/book where mdbook is
cargo xtask protocol-reference
                             write docs/protocol-reference.md from the protocol's types
cargo xtask arrows           check which crate may depend on which
cargo xtask licences         check the licences of everything that ships against deny.toml
cargo xtask firmware [f330] [f350] [--install] [--exercise] [--test]
                             builds the firmware, prints flash and RAM, fails over budget;
                             --install gets the compiler's target, --test runs its host tests
cargo xtask firmware flash f330|f350 [--check] [ELF]
                             checks an image and writes it with a debug probe (probe-rs)
cargo xtask kernels          checks the kernels under valgrind, compares the matcher's instruction
                             counts, and tests the NEON ones under emulation
cargo xtask e2e [NAME,...]   plugs the simulated sensor into a Debian kernel in QEMU and tries the
                             stspp binary there: all scenarios, or those with a NAME in their name
cargo xtask peers            OpenCV's StereoSGBM (by pip, into target/peers) beside our matchers
cargo xtask help             this text";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let outcome = match arguments.as_slice() {
        ["test"] => return test::run(test::Depth::Full),
        ["test", "--quick"] => return test::run(test::Depth::Quick),
        ["e2e"] => e2e::run(None),
        ["e2e", only] => e2e::run(Some(only)),
        ["kernels"] => return test::kernels(),
        ["peers"] => peers::table(&workspace::root()),
        ["book"] => book::run(),
        ["protocol-reference"] => protocol_reference::write(),
        ["arrows"] => workspace::metadata().and_then(|m| arrows::check(&m)),
        ["licences"] => workspace::metadata().and_then(|m| licences::check(&m)),
        ["firmware", rest @ ..] => firmware::run(rest),
        ["help" | "--help" | "-h"] | [] => {
            println!("{HELP}");
            Ok(String::new())
        }
        other => Err(format!("unknown task `{}`\n\n{HELP}", other.join(" "))),
    };
    match outcome {
        Ok(said) => {
            if !said.is_empty() {
                println!("{said}");
            }
            ExitCode::SUCCESS
        }
        Err(why) => {
            eprintln!("xtask: {why}");
            ExitCode::from(2)
        }
    }
}
