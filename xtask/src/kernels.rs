//! What holds the kernels besides their tests: a memory checker, instruction counts that a
//! busy machine does not disturb, and the tests as an AArch64 program.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::debian;
use crate::stage::{self, Outcome};
use crate::workspace;

/// Instructions per pixel that each kernel takes.
const COUNTS: &str = "matcher/benches/instructions.toml";
/// A kernel that takes this much more than is kept has become slower.
const SLACK: f64 = 1.15;
/// Pixels of the frame that `matcher/examples/instruction_counts.rs` matches.
const PIXELS: f64 = 256.0 * 192.0;

/// Libraries with kernels, and which of their unit tests are about them; all without a name.
const CHECKED: [(&str, &[&str]); 2] =
    [("stspp_matcher", &[]), ("stspp", &["resample::", "reproject::"])];

/// Runs the kernels' unit tests, whose images have odd sizes, under valgrind: the plain kernels and the
/// AVX2 ones, for valgrind knows no AVX-512.
pub fn memory_check() -> Outcome {
    if let Err(why) = debian::ensure(&["valgrind"]) {
        return Outcome::Skipped(why);
    }
    let mut build = workspace::cargo();
    // Of the whole workspace, as the stage of all tests has built them.
    build.args(["test", "--locked", "--workspace", "--lib", "--no-run"]);
    let binaries = match executables(build, "lib") {
        Ok(binaries) => binaries,
        Err(why) => return Outcome::Failed(why),
    };
    for (library, tests) in CHECKED {
        let Some(binary) = binaries.get(library) else {
            return Outcome::Failed(format!("no tests of {library} were built"));
        };
        let mut valgrind = Command::new("valgrind");
        valgrind.args(["-q", "--error-exitcode=9", "--leak-check=no"]).arg(binary).args(tests);
        // One thread, so that an error stands below the name of its test.
        valgrind.arg("--test-threads=1");
        let outcome = stage::command(valgrind);
        if !matches!(outcome, Outcome::Passed(_)) {
            return outcome;
        }
    }
    Outcome::Passed(String::new())
}

/// Counts the instructions of one small frame per kernel, at the AVX2 level, and compares them with
/// those kept in the repository.
pub fn instruction_counts() -> Outcome {
    if let Err(why) = debian::ensure(&["valgrind"]) {
        return Outcome::Skipped(why);
    }
    let kept = match read_kept() {
        Ok(kept) => kept,
        Err(why) => return Outcome::Failed(why),
    };
    match count() {
        Ok(Some(lines)) => compare(&kept, &lines),
        Ok(None) => Outcome::Skipped("this processor has no AVX2".into()),
        Err(why) => Outcome::Failed(why),
    }
}

fn read_kept() -> Result<BTreeMap<String, f64>, String> {
    let path = workspace::root().join(COUNTS);
    let text = std::fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
    let table: toml::Table = text.parse().map_err(|e| format!("{}: {e}", path.display()))?;
    let kept = table.get("per_pixel").and_then(|t| t.as_table()).into_iter().flatten();
    Ok(kept.filter_map(|(kernel, n)| Some((kernel.clone(), n.as_float()?))).collect())
}

/// Lines "instructions function" of callgrind; `None` without AVX2.
fn count() -> Result<Option<Vec<(f64, String)>>, String> {
    let mut build = workspace::cargo();
    build.args(["build", "--locked", "-p", "stspp-matcher", "--example", "instruction_counts"]);
    let mut binaries = executables(build, "example")?;
    let binary = binaries.remove("instruction_counts").ok_or("no example was built")?;
    let file = workspace::root().join("target/instruction_counts.callgrind");
    let mut run = Command::new("valgrind");
    run.args(["-q", "--tool=callgrind"]);
    run.arg(format!("--callgrind-out-file={}", file.display())).arg(binary);
    let said = output(run)?;
    if !said.starts_with("avx2") {
        return Ok(None);
    }
    let mut annotate = Command::new("callgrind_annotate");
    // Annotated sources would name each function once more, with what its calls cost.
    annotate.args(["--auto=no", "--threshold=100"]).arg(&file);
    let text = output(annotate)?;
    let lines = text.lines().filter_map(|line| {
        let (number, rest) = line.trim_start().split_once(' ')?;
        let instructions: f64 = number.replace(',', "").parse().ok()?;
        Some((instructions, rest.to_owned()))
    });
    Ok(Some(lines.collect()))
}

