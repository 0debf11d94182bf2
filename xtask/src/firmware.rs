//! `cargo xtask firmware`: builds the firmware for both boards, prints flash and RAM, fails over
//! budget; `--exercise` adds a small program for tests of the HAL; `cargo xtask firmware --test` runs the tests of the HAL's arithmetic on the host.
//!
//! The chip's target needs a core library. Two ways to one, tried in this order with the compiler
//! on PATH and with Debian's /usr/bin/rustc: the prebuilt one of `rustup target add`, or the
//! library's sources (rustup's `rust-src`, Debian's `rust-web-src`), from which cargo's
//! `-Z build-std` builds it.

mod elf;
mod flash;
mod toolchain;

use crate::stage::{self, Outcome};
use crate::{licences, workspace};
use std::path::{Path, PathBuf};
use std::process::Command;
use toolchain::Toolchain;

/// The chip's target.
pub const TARGET: &str = "thumbv7em-none-eabihf";
/// Flash that runs without wait states on both chips ("code area").
const FLASH_BUDGET: u64 = 64 * 1024;
/// Static RAM and the stack's high-water mark together. What is printed here is the static part;
/// the emulator's tests add the measured stack.
const RAM_BUDGET: u64 = 14 * 1024;
/// Least room for the stack that the static part must leave of [`RAM_BUDGET`]: the high-water mark
/// that the emulator measured (4.1 KiB on the F330, 4.0 KiB on the F350), rounded up.
const STACK_LEAST: u64 = 5 * 1024;

/// The boards, as the feature `board-<name>` of firmware/app names them.
pub const BOARDS: [&str; 2] = ["f330", "f350"];

/// What was built.
pub struct Image {
    /// The ELF.
    pub elf: PathBuf,
    /// Bytes of flash.
    pub flash: u64,
    /// Bytes of static RAM.
    pub ram: u64,
}

/// Runs the task.
///
/// # Errors
/// Says what is missing or over budget, and what to do about it.
pub fn run(arguments: &[&str]) -> Result<String, String> {
    if let ["flash", rest @ ..] = arguments {
        return flash::run(rest);
    }
    let (mut install, mut test, mut exercise, mut boards) = (false, false, false, Vec::new());
    for &argument in arguments {
        match argument {
            "--install" => install = true,
            "--test" => test = true,
            "--exercise" => exercise = true,
            board if BOARDS.contains(&board) => boards.push(board),
            other => {
                return Err(format!(
                    "firmware: unknown argument `{other}`\n\
                     cargo xtask firmware [f330] [f350] [--install] [--exercise] [--test]\n\
                     cargo xtask firmware flash f330|f350 [--check] [ELF]\n\
                     --install   gets the compiler's target (rustup, or Debian packages as root)\n\
                     --exercise  also builds the program that the HAL's emulator tests run\n\
                     --test      instead runs the host tests of the HAL's arithmetic"
                ));
            }
        }
    }
    if test {
        return host_tests();
    }
    if boards.is_empty() {
        boards.extend(BOARDS);
    }
    build_all(&toolchain::find(install)?, &boards, exercise)
}

/// Whether both boards' images have been built.
pub fn images_are_there() -> bool {
    let folder = workspace::root().join("target/firmware");
    BOARDS.iter().all(|board| folder.join(format!("{board}.elf")).exists())
}

/// Both boards as a stage of the test command: skipped only where no compiler can be had.
pub fn stage() -> Outcome {
    match toolchain::find(true) {
        Err(why) => Outcome::Skipped(why),
        Ok(toolchain) => stage::check(build_all(&toolchain, &BOARDS, true)),
    }
}

fn build_all(toolchain: &Toolchain, boards: &[&str], exercise: bool) -> Result<String, String> {
    println!("{toolchain}");
    let mut report = String::new();
    for &board in boards {
        let image = build(toolchain, board)?;
        report += &describe(board, &image);
        within_budget(board, &image).map_err(|over| format!("{report}{over}"))?;
        if exercise {
            build_program(toolchain, board, "stspp-exercise", &format!("exercise-{board}.elf"))?;
        }
    }
    Ok(report.trim_end().to_owned())
}

fn firmware() -> PathBuf {
    workspace::root().join("firmware")
}

/// Builds one board and copies its ELF to `target/firmware/<board>.elf`.
///
/// # Errors
/// When the compiler fails or the ELF cannot be read.
pub fn build(toolchain: &Toolchain, board: &str) -> Result<Image, String> {
    build_program(toolchain, board, "stspp-firmware", &format!("{board}.elf"))
}