fn compare(kept: &BTreeMap<String, f64>, lines: &[(f64, String)]) -> Outcome {
    let mut slower = Vec::new();
    println!("instructions per pixel, kept and now");
    for (kernel, kept) in kept {
        let own = lines.iter().filter(|(_, function)| function.contains(kernel.as_str()));
        let now = own.map(|(instructions, _)| instructions).sum::<f64>() / PIXELS;
        println!("  {kernel:<40} {kept:>8.1} {now:>8.1}");
        if now > SLACK * kept || now < 0.3 * kept {
            slower.push(format!("{kernel} {kept:.1} -> {now:.1}"));
        }
    }
    if slower.is_empty() {
        return Outcome::Passed(format!("{} kernels", kept.len()));
    }
    Outcome::Failed(format!(
        "another cost than {COUNTS} keeps (or another name): {}",
        slower.join(", ")
    ))
}

/// Runs the unit tests of the matcher and of the host driver's library, which hold every kernel against
/// its plain twin, as AArch64 programs under user-mode emulation: the NEON kernels are seen by no x86
/// build.
pub fn aarch64() -> Outcome {
    const TARGET: &str = "aarch64-unknown-linux-gnu";
    const PACKAGES: [&str; 3] = ["gcc-aarch64-linux-gnu", "libc6-dev-arm64-cross", "qemu-user"];
    let has_std = has_standard_library(TARGET);
    let mut packages = PACKAGES.to_vec();
    if !has_std {
        packages.extend(["rustc-web", "rust-web-src"]);
    }
    if let Err(why) = debian::ensure(&packages) {
        return Outcome::Skipped(why);
    }
    let mut test = workspace::cargo();
    test.env("CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER", "aarch64-linux-gnu-gcc");
    let runner = "qemu-aarch64 -L /usr/aarch64-linux-gnu";
    test.env("CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER", runner);
    test.args(["test", "--locked", "-p", "stspp-matcher", "-p", "stspp", "--lib"]);
    // Without the simulator, the command line and libusb, which hold no kernels.
    test.args(["--no-default-features", "--target", TARGET]);
    if !has_std {
        test.env("RUSTC", Path::new("/usr/bin/rustc")).env("RUSTC_BOOTSTRAP", "1");
        test.env_remove("RUSTFLAGS");
        // The compiler is another one: its own folder keeps both from building everything anew.
        test.args(["--target-dir", "target/aarch64", "-Z", "build-std=std"]);
    }
    stage::command(test)
}

/// Whether the compiler in use came with the standard library of `target`.
fn has_standard_library(target: &str) -> bool {
    let mut rustc = Command::new("rustc");
    rustc.args(["--print", "target-libdir", "--target", target]).current_dir(workspace::root());
    rustc.output().is_ok_and(|o| Path::new(String::from_utf8_lossy(&o.stdout).trim()).is_dir())
}

fn output(mut command: Command) -> Result<String, String> {
    let output = command.stderr(Stdio::inherit()).output();
    let output = output.map_err(|e| format!("{command:?} could not be run: {e}"))?;
    if !output.status.success() {
        return Err(format!("{command:?} ended with {}", output.status));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Builds, and gives the executables of that kind of target by the targets' names.
fn executables(mut build: Command, kind: &str) -> Result<BTreeMap<String, PathBuf>, String> {
    build.arg("--message-format=json-render-diagnostics");
    let text = output(build)?;
    let messages = text
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .filter(|m| m["reason"] == "compiler-artifact" && m["target"]["kind"][0] == kind);
    let named = messages.filter_map(|m| {
        let (name, path) = (m["target"]["name"].as_str()?, m["executable"].as_str()?);
        Some((name.to_owned(), PathBuf::from(path)))
    });
    Ok(named.collect())
}