/// Builds a program of the firmware's workspace for one board and copies its ELF to
/// `target/firmware/<file>`.
fn build_program(
    toolchain: &Toolchain,
    board: &str,
    program: &str,
    file: &str,
) -> Result<Image, String> {
    let mut cargo = toolchain.cargo();
    cargo
        .current_dir(firmware())
        .args(["build", "--release", "--locked", "--target", TARGET, "-p", program])
        .args(["--features", &format!("board-{board}")])
        .args(["--config", &short_paths()?]);
    toolchain.finish(&mut cargo);
    done(&mut cargo, "the firmware does not build")?;

    let built = firmware().join("target").join(TARGET).join("release").join(program);
    let folder = workspace::root().join("target/firmware");
    let elf = folder.join(file);
    std::fs::create_dir_all(&folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    std::fs::copy(&built, &elf).map_err(|e| format!("{}: {e}", built.display()))?;
    let bytes = std::fs::read(&elf).map_err(|e| format!("{}: {e}", elf.display()))?;
    let (flash, ram) = elf::sizes(&bytes).map_err(|e| format!("{}: {e}", elf.display()))?;
    Ok(Image { elf, flash, ram })
}

/// Paths of sources go into the image (panics name them): cut to what is the same on every machine,
/// so that the image is too. The configuration's own flags stay, since cargo joins lists.
fn short_paths() -> Result<String, String> {
    let home = std::env::var_os("CARGO_HOME")
        .map(PathBuf::from)
        .or_else(|| std::env::home_dir().map(|home| home.join(".cargo")));
    let mut folders = vec![workspace::root().to_path_buf()];
    if let Some(sources) = home.map(|home| home.join("registry/src")) {
        let entries = std::fs::read_dir(&sources).into_iter().flatten().flatten();
        folders.extend(entries.map(|entry| entry.path()));
    }
    let flags: Vec<String> = folders
        .iter()
        .map(|folder| format!("--remap-path-prefix={}/=", folder.display()))
        .collect();
    let flags = serde_json::to_string(&flags).map_err(|e| e.to_string())?;
    Ok(format!("target.{TARGET}.rustflags={flags}"))
}

fn describe(board: &str, image: &Image) -> String {
    let share = |part: u64, whole: u64| 100 * part / whole;
    format!(
        "{board}: flash {} of {FLASH_BUDGET} bytes ({} %), static RAM {} of {RAM_BUDGET} bytes \
         ({} %, {} left for the stack)  {}\n",
        image.flash,
        share(image.flash, FLASH_BUDGET),
        image.ram,
        share(image.ram, RAM_BUDGET),
        RAM_BUDGET.saturating_sub(image.ram),
        relative(&image.elf).display(),
    )
}

fn relative(path: &Path) -> &Path {
    path.strip_prefix(workspace::root()).unwrap_or(path)
}

fn within_budget(board: &str, image: &Image) -> Result<(), String> {
    if image.flash > FLASH_BUDGET {
        return Err(format!(
            "{board}: {} bytes of flash over the zero-wait area's {FLASH_BUDGET}",
            image.flash - FLASH_BUDGET
        ));
    }
    if image.ram + STACK_LEAST > RAM_BUDGET {
        return Err(format!(
            "{board}: {} bytes of static RAM leave less than {STACK_LEAST} of {RAM_BUDGET} for \
             the stack",
            image.ram
        ));
    }
    Ok(())
}

/// Formatting, licences and host tests of what only builds for the chip otherwise.
fn host_tests() -> Result<String, String> {
    let manifest = firmware().join("Cargo.toml");
    let mut format = workspace::cargo();
    format.args(["fmt", "--all", "--check", "--manifest-path"]).arg(&manifest);
    done(&mut format, "firmware/ is not formatted")?;

    let mut metadata = workspace::cargo();
    metadata.args(["metadata", "--format-version=1", "--locked", "--manifest-path"]).arg(&manifest);
    let output = metadata.output().map_err(|e| format!("cargo metadata could not be run: {e}"))?;
    if !output.status.success() {
        return Err(format!("firmware/: {}", String::from_utf8_lossy(&output.stderr).trim()));
    }
    let metadata = serde_json::from_slice(&output.stdout).map_err(|e| e.to_string())?;
    let licences = licences::check(&metadata)?;

    for (subcommand, rest) in [
        ("clippy", &["--all-targets", "--", "-D", "warnings"][..]),
        ("test", &["--lib", "--quiet"][..]),
    ] {
        let mut command = workspace::cargo();
        command
            .args([subcommand, "--locked", "--target", toolchain::host()?.trim()])
            .arg("--manifest-path")
            .arg(firmware().join("hal/Cargo.toml"))
            .args(rest);
        done(&mut command, "the HAL's arithmetic")?;
    }
    Ok(format!("firmware/: formatted; {licences}; host tests passed"))
}

fn done(command: &mut Command, what: &str) -> Result<(), String> {
    let status = command.status().map_err(|e| format!("{command:?} could not be run: {e}"))?;
    if status.success() { Ok(()) } else { Err(format!("{what}: {command:?} ended with {status}")) }
}
